"""Whatever the sensor says, no command exceeds a limit; a constant velocity of the leader leaves no error."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.navigation.follower import FollowerConfig, follow_step, rest_command
from uvgs_bench.navigation.pose_filter import SmoothedPose
from uvgs_bench.units import ns_from_s

STATION = Pose(np.eye(3), [0.0, 0.0, -0.5], "beacon", "body")
numbers = st.floats(-1e3, 1e3)
vectors = st.tuples(numbers, numbers, numbers)
seen = st.tuples(vectors, vectors, st.tuples(*[st.floats(-3.0, 3.0)] * 3), vectors)
ticks = st.lists(
    st.tuples(st.none() | seen, st.booleans(), st.floats(1e-3, 0.1), st.floats(0.0, 1.0)), min_size=1, max_size=30
)


@given(ticks)
def test_no_pose_makes_a_command_beyond_a_limit(steps):
    law = FollowerConfig()
    command, t_s = rest_command(0, law), 0.0
    for pose, is_fresh, dt_s, age_s in steps:
        t_s += dt_s
        line = None
        if pose is not None:
            place, velocity, turn, rate = (np.array(part) for part in pose)
            line = SmoothedPose(
                ns_from_s(t_s - age_s), Pose(so3_exp(turn), place, "beacon", "body"), velocity, rate, 5, 0.1, np.ones(3)
            )
        command = follow_step(command, line, is_fresh, ns_from_s(t_s), STATION, law)
        # A part in 1e12 is rounding.
        assert np.linalg.norm(command.acceleration_mps2) <= law.acceleration_mps2 * (1.0 + 1e-12)
        assert np.linalg.norm(command.angular_acceleration_radps2) <= law.angular_acceleration_radps2 * (1.0 + 1e-12)
        for later_s in (0.0, 0.5 * law.valid_s, law.valid_s, 5.0):
            velocity, rate = command.twist_at(command.t_ns + ns_from_s(later_s))
            assert np.linalg.norm(velocity) <= law.speed_mps * (1.0 + 1e-9)
            assert np.linalg.norm(rate) <= law.rate_radps * (1.0 + 1e-9)


@settings(max_examples=8)
@given(st.tuples(*[st.floats(-0.05, 0.05)] * 3), st.tuples(*[st.floats(-0.3, 0.3)] * 3))
def test_a_leader_of_constant_velocity_is_followed_without_an_error(leader_mps, start_m):
    law = FollowerConfig(dead_band_m=0.0)
    period_s, place, velocity = 0.05, np.array(start_m), np.zeros(3)
    command = rest_command(0, law)
    for k in range(600):
        off, slip = place - k * period_s * np.array(leader_mps), velocity - np.array(leader_mps)
        line = SmoothedPose(
            ns_from_s(k * period_s),
            Pose(np.eye(3), STATION.t_m + off, "beacon", "body"),
            slip,
            np.zeros(3),
            5,
            0.0,
            np.ones(3),
        )
        command = follow_step(command, line, True, ns_from_s(k * period_s), STATION, law)
        push = command.acceleration_mps2
        place = place + period_s * velocity + 0.5 * period_s**2 * push
        velocity = velocity + period_s * push
    # After 30 s: 1e-6 m is far below a dead band, and what exponentials of 1.5 rad/s leave.
    assert np.linalg.norm(off) < 1e-6
    assert np.linalg.norm(slip) < 1e-6
