"""The house rules: who may import whom, what start-up costs, how long files are, what never enters the repository."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "uvgs_bench"
SOURCES = sorted(p for p in PACKAGE.rglob("*.py") if "_examples" not in p.parts)
HEAVY = ("cv2", "scipy", "matplotlib", "numba", "rosbags", "numpy", "typst", "jinja2", "pydantic", "serial")
LONGEST_FILE_LINES = 450


def test_help_imports_nothing_heavy():
    code = (
        "import sys\n"
        "from uvgs_bench.cli.app import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        f"print('LOADED', [m for m in {HEAVY!r} if m in sys.modules and m not in ('pydantic',)])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert "LOADED []" in done.stdout, done.stdout[-500:] + done.stderr[-500:]


def test_files_stay_small():
    long = {str(p.relative_to(ROOT)): n for p in SOURCES if (n := len(p.read_text().splitlines())) > LONGEST_FILE_LINES}
    assert not long


@pytest.mark.parametrize(
    "room", [p.parent.name for p in sorted(PACKAGE.glob("*/__init__.py")) if "_examples" not in p.parts]
)
def test_room_doors_are_narrow_and_described(room):
    tree = ast.parse((PACKAGE / room / "__init__.py").read_text())
    assert ast.get_docstring(tree), f"{room}/__init__.py needs a docstring"
    for node in tree.body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            assert len(ast.literal_eval(node.value)) <= 8


def test_conversion_factors_live_in_units_only():
    pattern = re.compile(r"(?<![\w.])(1000\.0|1e3|1e-3|0\.001|pi\s*/\s*180|180(\.0)?\s*/\s*(np\.|math\.)?pi)(?![\w.])")
    offenders = []
    for path in SOURCES:
        if path.name == "units.py":
            continue
        for number, line in enumerate(path.read_text().splitlines(), 1):
            code = line.split("#")[0]
            if re.search(r"[*/]\s*(1000\.0|1e3)\b", code) or (pattern.search(code) and re.search(r"_(mm|deg)\b", code)):
                offenders.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()}")
    assert not offenders, "\n".join(offenders)


def tracked_files() -> list[Path]:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False)
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    return [ROOT / name for name in listed.stdout.decode().split("\0") if name]


def test_nothing_of_the_machine_is_committed():
    forbidden = re.compile(
        r"/work/|/root/|pypi\.org|registry\.npmjs|deb\.debian|BEGIN [A-Z ]*PRIVATE KEY|yaml\.load\(|import pickle"
    )
    offenders = []
    for path in tracked_files():
        if not path.is_file() or path.suffix in {".png", ".pdf", ".svg"} or path == Path(__file__):
            continue
        text = path.read_text(encoding="utf-8", errors="ignore")
        offenders += [f"{path.relative_to(ROOT)}: {match.group(0)}" for match in [forbidden.search(text)] if match]
    assert not offenders, "\n".join(offenders)


def test_top_level_is_the_agreed_one():
    allowed = {
        "uvgs_bench", "firmware", "calib", "procedures", "reports", "tests", "docs", ".ci",
        "pyproject.toml", "README.md", "Makefile", "CHANGELOG.md", "LICENSE", ".gitignore",
    }  # fmt: skip
    found = {path.relative_to(ROOT).parts[0] for path in tracked_files()}
    assert found <= allowed, found - allowed


def test_import_contracts_hold():
    tool = Path(sys.executable).with_name("lint-imports")
    if not tool.exists():
        assert not os.environ.get("CI"), "import-linter must be installed in CI"
        pytest.skip("import-linter is not installed")
    done = subprocess.run([tool], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-500:]
