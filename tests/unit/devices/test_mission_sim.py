"""The simulated inertial unit, native localiser and missions against what they are told to be."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.sim.imu import TrueImu, simulate_imu
from uvgs_bench.devices.sim.map_landmarks import LandmarkTruth, MapLocaliser
from uvgs_bench.devices.sim.mission_scene import MISSIONS, gt2_mission
from uvgs_bench.geometry import Pose
from uvgs_bench.navigation.imu import ImuNoise
from uvgs_bench.navigation.rigid import RigidState

LENS = Lens("plumb_bob", 1280, 960, np.array([1002.4, 1001.7, 643.2, 476.9, -0.08, 0.045, 0.0004, -0.0003, 0.0]))
GRAVITY = np.array([0.0, 0.0, -9.81])
LOOKING_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def resting(_):
    pose = Pose.exp((0.2, -0.1, 0.4, 0.0, 0.0, 0.0), "world", "body")
    return RigidState(pose, np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))


def test_a_unit_at_rest_feels_gravity_upwards_and_its_noise_has_the_stated_density():
    noise = ImuNoise(2e-3, 3e-4, 1e-9, 1e-9)
    truth = TrueImu(noise, acceleration_bias_sigma_mps2=0.0, rate_bias_sigma_radps=0.0, rate_hz=100.0)
    unit = simulate_imu(resting, 60.0, truth, GRAVITY, np.random.default_rng(1))
    up = resting(0.0).pose.R.T @ -GRAVITY
    a, w = unit.samples.acceleration_mps2, unit.samples.rate_radps
    # 6000 samples: the mean is good to 2e-3 / sqrt(60) = 2.6e-4 m/s^2; four of these.
    np.testing.assert_allclose(a.mean(axis=0), up, atol=1.1e-3)
    # Deviations of 6000 samples are good to 0.9 %; density times root rate.
    np.testing.assert_allclose(a.std(axis=0), 2e-3 * 10.0, rtol=0.05)
    np.testing.assert_allclose(w.std(axis=0), 3e-4 * 10.0, rtol=0.05)


def test_biases_wander_as_stated():
    noise = ImuNoise(1e-9, 1e-9, 1e-3, 1e-4)
    truth = TrueImu(noise, acceleration_bias_sigma_mps2=0.0, rate_bias_sigma_radps=0.0, rate_hz=10.0)
    ends = []
    for seed in range(80):
        unit = simulate_imu(resting, 25.0, truth, GRAVITY, np.random.default_rng(seed))
        ends.append(np.concatenate((unit.acceleration_bias_mps2[-1], unit.rate_bias_radps[-1])))
        np.testing.assert_allclose(unit.samples.rate_radps, unit.rate_bias_radps, atol=1e-7)
    # After 25 s: walk times 5; 240 draws each, 4.6 % of a deviation.
    spread = np.sqrt(np.mean(np.square(np.array(ends)), axis=0)).reshape(2, 3).mean(axis=1)
    np.testing.assert_allclose(spread, [5e-3, 5e-4], rtol=0.2)


def test_the_clock_offset_moves_stamps_only():
    at = [simulate_imu(resting, 1.0, TrueImu(clock_offset_s=s), GRAVITY, np.random.default_rng(2)) for s in (0.0, 0.05)]
    np.testing.assert_array_equal(at[1].samples.t_ns - at[0].samples.t_ns, 50_000_000)
    np.testing.assert_array_equal(at[1].samples.rate_radps, at[0].samples.rate_radps)


def localiser(seed=1, **truth):
    settings = {"glare_m2": 0.0, "shade_radius_m": 0.01, **truth}
    return MapLocaliser(LENS, LandmarkTruth(**settings), np.array([0.9, 0.0, 0.06]), np.array([1.0, 0.0, 0.0]), seed)


def camera_at(x):
    return Pose(LOOKING_AHEAD, np.array([x, 0.0, 0.06]), "world", "camera")


def test_the_localiser_finds_the_camera_as_well_as_it_says():
    native, misses = localiser(wrong_share=0.0), []
    for _ in range(60):
        fix = native.locate(camera_at(-0.5))
        xi = (camera_at(-0.5) @ fix.world_from_camera.inverse()).log()
        misses.append(float(xi @ np.linalg.solve(fix.covariance, xi)))
    # The map's errors are the same each time, so that the 60 are not independent: only the size is judged, 6 expected.
    assert 1.0 < np.mean(misses) < 20.0


def test_wrong_matches_do_not_lead_it():
    native = localiser(wrong_share=0.15)
    far = [
        np.linalg.norm(native.locate(camera_at(-0.5)).world_from_camera.t_m - camera_at(-0.5).t_m) for _ in range(30)
    ]
    assert np.median(far) < 0.02
    assert max(far) < 0.1


def test_landmarks_starve_near_the_leader():
    native = localiser(glare_m2=0.8, shade_radius_m=0.28)
    counts = [np.mean([native.locate(camera_at(x)).count for _ in range(10)]) for x in (-0.8, 0.1, 0.45)]
    assert counts[0] > 60
    assert counts[0] > counts[1] > counts[2]
    assert native.locate(camera_at(0.45)).world_from_camera is None


@pytest.mark.parametrize("name", MISSIONS)
def test_missions_keep_the_beacon_in_view(name):
    plan = MISSIONS[name]()
    assert plan.name == name
    for t_s in np.linspace(0.0, plan.duration_s, 60):
        camera = plan.state_at(t_s).pose @ plan.body_from_camera
        x, y, z = (camera.inverse() @ plan.world_from_beacon).t_m
        assert z > 0.35
        # A beacon of 80 mm needs room to the edge of the picture.
        px = LENS.project(np.array([[x, y, z]]))[0]
        room = 0.08 * LENS.fx_px / z
        assert room < px[0] < LENS.width_px - room
        assert room < px[1] < LENS.height_px - room


def test_a_hidden_beacon_is_hidden_then_only():
    from dataclasses import replace

    plan = replace(gt2_mission(), hidden_s=((1.0, 2.0),))
    assert [plan.is_hidden(t) for t in (0.99, 1.0, 1.99, 2.0)] == [False, True, True, False]
