"""The error-state filter: what it does with what comes."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.fusion_flight import NOISE, begun, fly, run, state_at
from uvgs_bench.geometry import Pose
from uvgs_bench.navigation.error_state_filter import FilterConfig
from uvgs_bench.navigation.imu import ImuNoise, ImuSamples, fit_static_bias
from uvgs_bench.navigation.smoother import smooth
from uvgs_bench.navigation.states import PoseMeasurement, SensedPose, body_measurement


@pytest.fixture(scope="module")
def flight():
    return fly(2)


def off(t_ns, metres):
    true = state_at(t_ns).pose
    return PoseMeasurement(t_ns, Pose(true.R, true.t_m + np.asarray(metres), "world", "body"), NOISE)


def test_a_wild_pose_is_refused_and_changes_nothing(flight):
    estimator = begun(flight)
    run(flight, estimator, flight.poses[1:])
    before = estimator.state
    record = estimator.add_pose(off(estimator.t_ns, (0.3, 0.0, 0.0)))
    assert record.status == "refused"
    assert record.nis > 16.8
    np.testing.assert_array_equal(estimator.state.covariance, before.covariance)


def test_wild_poses_that_disagree_never_open_the_gate(flight):
    estimator = begun(flight)
    run(flight, estimator, flight.poses[1:])
    rng = np.random.default_rng(0)
    for _ in range(20):
        direction = rng.standard_normal(3)
        assert estimator.add_pose(off(estimator.t_ns, 0.3 * direction / np.linalg.norm(direction))).status == "refused"


def test_a_filter_that_is_wrong_finds_back(flight):
    """After a jump nobody told it of: two refusals that agree, then it believes."""
    estimator = begun(flight)
    run(flight, estimator, flight.poses[1:])
    jump = np.array([0.5, -0.2, 0.1])
    said = []
    for _ in range(5):
        said.append(estimator.add_pose(off(estimator.t_ns, jump)).status)
    assert said[:3] == ["refused", "refused", "reopened"]
    assert said[3:] == ["fused", "fused"]
    error = estimator.state.world_from_body.t_m - (state_at(estimator.t_ns).pose.t_m + jump)
    # One pose of 2 mm per axis after the reopening.
    assert np.linalg.norm(error) < 0.01


def test_each_source_has_its_own_history(flight):
    estimator = begun(flight)
    run(flight, estimator, flight.poses[1:])
    for _ in range(2):
        estimator.add_pose(off(estimator.t_ns, (0.5, 0.0, 0.0)))
    native = PoseMeasurement(estimator.t_ns, off(estimator.t_ns, (0.5, 0.0, 0.0)).world_from_body, NOISE, "native")
    assert estimator.add_pose(native).status == "refused"


def test_poses_from_before_the_window_are_too_old(flight):
    estimator = begun(flight, FilterConfig(noise=flight.config.noise, buffer_steps=20))
    run(flight, estimator, ())
    record = estimator.add_pose(flight.poses[3])
    assert record.status == "too_old"
    assert np.isnan(record.nis)
    assert record.delay_s > 1.0


def test_a_gap_is_named_and_makes_it_unsure(flight):
    estimator = begun(flight)
    samples = flight.unit.samples
    hole = (samples.t_ns > 2_000_000_000) & (samples.t_ns < 2_800_000_000)
    for k in np.flatnonzero(~hole):
        before = estimator.state.position_sigma_m
        estimator.add_imu(int(samples.t_ns[k]), samples.acceleration_mps2[k], samples.rate_radps[k])
        if estimator.gaps_s:
            break
    (begin_ns, length_s), sigma_m = estimator.gaps_s[0], estimator.state.position_sigma_m
    assert begin_ns == 2_000_000_000
    assert length_s == pytest.approx(0.8)
    # An acceleration unknown by 0.5 m/s^2 over 0.8 s makes 0.16 m; the filter spreads it over the gap as white noise,
    # which makes half of it.
    assert (sigma_m - before > 0.05).all()


def test_a_pose_from_the_future_carries_the_state_there(flight):
    estimator = begun(flight)
    estimator.add_imu(0, flight.unit.samples.acceleration_mps2[0], flight.unit.samples.rate_radps[0])
    t_ns = 30_000_000
    assert estimator.add_pose(off(t_ns, np.zeros(3))).status == "fused"
    assert estimator.t_ns == t_ns
    assert estimator.seconds_since("uvgs") == 0.0
    assert estimator.seconds_since("native") == np.inf


def test_standing_still_pins_the_velocity(flight):
    estimator = begun(flight)
    samples = flight.unit.samples
    for k in range(100):
        estimator.add_imu(int(samples.t_ns[k]), samples.acceleration_mps2[k], samples.rate_radps[k])
    assert np.abs(estimator.state.velocity_mps).max() > 0.005  # the unknown bias of some 0.05 m/s^2 over 1 s
    assert estimator.add_zero_velocity(estimator.t_ns, 0.001)
    assert np.abs(estimator.state.velocity_mps).max() < 0.003
    assert not estimator.add_zero_velocity(-1, 0.001)


def test_biases_at_rest():
    noise, rng = ImuNoise(), np.random.default_rng(3)
    t_ns = np.arange(500) * 8_000_000
    gravity = np.array([0.0, 0.0, -9.81])
    R = Pose.exp((0.3, 0.2, 0.1, 0, 0, 0), "world", "body").R
    bias_a, bias_g = np.array([0.05, -0.02, 0.03]), np.array([0.004, -0.002, 0.001])
    scale = np.sqrt(125.0)
    acceleration = -gravity @ R + bias_a + noise.acceleration_noise_mps2_rthz * scale * rng.standard_normal((500, 3))
    rate = bias_g + noise.rate_noise_radps_rthz * scale * rng.standard_normal((500, 3))
    samples = ImuSamples(t_ns, acceleration, rate)
    fit = fit_static_bias(samples, noise, R, 1e-4, gravity)
    assert fit.is_still
    # Within four of the deviations it states itself.
    assert (np.abs(fit.acceleration_bias_mps2 - bias_a) < 4.0 * fit.acceleration_sigma_mps2).all()
    assert (np.abs(fit.rate_bias_radps - bias_g) < 4.0 * fit.rate_sigma_radps).all()
    shaken = ImuSamples(t_ns, acceleration + 0.2 * np.sin(t_ns / 1e8)[:, None], rate)
    assert not fit_static_bias(shaken, noise, R, 1e-4, gravity).is_still


def test_the_smoother_is_better_than_the_filter_and_ends_where_it_ends(flight):
    estimator, said = begun(flight), []
    start = estimator.state
    run(flight, estimator, flight.poses[1:], each=lambda k: said.append(estimator.state) if k % 10 == 0 and k else None)
    instants = np.array([state.t_ns for state in said])
    smoothed = smooth(start, flight.unit.samples, flight.poses[1:], instants, flight.config)

    def rms(states):
        errors = [
            state.error_of(state_at(s.t_ns).pose, state_at(s.t_ns).velocity_mps)[:3] for s in states for state in (s,)
        ]
        return np.sqrt(np.mean(np.square(errors)))

    # Looking ahead about halves the variance while the body moves.
    assert rms(smoothed) < 0.85 * rms(said)
    assert smoothed[-1].world_from_body.is_close(said[-1].world_from_body, 1e-9, 1e-9)
    assert all((a.position_sigma_m <= b.position_sigma_m + 1e-12).all() for a, b in zip(smoothed, said, strict=True))


def test_readings_must_be_in_order_and_finite():
    three = np.zeros((2, 3))
    with pytest.raises(ValueError, match="ascend"):
        ImuSamples(np.array([5, 5]), three, three)
    with pytest.raises(ValueError, match="finite"):
        ImuSamples(np.array([5, 6]), three + np.nan, three)
    with pytest.raises(ValueError, match="positive"):
        ImuNoise(rate_noise_radps_rthz=0.0)


def test_what_a_sensed_pose_says_about_the_body():
    """Against drawn noise on the sensor's pose: the mapped covariance is that of the body's poses."""
    rng = np.random.default_rng(8)
    world_from_beacon = Pose.exp((0.4, -0.2, 0.9, 1.0, 0.3, 0.2), "world", "beacon")
    body_from_camera = Pose.exp((1.2, -1.2, 1.2, 0.12, -0.04, 0.06), "body", "camera")
    camera_from_beacon = Pose.exp((0.1, 0.2, -0.1, 0.1, -0.05, 0.9), "camera", "beacon")
    A = rng.normal(size=(6, 6)) * 1e-3
    covariance = A @ A.T
    said = body_measurement(SensedPose(0, camera_from_beacon, covariance), world_from_beacon, body_from_camera)
    draws = []
    for xi in rng.multivariate_normal(np.zeros(6), covariance, 4000):
        noisy = SensedPose(0, camera_from_beacon.perturbed(xi), covariance)
        pose = body_measurement(noisy, world_from_beacon, body_from_camera).world_from_body
        turn = (pose @ said.world_from_body.inverse()).log()[:3]
        draws.append(np.concatenate((turn, pose.t_m - said.world_from_body.t_m)))
    sigma = np.sqrt(np.diag(said.covariance))
    # 4000 draws: deviations of deviations 1.1 %, so that 6 % is beyond five of them.
    np.testing.assert_allclose(np.std(draws, axis=0) / sigma, 1.0, atol=0.06)
    np.testing.assert_allclose(np.corrcoef(np.transpose(draws)), said.covariance / np.outer(sigma, sigma), atol=0.1)
