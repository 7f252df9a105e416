"""The follower law: modes by age, directions of commands, patience."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.geometry import Pose
from uvgs_bench.navigation.follower import FollowCommand, FollowerConfig, follow_step, rest_command
from uvgs_bench.navigation.pose_filter import SmoothedPose
from uvgs_bench.units import ns_from_s

LAW = FollowerConfig()
STATION = Pose(np.eye(3), [0.0, 0.0, -0.5], "beacon", "body")


def seen(
    t_s: float,
    off_m: object = (0.0, 0.0, 0.0),
    velocity_mps: object = (0.0, 0.0, 0.0),
    turn_rad: object = (0.0, 0.0, 0.0),
) -> SmoothedPose:
    xi = np.concatenate((np.asarray(turn_rad, dtype=np.float64), np.zeros(3)))
    R = STATION.R @ Pose.exp(xi, "body", "body").R
    place = STATION.t_m + np.asarray(off_m, dtype=np.float64)
    velocity = np.asarray(velocity_mps, dtype=np.float64)
    return SmoothedPose(
        ns_from_s(t_s), Pose(R, place, "beacon", "body"), velocity, np.zeros(3), 5, 0.1, np.full(3, 1e-3)
    )


def step(last: FollowCommand, pose: SmoothedPose | None, t_s: float, fresh: bool = True, law: FollowerConfig = LAW):
    return follow_step(last, pose, fresh, ns_from_s(t_s), STATION, law)


def test_near_the_station_it_is_proportional_and_derivative():
    law = replace(LAW, dead_band_m=0.0)
    command = step(rest_command(0, law), seen(0.0, (0.004, 0.0, 0.0), (0.0, 0.002, 0.0)), 0.01, law=law)
    w, zeta = law.frequency_radps, law.damping
    np.testing.assert_allclose(command.acceleration_mps2, [-w * w * 0.004, -2.0 * zeta * w * 0.002, 0.0], atol=1e-12)
    assert command.mode == "following"
    np.testing.assert_allclose(command.error_m, [0.004, 0.0, 0.0], atol=1e-15)


def test_within_the_dead_band_only_velocity_is_damped():
    command = step(rest_command(0, LAW), seen(0.0, (0.8 * LAW.dead_band_m, 0.0, 0.0)), 0.01)
    assert not command.acceleration_mps2.any()


def test_commands_come_in_axes_of_the_body():
    turned = seen(0.0, (0.05, 0.0, 0.0), turn_rad=(0.0, 0.0, np.pi / 2.0))
    push = step(rest_command(0, LAW), turned, 0.01).acceleration_mps2
    # The body's y axis points against the leader's x axis: towards the station.
    assert push[1] > 0.01
    assert abs(push[0]) < 1e-12


def test_attitude_is_turned_back():
    command = step(rest_command(0, LAW), seen(0.0, turn_rad=(0.0, 0.05, 0.0)), 0.01)
    assert command.angular_acceleration_radps2[1] < 0.0
    np.testing.assert_allclose(command.error_rad, [0.0, 0.05, 0.0], atol=1e-12)


def test_without_a_pose_it_holds_then_brakes_then_gives_up_for_good():
    command = replace(rest_command(0, LAW), velocity_mps=np.array([0.05, 0.0, 0.0]), mode="following")
    modes, speeds, ages = [], [], []
    for k in range(1, 130):
        command = step(command, seen(0.0), 0.05 * k, fresh=False)
        modes.append(command.mode)
        speeds.append(float(np.linalg.norm(command.velocity_mps)))
        ages.append(command.age_s)
    assert list(dict.fromkeys(modes)) == ["holding", "braking", "aborted"]
    assert modes.count("holding") == round(LAW.hold_s / 0.05)
    np.testing.assert_allclose(speeds[: modes.count("holding")], 0.05, atol=1e-15)
    assert speeds[-1] < 1e-6
    np.testing.assert_allclose(ages, 0.05 * np.arange(1, 130), atol=1e-9)
    assert step(command, seen(6.5), 6.5).mode == "aborted"


def test_a_fresh_pose_ends_the_braking():
    command = step(rest_command(0, LAW), seen(0.0), 0.01)
    command = step(command, seen(0.0), 1.0, fresh=False)
    assert command.mode == "braking"
    assert step(command, seen(1.0), 1.05).mode == "following"


def test_a_pose_older_than_its_patience_is_not_fresh():
    command = step(rest_command(0, LAW), seen(0.0), 0.01)
    assert step(command, seen(0.1), 0.1 + 2.0 * LAW.hold_s).mode == "braking"


def test_before_the_first_pose_it_waits_at_rest_and_at_last_gives_up():
    command = rest_command(0, LAW)
    for k in range(1, 20):
        command = step(command, None, 0.25 * k, fresh=False)
        assert command.mode == "waiting"
        assert not command.acceleration_mps2.any()
    assert step(command, None, LAW.abort_s + 0.1, fresh=False).mode == "aborted"


def test_a_turning_body_keeps_its_velocity_in_space():
    command = replace(
        rest_command(0, LAW), velocity_mps=np.array([0.1, 0.0, 0.0]), rate_radps=np.array([0.0, 0.0, np.pi])
    )
    velocity, rate = command.twist_at(ns_from_s(0.5))
    np.testing.assert_allclose(velocity, [0.0, -0.1, 0.0], atol=1e-12)
    np.testing.assert_allclose(rate, [0.0, 0.0, np.pi], atol=1e-15)


def test_a_command_with_garbage_cannot_be_made():
    with pytest.raises(ValueError, match="finite"):
        replace(rest_command(0, LAW), acceleration_mps2=np.array([np.nan, 0.0, 0.0]))
    with pytest.raises(ValueError, match="finite"):
        seen(0.0, (np.inf, 0.0, 0.0))


@pytest.mark.parametrize(
    "change", [{"frequency_radps": 0.0}, {"speed_mps": -1.0}, {"valid_s": float("nan")}, {"abort_s": 0.1}]
)
def test_limits_that_cannot_be_meant_are_refused(change: dict[str, float]):
    with pytest.raises(ValueError, match="must"):
        FollowerConfig(**change)
