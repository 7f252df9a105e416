"""The command's frame: help for everything, errors as one line, exit codes, pipes."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from uvgs_bench.cli.app import COMMANDS, main

ROOT = Path(__file__).resolve().parents[3]


def run(*arguments: str, cwd: Path | None = None, columns: int = 80) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"COLUMNS": str(columns), "PYTHONPATH": str(ROOT), "NO_COLOR": "1"}
    return subprocess.run(
        [sys.executable, "-m", "uvgs_bench", *arguments],
        capture_output=True,
        text=True,
        cwd=cwd,
        env=environment,
        timeout=120,
        check=False,
    )


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_command_has_help(name, capsys):
    with pytest.raises(SystemExit) as left:
        main([name, "--help"])
    assert left.value.code == 0
    shown = capsys.readouterr().out
    assert "Usage" in shown
    assert re.search(r"[a-z]{4}", shown.split("Usage")[1])


def test_version_and_no_arguments(capsys):
    with pytest.raises(SystemExit) as left:
        main(["--version"])
    assert left.value.code == 0
    assert re.fullmatch(r"uvgs \d+\.\d+\.\d+\n", capsys.readouterr().out)
    assert run().returncode in (0, 2)  # help, by the version of the parser


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["no-such-command"], 2, "No such command"),
        (["report"], 2, "Missing argument"),
        (["report", "nowhere"], 4, "nowhere"),
        (["gantry-sweep", "nowhere.toml"], 4, "make a workspace with uvgs init"),
        (["camera", "show", "nowhere.yaml"], 4, "nowhere.yaml"),
        (["run", "images:nowhere", "--camera", "c.yaml", "--beacon", "b.toml", "--out", "p.csv"], None, ""),
        (["demo", "--stations", "2"], 2, "stations"),
    ],
)
def test_mistakes_are_told_in_a_line_or_two(arguments, code, says, tmp_path):
    done = run(*arguments, cwd=tmp_path)
    assert done.returncode == code or (code is None and done.returncode in (2, 4))
    assert says in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


def test_init_makes_a_workspace_that_is_not_overwritten(tmp_path):
    first = run("init", "bench", "--json", cwd=tmp_path)
    files = json.loads(first.stdout)["files"]
    assert "calib/bench.toml" in files
    assert all((tmp_path / "bench" / name).is_file() for name in files)
    again = run("init", "bench", cwd=tmp_path)
    assert again.returncode == 2
    assert "--force" in again.stderr
    assert run("init", "bench", "--force", cwd=tmp_path).returncode == 0


def test_doctor_speaks_json_and_narrow_terminals():
    findings = json.loads(run("doctor", "--json").stdout)["findings"]
    assert {"area", "item", "state", "text"} == set(findings[0])
    assert any(f["item"] == "numpy" and f["state"] == "ok" for f in findings)
    narrow = run("doctor", columns=50)
    assert narrow.returncode == 0
    assert max(len(line) for line in narrow.stdout.splitlines()) <= 50
