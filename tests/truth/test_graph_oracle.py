"""Two independent estimators agree: the filter with GTSAM's batch solution, the graph with the filter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers.fusion_flight import GRAVITY, begun, fly, run, state_at
from uvgs_bench.geometry import Pose
from uvgs_bench.navigation.error_state_filter import FilterConfig
from uvgs_bench.navigation.factor_graph import FixedLagGraph
from uvgs_bench.navigation.gtsam_bridge import GraphConfig, body_covariance, middle_force
from uvgs_bench.navigation.smoother import smooth
from uvgs_bench.navigation.states import PoseMeasurement, SensedPose

gtsam = pytest.importorskip("gtsam", reason="the extra 'fusion' is not installed")

BODY_FROM_CAMERA = Pose.exp((-1.2, 1.2, -1.2, 0.1, 0.0, 0.05), "body", "camera")
WORLD_FROM_BEACON = Pose.exp((-1.2, 1.2, -1.2, 1.2, 0.1, 0.0), "world", "beacon")


@pytest.fixture(scope="module")
def flight():
    return fly(5)


def open_gate(flight):
    """A gate refuses one good pose in a hundred; the batch solution has none."""
    return replace(flight.config, gate_chi2=1e9)


def batch(flight, poses):
    """All readings and poses in one least-squares problem; the last node with its covariance."""
    noise, start = flight.imu_truth.noise, begun(flight).state
    params = gtsam.PreintegrationCombinedParams(GRAVITY)
    params.setAccelerometerCovariance(noise.acceleration_noise_mps2_rthz**2 * np.eye(3))
    params.setGyroscopeCovariance(noise.rate_noise_radps_rthz**2 * np.eye(3))
    params.setBiasAccCovariance(noise.acceleration_walk_mps3_rthz**2 * np.eye(3))
    params.setBiasOmegaCovariance(noise.rate_walk_radps2_rthz**2 * np.eye(3))
    params.setIntegrationCovariance(1e-12 * np.eye(3))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    x, v, b = (lambda k, letter=letter: gtsam.symbol(letter, k) for letter in "xvb")
    gaussian, zero = gtsam.noiseModel.Gaussian.Covariance, gtsam.imuBias.ConstantBias(np.zeros(3), np.zeros(3))

    def pose3(pose):
        return gtsam.Pose3(gtsam.Rot3(pose.R), pose.t_m)

    graph.add(
        gtsam.PriorFactorPose3(
            x(0), pose3(start.world_from_body), gaussian(body_covariance(start.world_from_body, start.place_covariance))
        )
    )
    graph.add(gtsam.PriorFactorVector(v(0), np.zeros(3), gaussian(start.covariance[3:6, 3:6])))
    graph.add(gtsam.PriorFactorConstantBias(b(0), zero, gaussian(start.covariance[9:, 9:])))
    samples = flight.unit.samples
    k_reading = int(np.searchsorted(samples.t_ns, start.t_ns, side="right"))
    for k, pose in enumerate([flight.poses[0], *poses]):
        values.insert(x(k), pose3(state_at(pose.t_ns).pose))
        values.insert(v(k), state_at(pose.t_ns).velocity_mps)
        values.insert(b(k), zero)
        if k == 0:
            continue
        pim = gtsam.PreintegratedCombinedMeasurements(params, zero)
        while k_reading < len(samples) and samples.t_ns[k_reading] <= pose.t_ns:
            force = 0.5 * (samples.acceleration_mps2[k_reading - 1] + samples.acceleration_mps2[k_reading])
            rate = 0.5 * (samples.rate_radps[k_reading - 1] + samples.rate_radps[k_reading])
            pim.integrateMeasurement(middle_force(force, rate, 0.01), rate, 0.01)
            k_reading += 1
        graph.add(gtsam.CombinedImuFactor(x(k - 1), v(k - 1), x(k), v(k), b(k - 1), b(k), pim))
        noise_model = gaussian(body_covariance(pose.world_from_body, pose.covariance))
        graph.add(gtsam.PriorFactorPose3(x(k), pose3(pose.world_from_body), noise_model))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return solved, gtsam.Marginals(graph, solved), x, v, b


def test_filter_and_smoother_against_a_batch_solution(flight):
    poses = flight.poses[1:101]
    solved, marginals, x, v, b = batch(flight, poses)
    estimator = begun(flight, open_gate(flight))
    start = estimator.state
    last_ns = poses[-1].t_ns
    # Only readings until the last pose, so that both end at the same instant.
    short = flight.unit.samples.between(0, last_ns + 1)
    for k, t_ns in enumerate(short.t_ns):
        estimator.add_imu(int(t_ns), short.acceleration_mps2[k], short.rate_radps[k])
        for pose in (p for p in poses if p.t_ns == t_ns):
            estimator.add_pose(pose)
    smoothed = smooth(start, short, poses, np.array([p.t_ns for p in poses]), flight.config)
    for k, said in ((100, estimator.state), (50, smoothed[49]), (100, smoothed[99])):
        pose, sigma_m = solved.atPose3(x(k)), said.position_sigma_m
        # The filter linearises once where the batch iterates: they may differ by a small part of the deviation.
        assert (np.abs(pose.translation() - said.world_from_body.t_m) < 0.1 * sigma_m).all()
        assert (np.abs(solved.atVector(v(k)) - said.velocity_mps) < 0.1 * np.sqrt(np.diag(said.covariance)[3:6])).all()
        turn = (Pose(pose.rotation().matrix(), np.zeros(3), "world", "body") @ Pose(
            said.world_from_body.R, np.zeros(3), "world", "body").inverse()).log()[:3]  # fmt: skip
        assert (np.abs(turn) < 0.1 * said.rotation_sigma_rad).all()
        biases = solved.atConstantBias(b(k))
        own = np.concatenate((said.acceleration_bias_mps2, said.rate_bias_radps))
        assert (np.abs(biases.vector() - own) < 0.15 * np.sqrt(np.diag(said.covariance)[9:])).all()
        theirs = marginals.marginalCovariance(x(k))
        ours = body_covariance(said.world_from_body, said.place_covariance)
        np.testing.assert_allclose(np.sqrt(np.diag(theirs)), np.sqrt(np.diag(ours)), rtol=0.02)


def graph_of(flight, config=None, parameters=None, beacon=WORLD_FROM_BEACON):
    start = begun(flight).state
    return FixedLagGraph(start, config or flight.config, parameters or GraphConfig(), beacon, BODY_FROM_CAMERA)


def test_graph_against_the_filter(flight):
    estimator, graph = begun(flight, open_gate(flight)), graph_of(flight, open_gate(flight))
    run(flight, estimator, flight.poses[1:101], delay_ns=40_000_000)
    run(flight, graph, flight.poses[1:101], delay_ns=40_000_000)
    # Seven seconds of dead reckoning follow.
    a, b = estimator.state, graph.state
    assert a.t_ns == b.t_ns
    # The graph's robust factors weigh the farthest tenth of good poses a little down: 0.3 deviations.
    assert (np.abs(a.world_from_body.t_m - b.world_from_body.t_m) < 0.3 * a.position_sigma_m).all()
    assert (np.abs(a.velocity_mps - b.velocity_mps) < 0.3 * np.sqrt(np.diag(a.covariance)[3:6])).all()
    ratio = np.sqrt(np.diag(b.covariance)[:9] / np.diag(a.covariance)[:9])
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)


def test_tangents_map_by_the_adjoint(flight):
    """Drawn noise in our order and place, expressed as GTSAM's logarithm, has the mapped covariance."""
    rng = np.random.default_rng(1)
    pose = Pose.exp((0.5, -0.3, 0.8, 1.0, -2.0, 0.5), "world", "body")
    A = rng.normal(size=(6, 6)) * 1e-3
    place = A @ A.T
    here = gtsam.Pose3(gtsam.Rot3(pose.R), pose.t_m)
    draws = []
    for n in rng.multivariate_normal(np.zeros(6), place, 4000):
        R = Pose.exp(np.concatenate((n[:3], np.zeros(3))), "world", "world").R @ pose.R
        draws.append(gtsam.Pose3.Logmap(here.between(gtsam.Pose3(gtsam.Rot3(R), pose.t_m + n[3:]))))
    mapped = body_covariance(pose, place)
    sigma = np.sqrt(np.diag(mapped))
    # 4000 draws: 1.1 % per deviation, 0.016 per correlation.
    np.testing.assert_allclose(np.std(draws, axis=0) / sigma, 1.0, atol=0.06)
    np.testing.assert_allclose(np.corrcoef(np.transpose(draws)), mapped / np.outer(sigma, sigma), atol=0.08)


def test_a_wild_pose_is_refused_and_an_old_one_named(flight):
    graph = graph_of(flight)
    samples = flight.unit.samples.between(0, 3_000_000_000)
    run(replace(flight, unit=replace(flight.unit, samples=samples)), graph, flight.poses[1:30])
    true = state_at(graph.t_ns).pose
    wild = PoseMeasurement(graph.t_ns, Pose(true.R, true.t_m + 0.3, "world", "body"), flight.poses[0].covariance)
    assert graph.add_pose(wild).status == "refused"
    assert graph.add_pose(flight.poses[2]).status == "too_old"


def test_the_beacon_as_a_variable_is_found(flight):
    """Native poses say where the world is, the sensor says where the beacon is: a wrong start is put right."""
    wrong = WORLD_FROM_BEACON.perturbed(np.array([0.01, -0.01, 0.02, 0.02, 0.01, -0.02]))
    graph = graph_of(flight, FilterConfig(noise=flight.config.noise), GraphConfig(learns_beacon=True,
        beacon_sigma_m=0.05, beacon_sigma_rad=0.05), wrong)  # fmt: skip
    rng, samples = np.random.default_rng(3), flight.unit.samples
    waiting = list(flight.poses[1:81])
    for k, t_ns in enumerate(samples.t_ns):
        graph.add_imu(int(t_ns), samples.acceleration_mps2[k], samples.rate_radps[k])
        while waiting and waiting[0].t_ns <= t_ns:
            m = waiting.pop(0)
            native = PoseMeasurement(m.t_ns, m.world_from_body, m.covariance, "native")
            graph.add_pose(native)
            true = (BODY_FROM_CAMERA.inverse() @ state_at(m.t_ns).pose.inverse() @ WORLD_FROM_BEACON).perturbed(
                1e-3 * rng.standard_normal(6)
            )
            sensed = SensedPose(m.t_ns, true, 1e-6 * np.eye(6))
            graph.add_pose(PoseMeasurement(m.t_ns, m.world_from_body, m.covariance), sensed)
    error = (graph.world_from_beacon @ WORLD_FROM_BEACON.inverse()).log()
    start = (wrong @ WORLD_FROM_BEACON.inverse()).log()
    assert np.linalg.norm(error) < 0.3 * np.linalg.norm(start)
