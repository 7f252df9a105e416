"""Laws of the error-state filter."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.fusion_flight import begun, fly, run, state_at
from tests.helpers.strategies import twists
from uvgs_bench.geometry import Pose
from uvgs_bench.navigation.error_state_filter import ErrorStateFilter, FilterConfig, start_state
from uvgs_bench.navigation.gate import InnovationGate
from uvgs_bench.navigation.states import PoseMeasurement, place_from_tangent, tangent_from_place

# The same sums in another order: rounding of double precision over some 1000 steps.
ROUNDING = 1e-9


@pytest.fixture(scope="module")
def flight():
    return fly(1)


def states_equal(a, b, atol=ROUNDING):
    np.testing.assert_allclose(a.world_from_body.matrix(), b.world_from_body.matrix(), atol=atol)
    np.testing.assert_allclose(a.velocity_mps, b.velocity_mps, atol=atol)
    np.testing.assert_allclose(a.covariance, b.covariance, atol=atol)


@settings(max_examples=8, deadline=None)
@given(delay_ms=st.integers(0, 900), order=st.integers(0, 5))
def test_late_poses_count_as_if_they_had_come_in_time(flight, delay_ms, order):
    timely, late = begun(flight), begun(flight)
    poses = flight.poses[1:40]
    run(flight, timely, poses)
    waiting = list(poses)
    samples = flight.unit.samples
    for k, t_ns in enumerate(samples.t_ns):
        late.add_imu(int(t_ns), samples.acceleration_mps2[k], samples.rate_radps[k])
        due = [m for m in waiting if m.t_ns + delay_ms * 1_000_000 <= t_ns]
        # Several may come at once, in any order.
        for m in np.random.default_rng(order).permutation(len(due)):
            late.add_pose(due[m])
        waiting = [m for m in waiting if m not in due]
    states_equal(timely.state, late.state)


@settings(max_examples=5, deadline=None)
@given(turn=twists())
def test_turning_the_world_turns_the_answer(flight, turn):
    other_from_world = Pose.exp(turn, "world", "world")
    R = other_from_world.R
    six = np.kron(np.eye(2), R)
    gravity = tuple(R @ np.array(flight.config.gravity_mps2))
    config = FilterConfig(noise=flight.config.noise, gravity_mps2=gravity)
    moved = [
        PoseMeasurement(m.t_ns, other_from_world @ m.world_from_body, six @ m.covariance @ six.T, m.source)
        for m in flight.poses[:30]
    ]
    here, there = begun(flight), ErrorStateFilter(start_state(moved[0], velocity_sigma_mps=0.01,
        acceleration_bias_sigma_mps2=0.05, rate_bias_sigma_radps=0.005), config)  # fmt: skip
    run(flight, here, flight.poses[1:30])
    run(flight, there, moved[1:])
    a, b = other_from_world @ here.state.world_from_body, there.state.world_from_body
    assert a.is_close(b, ROUNDING, ROUNDING)
    np.testing.assert_allclose(six @ here.state.place_covariance @ six.T, there.state.place_covariance, atol=ROUNDING)


def test_covariances_stay_symmetric_and_positive(flight):
    estimator = begun(flight)

    def each(_):
        P = estimator.state.covariance
        assert (P == P.T).all()
        assert np.linalg.eigvalsh(P).min() > 0.0

    run(flight, estimator, flight.poses[1:], each=each)


def test_poses_make_it_surer_and_time_does_not(flight):
    estimator = begun(flight)
    samples = flight.unit.samples
    for k in range(1, 50):
        before = np.trace(estimator.state.place_covariance)
        estimator.add_imu(int(samples.t_ns[k]), samples.acceleration_mps2[k], samples.rate_radps[k])
        assert np.trace(estimator.state.place_covariance) > before
    before = np.trace(estimator.state.place_covariance)
    pose = state_at(estimator.t_ns).pose
    assert estimator.add_pose(PoseMeasurement(estimator.t_ns, pose, flight.poses[0].covariance)).status == "fused"
    assert np.trace(estimator.state.place_covariance) < before


@given(twist=twists(), seed=st.integers(0, 100))
def test_covariances_of_place_and_tangent_are_one_another(twist, seed):
    A = np.random.default_rng(seed).normal(size=(6, 6))
    pose = Pose.exp(twist, "world", "body")
    there = place_from_tangent(pose, A @ A.T)
    np.testing.assert_allclose(tangent_from_place(pose, there), A @ A.T, atol=1e-9)


@settings(deadline=None)
@given(wild=st.lists(st.booleans(), min_size=1, max_size=60), seed=st.integers(0, 50))
def test_a_gate_never_shuts_out_a_steady_source(wild, seed):
    """Whatever wild poses come, a steady source is believed again after as many refusals as were asked for."""
    gate, rng = InnovationGate(reopen_after=2), np.random.default_rng(seed)
    noise, P = 1e-6 * np.eye(6), 1e-9 * np.eye(15)
    for k, is_wild in enumerate(wild):
        residual = np.concatenate((np.zeros(3), rng.normal(size=3))) if is_wild else np.zeros(6)
        distance = float(residual @ residual) / 1e-6
        assert (gate.judge("a", k * 100_000_000, distance, residual, noise, P) == "fused") == (distance < gate.limit)
    shifted = np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.0])
    begin_ns = len(wild) * 100_000_000
    said = [gate.judge("a", begin_ns + k * 100_000_000, 2.5e5, shifted, noise, P) for k in range(3)]
    assert "reopened" in said
    assert said[0] == "refused"
