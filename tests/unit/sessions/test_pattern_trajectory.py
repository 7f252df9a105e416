"""The pattern trajectory: what it demands, what it makes of the bench's limits, and the shipped maneuvers."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uvgs_bench.devices.gantry.axes import Axis, Envelope
from uvgs_bench.errors import ConfigError, EnvelopeError
from uvgs_bench.sensor.pace import Pace
from uvgs_bench.sessions.beacon_group import check_group
from uvgs_bench.sessions.pattern_trajectory import TrajectoryPattern
from uvgs_bench.sessions.planning import plan
from uvgs_bench.sessions.procedure import Procedure, read_procedure
from uvgs_bench.store.beacons import read_beacon
from uvgs_bench.store.bench import read_bench

ROOT = Path(__file__).parents[3]
AXES = tuple(Axis(name, "linear", np.eye(3)[i], -0.3, 0.0, 0.05, 0.2) for i, name in enumerate("XYZ"))
SQUARE = [{"X_mm": x, "Y_mm": 0.0, "Z_mm": z} for x, z in ((-50, -50), (50, -50), (50, 50), (-50, 50), (-50, -50))]
AROUND = {"X_mm": 60.0, "Y_mm": 40.0, "Z_mm": 60.0}


def procedure(pattern: TrajectoryPattern, feed_mps: float = 0.04) -> Procedure:
    return Procedure("try", pattern, feed_mps, origin="centre", order="as_written", register=0.6)


def test_places_at_rest_are_a_box_and_the_motion_follows_them() -> None:
    made = plan(procedure(TrajectoryPattern(SQUARE, AROUND, blend_mm=10.0, laps=2)), Envelope(AXES))
    motion = made.motion
    assert motion is not None
    assert made.waypoint_count == 15
    assert made.register_waypoint_count == 9
    # The end of a closed lap is the begin of the next.
    assert motion.numbers == (0, 1, 2, 3, 4, 1, 2, 3, 4)
    np.testing.assert_allclose(motion.points[0].position, [-0.2, -0.15, -0.2])
    # 7 of 8 corners are passed without a stop, also that of the second lap's begin: 0.8 m at 40 mm/s, one ramp of
    # 100 mm/s^2 up and down. Corners of 10 mm bear 26.6 mm/s at 100 mm/s^2 an axis, so it takes a little longer.
    assert 20.4 < motion.duration_s < 24.0
    assert made.capture_count == 15 + round(10.0 * motion.duration_s)


def test_a_motion_keeps_something_to_spare_of_what_the_axes_may() -> None:
    made = plan(procedure(TrajectoryPattern(SQUARE, AROUND), feed_mps=1.0), Envelope(AXES))
    assert made.motion is not None
    path = made.motion.trajectory()
    assert np.abs(path.velocity).max() <= 0.9 * 0.05 + 1e-12
    assert np.abs(path.acceleration).max() <= 0.5 * 0.2 + 1e-12


def test_the_plan_hash_knows_the_motion() -> None:
    hashes = {
        plan(procedure(TrajectoryPattern(SQUARE, AROUND, **more)), Envelope(AXES)).plan_hash  # type: ignore[arg-type]
        for more in ({}, {"blend_mm": 5.0}, {"dwell_s": 1.0}, {"laps": 2}, {"captures_hz": 3.0})
    }
    assert len(hashes) == 5


@pytest.mark.parametrize(
    ("changed", "key"),
    [
        ({"path": SQUARE[:1]}, "trajectory.path"),
        ({"path": [{"X_mm": 0.0, "Q_mm": 1.0}, SQUARE[0]]}, "trajectory.path.0.Q_mm"),
        ({"around": {}}, "trajectory.around"),
        ({"dwell_s": [1.0]}, "trajectory.dwell_s"),
        ({"dwell_s": -1.0}, "trajectory.dwell_s"),
        ({"blend_mm": float("nan")}, "trajectory.blend_mm"),
        ({"laps": 0}, "trajectory.laps"),
        ({"captures_hz": 0.0}, "trajectory.captures_hz"),
        ({"beacons": ["a"]}, "trajectory.beacons"),
        ({"correct": True}, "trajectory.correct"),
        ({"hold_s": -1.0}, "trajectory.hold_s"),
        ({"acceleration_mm_s2": 0.0}, "trajectory.acceleration_mm_s2"),
    ],
)
def test_what_cannot_be_meant_is_named(changed: dict[str, object], key: str) -> None:
    pattern = replace(TrajectoryPattern(SQUARE, AROUND), **changed)  # type: ignore[arg-type]
    with pytest.raises(ConfigError) as caught:
        plan(procedure(pattern), Envelope(AXES))
    assert caught.value.key == key


def test_a_path_outside_or_through_a_keep_out_box_is_refused() -> None:
    far = [*SQUARE, {"X_mm": 200.0, "Y_mm": 0.0, "Z_mm": 0.0}]
    with pytest.raises(EnvelopeError, match="place 5 of the path"):
        plan(procedure(TrajectoryPattern(far, AROUND)), Envelope(AXES))
    # In the middle of the first side, beside every place and every place at rest.
    near = dict.fromkeys(AROUND, 20.0)
    box = np.array([[-0.155, -0.155, -0.205], [-0.145, -0.145, -0.198]])
    with pytest.raises(EnvelopeError, match="on the path"):
        plan(procedure(TrajectoryPattern(SQUARE, near)), Envelope(AXES, (box,)))


@pytest.mark.parametrize("path", sorted((ROOT / "procedures").glob("svgs_*.toml")), ids=lambda path: path.stem)
def test_a_shipped_maneuver_fits_its_bench(path: Path) -> None:
    named = re.search(r"--bench (calib/\w+\.toml)", path.read_text())
    bench = read_bench(ROOT / (named[1] if named else "calib/bench.toml"))
    found = read_procedure(path)
    made = plan(found, bench.envelope)
    beacons = [read_beacon(Path(file)) for file in (bench.beacon_file, *(other.file for other in bench.others))]
    check_group(bench, made, beacons, str(path))
    assert found.description
    assert "aneuver" in found.description or "round test" in found.description
    assert (made.motion is None) == (found.name == "svgs_gt1")


def test_a_pace_takes_every_third_of_thirty_for_ten() -> None:
    pace = Pace(10.0)
    jitter = np.random.default_rng(1).uniform(-2e6, 2e6, 300)
    taken = [k for k in range(300) if pace.takes(int(k * 1e9 / 30.0 + jitter[k]))]
    assert taken == list(range(0, 300, 3))
    everything = Pace(0.0)
    assert all(everything.takes(k) for k in range(5))


def test_a_pace_goes_on_after_a_gap_and_after_a_clock_that_begins_anew() -> None:
    pace = Pace(10.0)
    assert [pace.takes(int(t * 1e9)) for t in (0.0, 0.05, 0.1, 3.0, 3.05, 3.1, 0.0, 0.05, 0.1)] == [
        True, False, True, True, False, True, True, False, True,
    ]  # fmt: skip
