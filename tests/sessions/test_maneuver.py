"""Motions on the simulated bench: told, reported and seen positions on one clock; several beacons; corrections."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uvgs_bench.devices.sim.bench import SimulatedBench
from uvgs_bench.errors import ConfigError, RunError
from uvgs_bench.sensor import PoseEstimate
from uvgs_bench.sensor.outcome import Miss
from uvgs_bench.sessions.beacon_group import GroupSensor
from uvgs_bench.sessions.bench_setup import SetUp, open_rig, read_setup, read_setup_of, resume, sweep
from uvgs_bench.sessions.early_log import EarlyLog
from uvgs_bench.sessions.events import Event, Remark, StageAdvanced
from uvgs_bench.sessions.mission_benchmark import handover_quality
from uvgs_bench.sessions.stream import run_captures
from uvgs_bench.store.judging import judge_run
from uvgs_bench.store.observations import observations_from_run
from uvgs_bench.store.run import Run, read_run

pytestmark = pytest.mark.opencv

ROOT = Path(__file__).parents[2]
PROCEDURE = """
schema = 1
name = "short_square"
pattern = "trajectory"
origin = "centre"
feed_mm_min = 2400.0
order = "as_written"
register = 0.6
[trajectory]
path = [
    { X_mm = -40.0, Y_mm = 0.0, Z_mm = -40.0 },
    { X_mm = 40.0, Y_mm = 0.0, Z_mm = -40.0 },
    { X_mm = 40.0, Y_mm = 0.0, Z_mm = 40.0 },
    { X_mm = -40.0, Y_mm = 0.0, Z_mm = 40.0 },
    { X_mm = -40.0, Y_mm = 0.0, Z_mm = -40.0 },
]
blend_mm = 10.0
dwell_s = [0.0, 0.0, 0.5, 0.0, 0.0]
laps = 2
captures_hz = 3.0
around = { X_mm = 60.0, Y_mm = 40.0, Z_mm = 60.0 }
"""


def set_up_of(folder: Path, text: str = PROCEDURE, bench: str = "bench.toml", delay_ms: float = 0.0) -> SetUp:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "procedure.toml").write_text(text)
    file = ROOT / "calib" / bench
    found = read_setup(folder / "procedure.toml", file)
    truth = found.bench.simulated
    assert truth is not None
    # As long an exposure as the default would take: what is tested is motion.
    changed = replace(truth, camera=replace(truth.camera, delay_ms=delay_ms))
    return replace(found, bench=replace(found.bench, simulated=changed))


@pytest.fixture(scope="module")
def square(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, SimulatedBench]:
    """The square with captures stamped 20 ms late."""
    folder = tmp_path_factory.mktemp("square")
    twins: list[SimulatedBench] = []
    result = sweep(set_up_of(folder, delay_ms=20.0), folder / "runs", keep="none", on_bench=twins.append)
    return read_run(result.path), twins[0]


def test_told_reported_and_true_positions_agree_in_motion(square: tuple[Run, SimulatedBench]) -> None:
    run, twin = square
    assert run.is_complete
    moving = [sample for sample in run.samples if sample.is_moving]
    waiting = [sample for sample in run.samples if sample.waypoint == 15 + 2 and not sample.is_moving]
    assert len(moving) > 30
    # Two waits of 0.5 s at 3 Hz, one visit each.
    assert len({sample.station for sample in waiting}) == 2
    for sample in moving:
        true = twin.device.position_at(sample.t_ns)
        # Reports have three decimals of a mm, and are sure to 1 ms at 40 mm/s.
        assert np.abs(true - sample.position).max() < 6e-5
        # What is told is kept within the lag that is caught up with: 60 ms at 40 mm/s.
        assert np.abs(sample.target - sample.position).max() < 2.4e-3
        speed = twin.device.velocity_at(sample.t_ns)
        # Reports lie 30 ms apart, the axes accelerate by up to 200 mm/s^2: half of that between two.
        assert np.abs(speed - sample.velocity).max() < 3.1e-3
    times = [sample.t_ns for sample in run.samples]
    assert times == sorted(times)
    assert {sample.role for sample in moving} == {"judge"}


def test_a_planted_delay_is_found_from_the_motion(square: tuple[Run, SimulatedBench]) -> None:
    run, _ = square
    found = {q.key: q.estimate for q in judge_run(run).quantities if not q.group}
    # Planted 20 ms; sampling of reports adds up to 1 ms.
    assert abs(found["lag"].value - 0.020) < 1.5e-3
    assert found["dynamic_position_rms"].capture_count > 30
    # 20 ms at up to 40 mm/s are 0.8 mm; the registration at rest has no part in it.
    assert 0.3e-3 < found["dynamic_position_rms"].value < 0.9e-3
    assert found["absolute_position_rms"].value < 0.2e-3


def test_the_same_seed_gives_the_same_motion(tmp_path: Path) -> None:
    text = PROCEDURE.replace("laps = 2", "laps = 1").replace("captures_hz = 3.0", "captures_hz = 1.0")
    lines = []
    for name in ("one", "other"):
        set_up = replace(set_up_of(tmp_path / name, text), noise_seed=7)
        result = sweep(set_up, tmp_path / name / "runs", keep="none")
        records = [json.loads(line) for line in (result.path / "samples.jsonl").read_text().splitlines()]
        lines.append([{key: value for key, value in record.items() if key != "stage_s"} for record in records])
    assert lines[0] == lines[1]


def test_an_interruption_in_motion_stops_first_and_keeps_what_was_taken(tmp_path: Path) -> None:
    set_up = set_up_of(tmp_path)
    twins: list[SimulatedBench] = []

    def impatient(event: Event) -> None:
        if isinstance(event, StageAdvanced) and event.stage == "motion" and event.done == 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep(set_up, tmp_path / "runs", keep="none", on_bench=twins.append, sink=impatient)
    (path,) = (tmp_path / "runs").iterdir()
    run = read_run(path)
    assert run.ended == "interrupted"
    assert "the position is still known" in run.end_reason
    assert sum(sample.is_moving for sample in run.samples) >= 6
    now_ns = twins[0].clock.now_ns()
    assert not twins[0].device.velocity_at(now_ns).any()
    with pytest.raises(RunError, match="begin a new run"):
        resume(run, read_setup_of(run))


FOUR = """
schema = 1
name = "four"
pattern = "trajectory"
feed_mm_min = 2700.0
order = "as_written"
register = 0.6
[trajectory]
path = [
    { X_mm = -340.0, Y_mm = -160.0, Z_mm = -50.0 },
    { X_mm = -60.0, Y_mm = -160.0, Z_mm = -50.0 },
    { X_mm = -60.0, Y_mm = -160.0, Z_mm = -270.0 },
    { X_mm = -340.0, Y_mm = -160.0, Z_mm = -270.0 },
]
dwell_s = 0.8
captures_hz = 3.0
hold_s = 20.0
around = { X_mm = 120.0, Y_mm = 60.0, Z_mm = 100.0 }
"""
BY_NAME = 'beacons = ["tetra_blue", "tetra_red", "tetra_green", "tetra_blue_2"]\n'


@pytest.fixture(scope="module", params=["by place", "by name, corrected"])
def four(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Run, SimulatedBench, list[Event]]:
    """The way past four beacons."""
    folder = tmp_path_factory.mktemp("four")
    text = FOUR if request.param == "by place" else FOUR + BY_NAME + "correct = true\ncorrection_limit_mm = 15.0\n"
    twins: list[SimulatedBench] = []
    events: list[Event] = []
    set_up = set_up_of(folder, text, "bench_maneuvers.toml")
    result = sweep(set_up, folder / "runs", keep="none", on_bench=twins.append, sink=events.append)
    return read_run(result.path), twins[0], events


def test_no_pose_is_of_a_wrong_beacon_and_hand_overs_stay_within_their_doubt(
    four: tuple[Run, SimulatedBench, list[Event]],
) -> None:
    run, twin, events = four
    quality = handover_quality(run, twin, hold_s=20.0)
    assert quality.wrong_count == 0
    assert quality.handover_count == 3
    # Root mean square of six components over the stated sigma: 1 in 10000 honest steps is beyond 2.1.
    assert quality.worst_step_sigmas < 2.1
    # The survey's doubt of 0.2 mm an axis and twice the sensor's noise over the lever to the group's origin.
    assert quality.worst_step_m < 3e-3
    assert quality.unflagged_count == 0
    if any(isinstance(event, Remark) and "corrected" in event.text for event in events):
        # The beacon changes at the end of each way, which is missed and held.
        assert quality.held_count > 3
    active = [sample.active for sample in run.samples if sample.active]
    assert list(dict.fromkeys(active)) == ["tetra_blue", "tetra_red", "tetra_green", "tetra_blue_2"]
    switched = [sample for sample in run.samples if sample.switched]
    assert len(switched) >= 3


def test_lights_of_other_beacons_are_not_taken_for_those_of_the_frame(
    four: tuple[Run, SimulatedBench, list[Event]],
) -> None:
    run, _, _ = four
    assert run.has_several_beacons
    obs = observations_from_run(run)
    is_own = np.array([sample.outcome.beacon == "tetra_blue" for sample in run.samples])
    assert np.isfinite(obs.led_px[is_own & obs.is_solved]).all()
    assert np.isnan(obs.led_px[~is_own]).all()
    # The pose of every one is in the frame of the first.
    assert obs.is_solved[~is_own].sum() > 20
    with pytest.raises(RunError, match="several beacons"):
        run_captures(run)


def test_corrections_take_away_what_the_bench_file_gets_wrong(four: tuple[Run, SimulatedBench, list[Event]]) -> None:
    run, _, events = four
    said = [event.text for event in events if isinstance(event, Remark) and "corrected" in event.text]
    if "correct = true" not in (run.path / "setup" / "procedure.toml").read_text():
        assert not said
        return
    sizes = [
        np.linalg.norm([float(word) for word in text.replace("mm", "").split() if word[0] in "+-"]) for text in said
    ]
    assert len(sizes) == 3
    # The camera truly sits 7 mm and 1.3 deg off, which is 14 mm at half a metre; later places differ by what is left
    # of the angles over 0.3 m of way.
    assert sizes[0] > 8.0
    assert max(sizes[1:]) < 6.0


def test_a_beacon_of_the_same_hue_elsewhere_is_not_taken_for_this_one(tmp_path: Path) -> None:
    set_up = set_up_of(tmp_path, FOUR, "bench_maneuvers.toml")
    with open_rig(set_up, EarlyLog()) as rig:
        rig.gantry.home()
        here = rig.gantry.move_to(np.array([-0.34, -0.16, -0.05]), 0.045).position
        capture = rig.camera.grab()
        group = rig.sensor
    assert capture is not None
    assert isinstance(group, GroupSensor)
    assert group.nearest(here) == "tetra_blue"
    assert isinstance(group.look(capture, here, "tetra_blue").outcome, PoseEstimate)
    second = group.look(capture, here, "tetra_blue_2").outcome
    assert isinstance(second, Miss)
    assert (second.stage, second.reason) == ("validate", "not_this_beacon")
    with pytest.raises(ConfigError, match="unknown beacon 'tetra_white'"):
        group.look(capture, here, "tetra_white")


def test_a_bench_with_several_beacons_must_say_roughly_how_it_stands(tmp_path: Path) -> None:
    text = (ROOT / "calib" / "bench_maneuvers.toml").read_text()
    for folder in ("cameras", "beacons"):
        text = text.replace(f'"{folder}/', f'"{ROOT}/calib/{folder}/')
    start, end = text.index("[standing]"), text.index("# The others")
    (tmp_path / "bench.toml").write_text(text[:start] + text[end:])
    (tmp_path / "procedure.toml").write_text(FOUR)
    with pytest.raises(ConfigError, match="required") as caught:
        read_setup(tmp_path / "procedure.toml", tmp_path / "bench.toml")
    assert caught.value.key == "standing"
    (tmp_path / "procedure.toml").write_text(FOUR + BY_NAME.replace("tetra_red", "tetra_rad"))
    (tmp_path / "bench.toml").write_text(text)
    with pytest.raises(ConfigError, match="no beacon 'tetra_rad'"):
        read_setup(tmp_path / "procedure.toml", tmp_path / "bench.toml")
