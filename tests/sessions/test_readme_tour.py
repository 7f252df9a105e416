"""The README's commands run as written."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from uvgs_bench.cli.app import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)


def test_every_command_named_in_the_readme_exists():
    named = set(re.findall(r"`?uvgs ([a-z][a-z-]*)", README))
    assert named - {"gantry"} <= set(COMMANDS), named - set(COMMANDS)
    assert set(COMMANDS) <= named | {"camera", "beacon", "benchmark"}


@pytest.mark.timeout(600)
def test_the_tour_runs_as_written(tmp_path):
    first, second = (next(block for block in BLOCKS if word in block) for word in ("uvgs init", "uvgs fuse"))
    tour = first + second
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
    }
    done = subprocess.run(
        ["bash", "-euxc", tour], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stdout[-1500:] + done.stderr[-3000:]
    run = next((tmp_path / "my_bench" / "reports").glob("*_demo_grid"))
    assert {"report.html", "report.pdf", "report.json"} <= {path.name for path in run.iterdir()}
    assert (tmp_path / "my_bench" / "fused.tum").read_text().count("\n") > 100
    lines = (tmp_path / "my_bench" / "poses.csv").read_text().splitlines()
    assert len(lines) == 91  # a header and one line for each of 30 x 3 captures


def test_the_python_of_the_readme_finds_what_it_imports():
    snippet = re.search(r"```python\n(.*?)```", README, re.DOTALL)
    assert snippet is not None
    compile(snippet[1], "README.md", "exec")
    imports = [line for line in snippet[1].splitlines() if line.startswith(("from ", "import "))]
    assert any("uvgs_bench.store" in line for line in imports)
    assert any("uvgs_bench.sensor" in line for line in imports)
    # And the names the Python door promises beyond the snippet.
    promised = "from uvgs_bench.store import read_run\nfrom uvgs_bench.sensor import Capture, Uvgs, UvgsConfig\n"
    exec(compile("\n".join(imports) + "\n" + promised, "README.md", "exec"), {})


def test_the_readme_names_files_that_exist():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        if not target.startswith("http"):
            assert (ROOT / target).exists(), target
