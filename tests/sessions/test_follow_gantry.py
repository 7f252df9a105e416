"""The gantry as follower: whatever poses the sensor gives, it stays homed, inside, and still after an alarm."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.follow_poses import estimate
from tests.helpers.sim_bench import write_bench
from uvgs_bench.devices.sim.bench import live_benches, simulated_bench
from uvgs_bench.devices.sim.follow_scene import LedBench
from uvgs_bench.errors import GantryAlarm, RegistrationError, UvgsError
from uvgs_bench.geometry import Pose
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.outcome import Miss, Outcome, PoseEstimate
from uvgs_bench.sessions import follow_gantry
from uvgs_bench.sessions.follow_scenario import FollowPlace, FollowScenario, LeaderPlan
from uvgs_bench.sessions.follow_setup import FollowSetUp, read_follow_setup
from uvgs_bench.store.follow_runs import read_follow_run

_MOVE = re.compile(r"(?:\$J=)?.*?X(-?[\d.]+)Y(-?[\d.]+)Z(-?[\d.]+)")
_AXES_MM = ((-400.0, 0.0), (-320.0, 0.0), (-320.0, 0.0))


class RandomSensor:
    """Truth until the leader goes, then whatever a seed says: wild, wandering, missing, true."""

    seed = 0

    def __init__(self, *_: object) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.drift = np.zeros(3)

    def warm_up(self) -> None:
        """Nothing to compile."""

    def solve(self, capture: Capture, prior: PoseEstimate | None = None) -> Outcome:
        bench = simulated_bench(live_benches()[-1])
        assert isinstance(bench, LedBench)
        true = bench.true_camera_from_beacon(capture.t_ns)
        if bench._path is None:
            return estimate(true, capture.t_ns)
        self.drift = self.drift + 0.03 * self.rng.standard_normal(3)
        kind = self.rng.integers(8)
        if kind == 0:
            return Miss("blobs", "too_few_blobs", "", capture.t_ns, "b")
        scale = 10.0 ** self.rng.uniform(-4, 4) if kind == 1 else 0.0
        place = true.t_m + self.drift + scale * self.rng.standard_normal(3)
        turned = Pose.exp(np.concatenate((self.rng.uniform(-3, 3, 3) * (kind == 2), np.zeros(3))), "camera", "camera")
        spread = np.eye(6) * 10.0 ** self.rng.uniform(-12, 2)
        return estimate(Pose(turned.R @ true.R, place, "camera", "beacon"), capture.t_ns, spread)


def set_up(tmp_path: Path, port: str = "grbl:sim://", seconds: float = 3.0) -> FollowSetUp:
    bench = write_bench(tmp_path)
    bench.write_text(bench.read_text().replace('port = "grbl:sim://"', f'port = "{port}"'))
    places = (FollowPlace(), FollowPlace((30.0, 0.0, 0.0)))
    scenario = FollowScenario("random", LeaderPlan(places, speed_mm_s=20.0), tail_s=seconds - 2.0, rate_hz=10.0)
    return read_follow_setup(scenario, bench)


@pytest.fixture
def wire(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Everything on the wire of the sessions of a test: direction and text."""
    heard: list[tuple[str, str]] = []
    opened = follow_gantry.open_gantry

    def listening(*args: object, **options: object):
        options["log"] = lambda _t_ns, direction, text: heard.append((direction, text))
        return opened(*args, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(follow_gantry, "open_gantry", listening)
    return heard


def check_wire(heard: list[tuple[str, str]]) -> int:
    """Moves only after homing, only inside, and none after an alarm. How many moves there were."""
    is_homed = was_asked = is_alarmed = False
    moves = 0
    for direction, text in heard:
        if direction == "<":
            is_alarmed |= text.startswith("ALARM") or "<Alarm" in text
            is_homed |= was_asked and text == "ok"
            continue
        if direction != ">":
            continue
        if text.startswith("$H"):
            was_asked, is_alarmed = True, False
        found = _MOVE.match(text) if "X" in text and not text.startswith("$1") else None
        if found:
            moves += 1
            assert is_homed, text
            assert not is_alarmed, text
            for value, (low, high) in zip(found.groups(), _AXES_MM, strict=True):
                # Three decimals of a millimetre are told.
                assert low - 5e-4 <= float(value) <= high + 5e-4, text
    return moves


@pytest.mark.parametrize("seed", range(4))
def test_no_poses_drive_it_out_of_its_envelope(
    seed: int, tmp_path: Path, wire: list[tuple[str, str]], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(RandomSensor, "seed", seed)
    monkeypatch.setattr(follow_gantry, "Uvgs", RandomSensor)
    result = follow_gantry.follow_with_gantry(set_up(tmp_path), tmp_path / "out")
    assert check_wire(wire) > 10
    assert result.run.ending in ("completed", "aborted")
    for cycle in result.run.cycles:
        place_mm = 1000.0 * cycle.body.t_m
        # The simulated carriage has a scale error of 100 ppm and leaning axes of 0.2 mrad: 0.2 mm in 400.
        assert all(low - 0.2 <= v <= high + 0.2 for v, (low, high) in zip(place_mm, _AXES_MM, strict=True))


@pytest.mark.parametrize("seed", range(3))
def test_after_an_alarm_nothing_moves_and_the_record_says_why(
    seed: int, tmp_path: Path, wire: list[tuple[str, str]], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(RandomSensor, "seed", seed)
    monkeypatch.setattr(follow_gantry, "Uvgs", RandomSensor)
    with pytest.raises(UvgsError) as raised:
        follow_gantry.follow_with_gantry(
            set_up(tmp_path, f"grbl:fault+sim://?alarm=0.02&seed={seed}", 20.0), tmp_path / "out"
        )
    check_wire(wire)
    assert any("ALARM" in text or "Alarm" in text for direction, text in wire if direction == "<")
    assert isinstance(raised.value, GantryAlarm) or "larm" in str(raised.value)
    for folder in (tmp_path / "out").glob("*"):
        run = read_follow_run(folder)
        assert run.ending == "failed"
        assert run.reason


def test_axes_that_do_not_move_the_beacon_as_they_say_are_refused(
    tmp_path: Path, wire: list[tuple[str, str]], monkeypatch: pytest.MonkeyPatch
):
    class Stuck(RandomSensor):
        def solve(self, capture: Capture, prior: PoseEstimate | None = None) -> Outcome:
            return estimate(Pose(np.eye(3), [0.0, 0.0, 0.9], "camera", "beacon"), capture.t_ns)

    monkeypatch.setattr(follow_gantry, "Uvgs", Stuck)
    with pytest.raises(RegistrationError, match=r"axis X moved by 10\.0 mm and the beacon by 0\.0 mm"):
        follow_gantry.follow_with_gantry(set_up(tmp_path), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.opencv
def test_with_the_real_sensor_it_follows(tmp_path: Path, wire: list[tuple[str, str]]):
    result = follow_gantry.follow_with_gantry(set_up(tmp_path, seconds=6.0), tmp_path / "out")
    assert result.run.ending == "completed"
    assert result.quality.pose_share > 0.9
    # A start and a stop at 30 mm/s^2 with a loop of 1.5 rad/s: 13 mm, and the carriage's own lateness.
    assert result.quality.worst_m < 0.025
    # At rest again: a dead band of 0.5 mm, backlash, and what is left of the transient after 3 s.
    assert float(np.linalg.norm(result.run.cycles[-1].body.t_m - result.run.cycles[-1].leader.t_m)) < 0.004
