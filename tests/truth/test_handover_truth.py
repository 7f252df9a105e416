"""Two beacons in one picture: no light serves both, and a repeated pose is never passed off as fresh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.beacon import Beacon, Led
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import Pose
from uvgs_bench.sensor import Capture, Miss, PoseEstimate, Uvgs, UvgsConfig
from uvgs_bench.sensor.handover import (
    HandoverPolicy,
    HandoverState,
    Held,
    hand_over,
    paint_over,
    solve_all,
)

MS = 1_000_000


def scaled(name: str, factor: float, turn: bool = False) -> Beacon:
    positions = spots.beacon().positions_m * factor
    if turn:
        positions = positions[:, [1, 0, 2]] * [1.0, -1.0, 1.15]
    axis = np.array([0.0, 0.0, -1.0])
    return Beacon(name, tuple(Led(f"led{i}", p, axis, np.radians(70.0), 0.005) for i, p in enumerate(positions)))


LARGE, SMALL = scaled("large", 1.4), scaled("small", 0.55, turn=True)


def two(rng: np.random.Generator) -> tuple[Capture, dict[str, Pose]]:
    """Both beacons side by side, facing within 30 degrees."""
    while True:
        poses = {}
        for name, x in (("large", -0.22), ("small", 0.2)):
            pose = spots.random_pose(rng, 30.0, 0.9, 1.3)
            poses[name] = Pose(pose.R, np.array([x * pose.t_m[2], pose.t_m[1], pose.t_m[2]]), "camera", "beacon")
        px = np.vstack([spots.lens().project(poses[b.name].apply(b.positions_m)) for b in (LARGE, SMALL)])
        apart = np.linalg.norm(px[:, None] - px[None], axis=2)[np.triu_indices(8, 1)]
        if apart.min() > 12.0 and spots.lens().contains(px, 20.0).all():
            return Capture(spots.draw(px, rng), 5), poses


def test_two_beacons_are_never_mixed():
    rng = np.random.default_rng(21)
    sensors = {b.name: Uvgs(spots.calibration(), b) for b in (LARGE, SMALL)}
    solved = 0
    for _ in range(60):
        capture, poses = two(rng)
        outcomes = solve_all(capture, sensors)
        assert list(outcomes) == ["large", "small"]
        for name, outcome in outcomes.items():
            assert outcome.beacon == name
            if isinstance(outcome, PoseEstimate):
                solved += 1
                # 0.02 px at 1 m on the smaller beacon; another beacon's lights would be off by decimetres.
                assert outcome.camera_from_beacon.is_close(poses[name], 0.03, 0.02)
    assert solved >= 108


def test_lights_claimed_twice_serve_nobody():
    rng = np.random.default_rng(22)
    pose = spots.random_pose(rng)
    image = spots.draw(spots.lens().project(pose.apply(LARGE.positions_m)), rng)
    twins = {"one": Uvgs(spots.calibration(), LARGE), "two": Uvgs(spots.calibration(), replace(LARGE, name="two"))}
    outcomes = solve_all(Capture(image, 5), twins)
    assert all(isinstance(o, Miss) and o.reason == "shared_light" for o in outcomes.values())
    assert "two" in outcomes["one"].detail


def test_only_the_lights_named_are_painted_over():
    rng = np.random.default_rng(23)
    px = np.array([[100.0, 80.0], [118.0, 84.0], [40.0, 120.0]])
    image = spots.draw(px, rng, size=(200, 160))
    out = paint_over(image, px[:1])
    assert out[70:91, 90:110].max() < 20
    assert (out[110:130, 30:50] == image[110:130, 30:50]).all()
    assert out[84, 118] == image[84, 118]
    assert image[80, 100] > 150


def estimate(beacon: str, t_ns: int, range_m: float = 1.0, spread_m: float = 1e-3) -> PoseEstimate:
    pose = Pose(np.eye(3), np.array([0.0, 0.0, range_m]), "camera", "beacon")
    covariance = np.diag([1e-8, 1e-8, 1e-8, *[spread_m**2] * 3])
    return PoseEstimate(pose, covariance, t_ns, beacon, np.zeros((4, 2)), np.zeros((4, 2)), 0.1, 9.0, 4)


def missed(beacon: str, t_ns: int) -> Miss:
    return Miss("selection", "too_few_blobs", "", t_ns, beacon)


def test_a_held_pose_says_so_ages_and_ends():
    policy = HandoverPolicy("command", hold_s=0.25)
    state = HandoverState()
    first = estimate("a", 0)
    got = hand_over({"a": first}, state, policy, 0, command="a")
    assert got.answer is first
    for k in (1, 2):
        got = hand_over({"a": missed("a", 100 * k * MS)}, got.state, policy, 100 * k * MS)
        assert isinstance(got.answer, Held)
        assert not isinstance(got.answer, PoseEstimate)
        assert (got.answer.last, got.answer.age_ns) == (first, 100 * k * MS)
    got = hand_over({"a": missed("a", 300 * MS)}, got.state, policy, 300 * MS)
    assert isinstance(got.answer, Miss)
    fresh = estimate("a", 400 * MS)
    assert hand_over({"a": fresh}, got.state, policy, 400 * MS).answer is fresh


def test_a_pose_of_another_beacon_is_never_held():
    policy = HandoverPolicy("command", hold_s=10.0)
    got = hand_over({"a": estimate("a", 0), "b": missed("b", 0)}, HandoverState(), policy, 0, command="a")
    got = hand_over({"a": missed("a", 1), "b": missed("b", 1)}, got.state, policy, 1, command="b")
    assert (got.active, got.switched) == ("b", "commanded")
    assert isinstance(got.answer, Miss)
    # Back at a, its old pose is gone too: it belongs to the time before.
    got = hand_over({"a": missed("a", 2), "b": missed("b", 2)}, got.state, policy, 2, command="a")
    assert isinstance(got.answer, Miss)


def test_command_mode_waits_and_obeys():
    policy = HandoverPolicy("command")
    both = {"a": estimate("a", 0), "b": estimate("b", 0, spread_m=1e-6)}
    got = hand_over(both, HandoverState(), policy, 0)
    assert got.active is None
    assert isinstance(got.answer, Miss)
    assert got.answer.reason == "no_active_beacon"
    got = hand_over(both, got.state, policy, 0, command="a")
    for _ in range(5):
        got = hand_over(both, got.state, policy, 0)
        assert (got.active, got.switched) == ("a", "")


def test_quality_switches_after_patience_and_not_for_a_little():
    policy = HandoverPolicy("quality", advantage=0.2, patience=3)
    got = hand_over({"a": estimate("a", 0), "b": missed("b", 0)}, HandoverState(), policy, 0)
    assert (got.active, got.switched) == ("a", "first seen")
    little = {"a": estimate("a", 0, spread_m=1.0e-3), "b": estimate("b", 0, spread_m=0.9e-3)}
    clear = {"a": estimate("a", 0, spread_m=1.0e-3), "b": estimate("b", 0, spread_m=0.5e-3)}
    active = []
    for outcomes in (little, little, little, little, clear, clear, little, clear, clear, clear):
        got = hand_over(outcomes, got.state, policy, 0)
        active.append(got.active)
    assert active == ["a"] * 9 + ["b"]
    assert got.answer is clear["b"]


def test_position_follows_the_zones_with_hysteresis():
    policy = HandoverPolicy("position", {"far": (1.0, 9.0), "near": (0.0, 1.0)}, advantage=0.1, patience=1)
    state, active = HandoverState(), []
    for range_m in (2.0, 1.05, 0.95, 0.85, 0.95, 1.05, 1.2):
        outcomes = {"far": estimate("far", 0, range_m), "near": estimate("near", 0, range_m)}
        got = hand_over(outcomes, state, policy, 0)
        state = got.state
        active.append(got.active)
    assert active == ["far", "far", "far", "near", "near", "near", "far"]


def test_position_without_zones_takes_the_nearest():
    policy = HandoverPolicy("position", patience=1, advantage=0.1)
    outcomes = {"a": estimate("a", 0, 1.0), "b": estimate("b", 0, 0.95)}
    got = hand_over(outcomes, HandoverState("a"), policy, 0)
    assert got.active == "a"
    assert hand_over({**outcomes, "b": estimate("b", 0, 0.5)}, got.state, policy, 0).active == "b"


def test_a_lost_beacon_hands_over_only_when_its_pose_is_too_old():
    policy = HandoverPolicy("quality", hold_s=0.15)
    got = hand_over({"a": estimate("a", 0), "b": missed("b", 0)}, HandoverState(), policy, 0)
    at_100 = {"a": missed("a", 100 * MS), "b": estimate("b", 100 * MS)}
    got = hand_over(at_100, got.state, policy, 100 * MS)
    assert (got.active, type(got.answer)) == ("a", Held)
    at_200 = {"a": missed("a", 200 * MS), "b": estimate("b", 200 * MS)}
    got = hand_over(at_200, got.state, policy, 200 * MS)
    assert (got.active, got.switched) == ("b", "the active beacon is lost")
    assert got.answer is at_200["b"]


def test_unknown_names_are_refused():
    outcomes = {"a": estimate("a", 0)}
    with pytest.raises(ConfigError, match="unknown beacon 'c'"):
        hand_over(outcomes, HandoverState(), HandoverPolicy(), 0, command="c")
    with pytest.raises(ConfigError, match="at least one"):
        hand_over({}, HandoverState(), HandoverPolicy(), 0)
    with pytest.raises(ValueError, match="zone"):
        HandoverPolicy("position", {"a": (2.0, 1.0)})
    assert UvgsConfig().max_blobs >= 8
