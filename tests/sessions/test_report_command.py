"""``uvgs report`` on runs on disk: files, exit codes, words."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner, Result

from tests.helpers.judged_once import judged_once
from tests.helpers.synthetic_run import synthetic_run, write_run
from uvgs_bench.accuracy.judgement import Limit
from uvgs_bench.cli.report import report
from uvgs_bench.errors import ConfigError, RunError

LOOSE = (Limit.of("position_rms_mm", 50.0), Limit.of("availability_percent", 20.0))
TIGHT = (Limit.of("position_rms_mm", 0.001),)


@pytest.fixture(scope="module", autouse=True)
def _once() -> Iterator[None]:
    with judged_once():
        yield


@pytest.fixture(scope="module")
def make_run(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """A run on disk with limits and an end; asked for again, the same folder with the reports of earlier tests."""

    @cache
    def made(limits: tuple[Limit, ...] = LOOSE, ended: str = "completed") -> Path:
        run = synthetic_run(stations=24, shots=1, limits=limits, ended=ended)
        return write_run(run, tmp_path_factory.mktemp("run") / "20260102T030405Z_synthetic")

    return made


def uvgs_report(*arguments: str) -> Result:
    app = typer.Typer()
    app.command()(report)
    return CliRunner().invoke(app, list(arguments))


def test_limits_met_exit_0_and_three_files(make_run: Callable[..., Path]) -> None:
    run = make_run()
    result = uvgs_report(str(run))
    assert result.exit_code == 0, result.output
    assert "PASS" in result.stdout
    assert (run / "report.html").read_text(encoding="utf-8").startswith("<!doctype html>")
    assert (run / "report.pdf").read_bytes().startswith(b"%PDF")
    assert json.loads((run / "report.json").read_text(encoding="utf-8"))["verdict"]["state"] == "pass"
    assert str(run / "report.pdf") in result.stdout


def test_limits_missed_exit_1_and_json_says_so(make_run: Callable[..., Path]) -> None:
    run = make_run(TIGHT)
    result = uvgs_report(str(run), "--format", "json", "--json")
    assert result.exit_code == 1, result.output
    printed = json.loads(result.stdout)
    assert printed["verdict"] == "fail"
    assert printed["files"] == {"json": str(run / "report.json")}
    written = json.loads((run / "report.json").read_text(encoding="utf-8"))
    assert printed["key_figures"] == written["key_figures"]


def test_no_limits_or_interrupted_exit_3_but_are_reported(make_run: Callable[..., Path]) -> None:
    run = make_run((), ended="interrupted")
    result = uvgs_report(str(run), "--format", "json")
    assert result.exit_code == 3, result.output
    written = json.loads((run / "report.json").read_text(encoding="utf-8"))
    assert any("was interrupted" in banner["text"] for banner in written["banners"])


def test_a_missing_run_is_a_run_error(tmp_path: Path) -> None:
    result = uvgs_report(str(tmp_path / "nowhere"))
    assert isinstance(result.exception, RunError)
    assert int(result.exception.exit_code) == 4
    assert "no such run folder" in str(result.exception)


def test_an_unknown_format_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    result = uvgs_report(str(tmp_path / "nowhere"), "--format", "html,docx")
    assert isinstance(result.exception, ConfigError)
    assert "unknown format 'docx'" in str(result.exception)


def test_own_reports_are_rebuilt_but_foreign_files_are_kept(tmp_path: Path, make_run: Callable[..., Path]) -> None:
    run = make_run()
    elsewhere = tmp_path / "out"
    (run / "report.json").write_text("of an older program")
    assert uvgs_report(str(run), "--format", "json").exit_code == 0
    assert uvgs_report(str(run), "--format", "json", "--out", str(elsewhere)).exit_code == 0
    assert (elsewhere / "report.json").read_bytes() == (run / "report.json").read_bytes()
    again = uvgs_report(str(run), "--format", "json", "--out", str(elsewhere))
    assert isinstance(again.exception, ConfigError)
    assert "--force" in str(again.exception)
    assert uvgs_report(str(run), "--format", "json", "--out", str(elsewhere), "--force").exit_code == 0


def test_a_run_with_a_torn_last_line_is_still_reported(tmp_path: Path, make_run: Callable[..., Path]) -> None:
    run = Path(shutil.copytree(make_run(), tmp_path / make_run().name))
    with (run / "samples.jsonl").open("ab") as journal:
        journal.write(b'{"index": 99, "sta')
    assert uvgs_report(str(run), "--format", "json").exit_code in (0, 3)
    assert "torn" in (run / "report.json").read_text(encoding="utf-8")
