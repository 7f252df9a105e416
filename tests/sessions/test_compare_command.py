"""``uvgs compare`` as typed: words, exit codes, files, and runs that cannot be compared."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.judged_once import judged_once
from tests.helpers.synthetic_run import synthetic_run, write_run
from uvgs_bench.cli import app as cli
from uvgs_bench.geometry import Pose
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.store.run_types import Run


def spoilt(run: Run, shift_m: float) -> Run:
    """The same run with every pose off by a random shift."""
    rng = np.random.default_rng(5)
    samples = []
    for sample in run.samples:
        if isinstance(sample.outcome, PoseEstimate):
            pose = sample.outcome.camera_from_beacon
            off = Pose(pose.R, pose.t_m + shift_m * rng.standard_normal(3), "camera", "beacon")
            sample = replace(sample, outcome=replace(sample.outcome, camera_from_beacon=off))
        samples.append(sample)
    return replace(run, samples=tuple(samples))


def written(folder: Path, day: int, run: Run, **changes: object) -> Path:
    manifest = replace(run.manifest, created_utc=f"2026-01-{day:02d}T03:04:05.000Z", **changes)  # type: ignore[arg-type]
    return write_run(replace(run, manifest=manifest), folder / f"202601{day:02d}T030405Z_synthetic")


@pytest.fixture(scope="module", autouse=True)
def _once() -> Iterator[None]:
    with judged_once():
        yield


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("runs")
    same = [written(folder, day, synthetic_run(stations=30, seed=4)) for day in (2, 3, 4)]
    worse = written(folder, 5, spoilt(synthetic_run(stations=30, seed=4), 0.001), versions={"uvgs_bench": "0.2.0"})
    few = written(folder, 6, synthetic_run(stations=9, seed=4))
    other = written(folder, 7, synthetic_run(stations=30, seed=4), mount="camera_on_carriage")
    return [*same, worse, few, other]


@pytest.fixture
def uvgs(capsys: pytest.CaptureFixture[str]):
    def run(*words: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            cli.main(["compare", *map(str, words)])
        printed = capsys.readouterr()
        return int(end.value.code or 0), printed.out, printed.err

    return run


def test_equal_runs_show_no_difference(uvgs, runs: list[Path]) -> None:
    code, printed, _ = uvgs(*runs[:3], "--fail-on-worse", "--json")
    answer = json.loads(printed)
    assert code == 0
    assert answer["verdict"] == "no difference shown"
    assert [run["against"] for run in answer["runs"]] == [-1, 0, 0]
    assert answer["runs"][1]["is_paired"] is True
    assert answer["runs"][1]["setup_differences"] == []
    assert {change["change"] for change in answer["runs"][1]["changes"]} == {0.0, 1.0}


def test_a_worse_run_closes_the_gate(uvgs, runs: list[Path], tmp_path: Path) -> None:
    code, printed, _ = uvgs(runs[3], runs[0], "--fail-on-worse", "--out", tmp_path)
    assert code == 1
    assert "WORSE" in printed
    assert "not the same: version of uvgs_bench: 0.1.0 -> 0.2.0" in printed
    data = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert data["verdict"]["shown"] == "worse"
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert data["headline"].replace("'", "&#39;") in page
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")
    first = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert uvgs(runs[0], runs[3], "--out", tmp_path)[0] == 2
    assert uvgs(runs[0], runs[3], "--out", tmp_path, "--force")[0] == 0
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == first
    # Ten times the error is tolerated: the gate is open.
    assert uvgs(runs[0], runs[3], "--fail-on-worse", "--allow-percent", "1000")[0] == 0


def test_each_against_the_one_before(uvgs, runs: list[Path]) -> None:
    answer = json.loads(uvgs(*runs[:4], "--against", "previous", "--json")[1])
    assert [run["against"] for run in answer["runs"]] == [-1, 0, 1, 2]
    assert [trend["key"] for trend in answer["trends"]] == ["position_rms", "attitude_rms"]


def test_too_few_places_are_inconclusive(uvgs, runs: list[Path]) -> None:
    code, printed, _ = uvgs(runs[0], runs[4], "--fail-on-worse")
    assert code == 3
    assert "at least" in printed


def test_what_cannot_be_compared_is_one_clear_line(uvgs, runs: list[Path], tmp_path: Path) -> None:
    for words, code, expected in (
        ((runs[0],), 2, "two or more runs, got 1"),
        ((runs[0], runs[0]), 2, "is given twice"),
        ((runs[0], tmp_path / "none"), 4, "no such run folder"),
        ((runs[0], runs[5]), 4, "camera_on_carriage, the others do not"),
    ):
        found, printed, said = uvgs(*words)
        assert found == code
        assert expected in " ".join(said.split())
        assert printed == ""


def test_a_run_of_the_first_version_can_still_be_compared(uvgs, runs: list[Path]) -> None:
    old = Path(__file__).parents[1] / "helpers" / "old_runs" / "schema_1_first"
    code, printed, said = uvgs(old, runs[0], "--json")
    assert code == 0, said
    answer = json.loads(printed)
    assert [run["against"] for run in answer["runs"]] == [-1, 0]
    assert answer["runs"][1]["changes"]


def test_repeated_runs_show_repeatability_and_reproducibility(uvgs, runs: list[Path]) -> None:
    answer = json.loads(uvgs(*runs[:3], "--json")[1])["precision_mm"]
    assert list(answer) == [
        "repeatability_sd", "between_runs_sd", "reproducibility_sd", "repeatability_limit", "reproducibility_limit",
    ]  # fmt: skip
    # The same captures three times: nothing differs between runs, and captures of a place as one run says.
    assert answer["between_runs_sd"]["value"] == 0.0
    r = answer["repeatability_sd"]
    assert 0.0 < r["low"] < r["value"] < r["high"]
    assert answer["repeatability_limit"]["value"] == pytest.approx(2.8 * r["value"])
    printed = uvgs(*runs[:3])[1]
    assert "reproducibility limit" in printed
    # Two runs have no upper end, and say so.
    assert "only 2 runs" in uvgs(*runs[:2])[1]
