"""A run on disk becomes observations and a judgement without losing a bit, and `uvgs register` says what it found."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.synthetic_run import CAMERA_FROM_GANTRY, synthetic_run, write_run
from uvgs_bench.accuracy import Limit
from uvgs_bench.accuracy.budget_lines import BudgetLine
from uvgs_bench.cli import app
from uvgs_bench.geometry import Pose
from uvgs_bench.store.gantry_records import AxisRecord, GantryRecord, PairRecord, write_gantry_record
from uvgs_bench.store.judging import judge_run
from uvgs_bench.store.observations import observations_from_run
from uvgs_bench.store.run import Run, read_run
from uvgs_bench.store.run_writer import SETUP_GANTRY


@pytest.fixture
def main(monkeypatch: pytest.MonkeyPatch) -> Callable[[list[str]], None]:
    """The command with this one subcommand: the others are not this test's business."""
    monkeypatch.setattr(app, "COMMANDS", {"register": app.COMMANDS["register"]})
    return app.main


def test_observations_carry_positions_misses_and_places() -> None:
    run = synthetic_run(miss_every=5)
    moved = replace(run.samples[0], position=run.samples[0].position + 1e-3, waypoint=7)
    obs = observations_from_run(replace(run, samples=(moved, *run.samples[1:])))
    assert obs.count == len(run.samples)
    # The reported position counts, not the target: 1 mm on each of three orthogonal axes.
    np.testing.assert_allclose(obs.t_gs_m[0], moved.target + 1e-3, atol=1e-15)
    assert obs.place[0] == 7
    assert obs.station[0] == 0
    assert not obs.is_solved[4]
    assert np.isnan(obs.t_cb_m[4]).all()
    assert obs.reason[4] == "blobs/too_few_blobs"


def test_run_without_samples_is_judged_inconclusive() -> None:
    judgement = judge_run(replace(synthetic_run(), samples=(), ended=""))
    assert judgement.verdict == "inconclusive"
    assert judgement.registration is None
    assert any("still running or killed" in alert.text for alert in judgement.alerts)


def test_judgement_survives_the_disk(tmp_path: Path) -> None:
    run = synthetic_run(limits=(Limit.of("position_rms_mm", 2.0),))
    again = read_run(write_run(run, tmp_path / "20260102T030405Z_synthetic"))
    assert judge_run(again).verdicts == judge_run(run).verdicts
    assert judge_run(again).verdict == "pass"


def test_the_mount_as_built_decides_what_a_sweep_without_rotations_cannot_see(tmp_path: Path) -> None:
    run = synthetic_run()
    plain = judge_run(run).registration
    assert plain is not None
    built = Pose(plain.right.R, np.array([0.012, -0.025, 0.008]), "carriage", "beacon")
    told = replace(run, manifest=replace(run.manifest, mounted=built))
    path = write_run(told, tmp_path / "20260102T030405Z_synthetic")
    registration = judge_run(read_run(path)).registration
    assert registration is not None
    assert len(registration.null_directions) == 3
    # Three translations slide freely to where they were said to be; what was seen stays.
    np.testing.assert_allclose(registration.right.t_m, built.t_m, atol=1e-9)
    assert registration.right.is_close(Pose(plain.right.R, built.t_m, "carriage", "beacon"), 1e-9, 1e-9)


def test_the_doubt_of_a_characterised_gantry_is_a_line_of_the_budget(tmp_path: Path) -> None:
    run = synthetic_run()
    line = _axis_line(run)
    assert (line.is_known, line.position_m) == (False, 0.0)
    folder = write_run(run, tmp_path / "20260102T030405Z_synthetic")
    axes = tuple(
        AxisRecord(axis.name, tuple(float(v) for v in axis.direction), scale_ppm=0.0, scale_sigma_ppm=1000.0)
        for axis in run.manifest.axes
    )
    pairs = tuple(PairRecord(pair, 0.0, 1.0) for pair in (("X", "Y"), ("X", "Z"), ("Y", "Z")))
    covariance = tuple(tuple(1e-6 * float(i == j) for j in range(6)) for i in range(6))
    (folder / "setup").mkdir(exist_ok=True)
    record = GantryRecord("bench", "2026-01-01T00:00:00.000Z", "camera with board b", axes, pairs, covariance)
    write_gantry_record(folder / "setup" / SETUP_GANTRY, record)
    line = _axis_line(read_run(folder))
    assert line.is_known
    assert line.part == "reference"
    # 1e-3 in each of six terms: per station the arms are at most 0.35 m, and the registration takes up the mean.
    assert 1e-5 < line.position_m < 6.0**0.5 * 0.35e-3


def _axis_line(run: Run) -> BudgetLine:
    budget = judge_run(run).budget
    assert budget is not None
    return next(line for line in budget.lines if line.name == "axis scale and squareness")


def test_register_command_prints_and_writes(
    main: Callable[[list[str]], None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_run(synthetic_run(), tmp_path / "20260102T030405Z_synthetic")
    target = tmp_path / "registration.toml"
    with pytest.raises(SystemExit) as left:
        main(["register", str(path), "--out", str(target), "--json"])
    assert left.value.code == 0
    shown = json.loads(capsys.readouterr().out)
    written = tomllib.loads(target.read_text())
    assert shown["rank"] == written["rank"] == 9
    assert shown["left"] == written["left"]
    # Ten stations, 0.6 mm in depth over an arm of 0.5 m: planted offset and fitted one agree to a few mm.
    np.testing.assert_allclose(written["left"]["translation_mm"], 1e3 * CAMERA_FROM_GANTRY.t_m, atol=5.0)
    assert shown["held_out"]["stations"] == 20
    with pytest.raises(SystemExit) as left:
        main(["register", str(path)])
    assert left.value.code == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "camera_from_gantry" in text
    assert "only their sum is seen" in text
    with pytest.raises(SystemExit) as left:
        main(["register", str(path), "--out", str(target)])
    assert left.value.code == 2


def test_register_command_refuses_too_few_stations(
    main: Callable[[list[str]], None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_run(synthetic_run(stations=2), tmp_path / "20260102T030405Z_synthetic")
    with pytest.raises(SystemExit) as left:
        main(["register", str(path)])
    assert left.value.code == 3
    assert "at least 3 stations" in " ".join(capsys.readouterr().err.split())
    with pytest.raises(SystemExit) as left:
        main(["register", str(tmp_path / "nowhere")])
    assert left.value.code == 4
