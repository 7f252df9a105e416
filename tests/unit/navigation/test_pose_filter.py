"""The pose filter: exact on straight motion, deaf to outliers, never deaf for ever."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.follow_poses import estimate, relative
from uvgs_bench.errors import FrameMismatch
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_log
from uvgs_bench.navigation.pose_filter import (
    PoseFilterConfig,
    PoseMemory,
    RelativePose,
    line_weights,
    relative_pose,
    smoothed,
    take_pose,
)

CONFIG = PoseFilterConfig()


def fed(poses: list[RelativePose], config: PoseFilterConfig = CONFIG) -> tuple[PoseMemory, list[bool]]:
    memory, said = PoseMemory(), []
    for pose in poses:
        memory, accepted = take_pose(memory, pose, config)
        said.append(accepted)
    return memory, said


def test_a_constant_velocity_passes_without_delay():
    velocity, rate = np.array([0.05, -0.02, 0.01]), np.array([0.0, 0.0, 0.1])
    # Uneven instants, as when captures are lost.
    memory, said = fed([relative(t, velocity * t, rate * t) for t in (0.0, 0.05, 0.15, 0.2, 0.25, 0.4)])
    line = smoothed(memory, CONFIG)
    assert all(said)
    assert line is not None
    # Rounding of nanoseconds and of the line, m, m/s, rad, rad/s.
    np.testing.assert_allclose(line.leader_from_body.t_m, velocity * 0.4, atol=1e-9)
    np.testing.assert_allclose(line.velocity_mps, velocity, atol=1e-8)
    np.testing.assert_allclose(so3_log(line.leader_from_body.R), rate * 0.4, atol=1e-9)
    np.testing.assert_allclose(line.rate_radps, rate, atol=1e-8)
    assert line.count == 5
    # The middle of 0.05 0.15 0.2 0.25 0.4 lies 0.19 s before the last.
    assert line.velocity_delay_s == pytest.approx(0.19, abs=1e-9)


def test_an_outlier_is_refused_and_the_line_goes_on():
    poses = [relative(0.05 * k, (0.002 * k, 0.0, 0.0)) for k in range(6)]
    poses.insert(5, relative(0.24, (0.3, 0.0, 0.0)))
    memory, said = fed(poses)
    assert said == [True] * 5 + [False, True]
    line = smoothed(memory, CONFIG)
    assert line is not None
    assert line.leader_from_body.t_m[0] == pytest.approx(0.010, abs=1e-9)


def test_a_turned_outlier_is_refused_too():
    poses = [relative(0.05 * k) for k in range(5)]
    _, said = fed([*poses, relative(0.25, turn_rad=(0.0, 0.5, 0.0))])
    assert said[-1] is False


def test_a_jump_that_stays_is_believed_after_three():
    poses = [relative(0.05 * k) for k in range(5)]
    jumped = [relative(0.25 + 0.05 * k, (0.3, 0.0, 0.0)) for k in range(3)]
    memory, said = fed(poses + jumped)
    assert said[5:] == [False, False, True]
    assert len(memory.kept) == 3
    assert memory.refused == ()


def test_refused_poses_that_disagree_never_replace_the_memory():
    poses = [relative(0.05 * k) for k in range(5)]
    wild = [relative(0.25 + 0.05 * k, (0.3 * (-1) ** k, 0.0, 0.0)) for k in range(8)]
    memory, said = fed(poses + wild)
    assert not any(said[5:])
    assert memory.kept[-1].t_ns == poses[-1].t_ns


def test_old_poses_are_forgotten_and_too_few_give_nothing():
    memory, _ = fed([relative(0.0), relative(0.05), relative(0.1)])
    assert smoothed(memory, CONFIG) is not None
    memory, accepted = take_pose(memory, relative(5.0, (1.0, 0.0, 0.0)), CONFIG)
    assert accepted
    assert len(memory.kept) == 1
    assert smoothed(memory, CONFIG) is None


def test_a_pose_that_is_not_newer_is_refused():
    memory, _ = fed([relative(0.1)])
    again, accepted = take_pose(memory, relative(0.1, (0.1, 0.0, 0.0)), CONFIG)
    assert not accepted
    assert again is memory


def test_line_weights_are_those_of_least_squares():
    dt_s = np.array([-0.3, -0.17, -0.1, 0.0])
    values = np.array([1.0, 3.0, -2.0, 0.5])
    slope, value = np.polyfit(dt_s, values, 1)
    at, rate = line_weights(dt_s)
    assert at @ values == pytest.approx(value, abs=1e-12)
    assert rate @ values == pytest.approx(slope, abs=1e-11)


def test_the_doubt_of_the_follower_is_that_of_many_draws():
    rng = np.random.default_rng(3)
    camera_from_beacon = Pose.exp([0.3, -0.2, 0.1, 0.05, -0.02, 0.6], "camera", "beacon")
    body_from_camera = Pose.exp([0.1, 0.2, -0.4, 0.02, 0.0, 0.15], "body", "camera")
    spread = np.diag([2e-3, 3e-3, 1e-3, 2e-4, 1e-4, 8e-4]) ** 2
    told = relative_pose(estimate(camera_from_beacon, 7, spread), body_from_camera)
    draws = rng.multivariate_normal(np.zeros(6), spread, 20000)
    seen = [(body_from_camera @ camera_from_beacon.perturbed(xi)).inverse() for xi in draws]
    R = told.leader_from_body.R
    rows = np.array([[*so3_log(R.T @ s.R), *(s.t_m - told.leader_from_body.t_m)] for s in seen])
    # 20000 draws tell a standard deviation to 0.5 %; 3 % leaves room for what is not linear at 3 mrad.
    np.testing.assert_allclose(rows.std(axis=0), np.sqrt(np.diag(told.covariance)), rtol=0.03)
    correlation = np.corrcoef(rows.T)
    scale = np.sqrt(np.diag(told.covariance))
    np.testing.assert_allclose(correlation, told.covariance / np.outer(scale, scale), atol=0.03)
    assert told.t_ns == 7


def test_frames_that_do_not_meet_are_refused():
    with pytest.raises(FrameMismatch):
        relative_pose(estimate(Pose.identity("camera", "beacon"), 0), Pose.identity("body", "gantry"))


@pytest.mark.parametrize(
    "change", [{"window": 1}, {"reopen": 1}, {"settled": 9}, {"gate": 0.0}, {"span_s": float("nan")}]
)
def test_rules_that_cannot_be_meant_are_refused(change: dict[str, float]):
    with pytest.raises(ValueError, match="must be"):
        PoseFilterConfig(**change)


@given(st.lists(st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(0.01, 0.5)), min_size=1, max_size=40))
def test_it_never_grows_and_never_locks_out(steps: list[tuple[float, float, float]]):
    memory, t_s = PoseMemory(), 0.0
    for x_m, z_m, dt_s in steps:
        t_s += dt_s
        memory, _ = take_pose(memory, relative(t_s, (x_m, 0.0, z_m)), CONFIG)
        assert len(memory.kept) <= CONFIG.window
        assert len(memory.refused) < CONFIG.reopen
    # Whatever came before, a follower that then stands still is believed within `reopen` captures, or a span later.
    said = []
    for _ in range(CONFIG.reopen + 1):
        t_s += 0.05
        memory, accepted = take_pose(memory, relative(t_s, (9.0, 0.0, 0.0)), CONFIG)
        said.append(accepted)
    assert said[-1]
