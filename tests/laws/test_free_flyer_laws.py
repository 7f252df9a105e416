"""The free-flyer: momentum and energy are kept, thrusters are limited and pulsed, the table holds and brakes it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uvgs_bench.devices.follow_link import BodyState
from uvgs_bench.devices.sim.free_flyer import FlyerConfig, FreeFlyer
from uvgs_bench.geometry import Pose
from uvgs_bench.navigation.follower import FollowerConfig, rest_command
from uvgs_bench.units import ns_from_s

IDEAL = FlyerConfig(impulse_n_s=0.0, angular_impulse_n_m_s=0.0, velocity_error_mps=0.0, rate_error_radps=0.0)
STEP_NS = ns_from_s(0.01)
NONE = np.zeros(3)
rates = st.tuples(*[st.floats(-1.0, 1.0)] * 3)


def body(velocity: object = NONE, rate: object = NONE) -> BodyState:
    v, w = np.array(velocity, dtype=np.float64), np.array(rate, dtype=np.float64)
    return BodyState(0, Pose.identity("world", "body"), v, w)


@settings(max_examples=10)
@given(rates, rates)
def test_without_thrust_momentum_and_energy_are_kept(velocity, rate):
    inertia = np.array(IDEAL.inertia_kg_m2)
    start = body(velocity, rate)
    flyer = FreeFlyer(IDEAL, start)
    for _ in range(500):
        flyer.push(NONE, NONE, STEP_NS)
    end = flyer.state
    before = inertia * start.rate_radps
    # Rounding of 500 products of rotations.
    np.testing.assert_allclose(end.world_from_body.R @ (inertia * end.rate_radps), before, atol=1e-12)
    np.testing.assert_allclose(end.world_from_body.t_m, 5.0 * np.array(velocity), atol=1e-12)
    # The midpoint rule keeps the energy to the square of the step: 1e-4 of 1 rad/s times 10 ms squared, with room.
    energy, later = start.rate_radps @ before, end.rate_radps @ (inertia * end.rate_radps)
    assert later == pytest.approx(energy, rel=1e-4, abs=1e-12)


def test_a_constant_force_gives_the_parabola_and_is_limited():
    flyer = FreeFlyer(IDEAL, body())
    for _ in range(200):
        flyer.push(np.array([0.5, 0.0, 99.0]), NONE, STEP_NS)
    # 2 s of 0.5 N and of the limit 0.8 N on 10 kg.
    np.testing.assert_allclose(flyer.state.velocity_mps, [0.1, 0.0, 0.16], atol=1e-12)
    np.testing.assert_allclose(flyer.state.world_from_body.t_m, [0.1, 0.0, 0.16], atol=1e-12)


def test_small_wishes_wait_for_the_least_impulse():
    flyer = FreeFlyer(replace(IDEAL, impulse_n_s=0.01), body())
    speeds = []
    for _ in range(100):
        flyer.push(np.array([0.1, 0.0, 0.0]), NONE, STEP_NS)
        speeds.append(flyer.state.velocity_mps[0])
    steps = np.diff([0.0, *speeds])
    fired = steps[steps > 1e-15]
    # 0.1 N for 10 ms are 1 mN s: a pulse of 10 mN s every ten steps (rounding may need one more).
    assert 9 <= len(fired) <= 10
    assert fired.min() >= 0.01 / IDEAL.mass_kg - 1e-15


def test_on_the_table_it_stays_in_the_plane_and_comes_to_rest():
    flyer = FreeFlyer(replace(IDEAL, friction=0.01), body([0.05, 0.0, 0.0]), "granite")
    for _ in range(100):
        flyer.push(np.array([0.0, 0.5, 0.0]), np.array([0.05, 0.0, 0.05]), STEP_NS)
    assert not flyer.state.velocity_mps.any()
    # 0.05 m/s at 0.0980665 m/s^2: half of v^2 / a; a step of 10 ms is worth 0.25 mm.
    assert flyer.state.world_from_body.t_m[0] == pytest.approx(0.5 * 0.05**2 / 0.0980665, abs=3e-4)
    np.testing.assert_array_equal(flyer.state.world_from_body.R, np.eye(3))


def test_on_the_table_it_must_start_upright():
    tilted = BodyState(0, Pose.exp([0.1, 0.0, 0.0, 0.0, 0.0, 0.0], "world", "body"), NONE, NONE)
    with pytest.raises(ValueError, match="upright"):
        FreeFlyer(IDEAL, tilted, "granite")


def test_it_takes_up_commanded_motion_and_remembers_where_it_was():
    flyer = FreeFlyer(IDEAL, body())
    push = replace(rest_command(0, FollowerConfig()), acceleration_mps2=np.array([0.05, 0.0, 0.0]), valid_s=1.0)
    flyer.send(push)
    # 1 s of 0.05 m/s^2, then as fast as then.
    assert flyer.state_at(ns_from_s(3.0)).world_from_body.t_m[0] == pytest.approx(0.125, abs=1e-6)
    assert flyer.state_at(ns_from_s(1.0)).world_from_body.t_m[0] == pytest.approx(0.025, abs=1e-6)
    assert flyer.state_at(-5).t_ns == 0
    assert not flyer.has_own_time


@pytest.mark.parametrize("change", [{"inertia_kg_m2": (0.1, 0.1, 0.3)}, {"mass_kg": 0.0}, {"friction": -1.0}])
def test_bodies_that_cannot_be_are_refused(change: dict[str, object]):
    with pytest.raises(ValueError, match=r"must|no body"):
        FlyerConfig(**change)  # type: ignore[arg-type]
