"""The derivatives of axis terms, time terms and common errors against central differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers.planted_bench import NOISELESS, planted_observations, planted_poses
from uvgs_bench.accuracy.bench_model import carriage_motion, pose_residuals, predicted
from uvgs_bench.accuracy.bench_terms import moved_carriage_m, sensor_jacobian, term_jacobian
from uvgs_bench.accuracy.blind_bench import random_bench
from uvgs_bench.accuracy.common_errors import sensor_sensitivities
from uvgs_bench.accuracy.observations import Mount
from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor.batch import solve_batch

STEP = 1e-6  # 1, rad, s: truncation below 1e-11, rounding 1e-10


@pytest.mark.parametrize("mount", ["beacon_on_carriage", "camera_on_carriage"])
def test_term_jacobian_matches_differences(mount: Mount) -> None:
    rng = np.random.default_rng(3)
    obs = planted_observations("3T2R", 6, 1, rng, NOISELESS, mount=mount)
    obs = replace(obs, velocity_gs_mps=rng.uniform(-0.1, 0.1, (6, 3)))
    left, right = planted_poses(mount)
    terms = np.array([2e-3, -1e-3, 3e-3, 1e-3, -2e-3, 5e-4, 0.03, 1e-3])
    origin_ns = int(obs.t_ns[2])

    def seen(values: FloatArray) -> FloatArray:
        moved = replace(obs, t_gs_m=moved_carriage_m(obs, values, origin_ns))
        return np.concatenate([part.reshape(6, -1) for part in predicted(left, right, *carriage_motion(moved))], axis=1)

    analytic = term_jacobian(obs, left, terms, origin_ns)
    assert np.all(analytic[:, :3] == 0.0)
    for k in range(8):
        step = np.zeros(8)
        step[k] = STEP
        change = (seen(terms + step) - seen(terms - step)) / (2.0 * STEP)
        # A term turns nothing; 1e-8: rounding of a central difference with this step, m per 1, rad, s.
        np.testing.assert_allclose(change[:, :9], 0.0, atol=1e-8)
        np.testing.assert_allclose(analytic[:, 3:, k], change[:, 9:], atol=1e-8)


def test_sensor_jacobian_is_a_scale_of_depth_and_of_all() -> None:
    obs = planted_observations("3T", 4, 1, np.random.default_rng(1), NOISELESS)
    J = sensor_jacobian(obs.t_cb_m)
    deeper = replace(obs, t_cb_m=obs.t_cb_m * np.array([1.0, 1.0, 1.0 + STEP]))
    larger = replace(obs, t_cb_m=obs.t_cb_m * (1.0 + STEP))
    for k, moved in enumerate((deeper, larger)):
        change = pose_residuals(moved, obs.R_cb, obs.t_cb_m) / STEP
        # 1e-8 m: rounding of a difference with this step.
        np.testing.assert_allclose(J[:, :, k], change, atol=1e-8)


def test_sensor_sensitivities_match_what_the_solver_does() -> None:
    bench = random_bench(np.random.default_rng(5))
    obs = planted_observations("3T", 5, 1, np.random.default_rng(2), NOISELESS)
    R = np.tile(bench.left.R @ bench.right.R, (5, 1, 1))
    t = obs.t_gs_m @ bench.left.R.T + np.array([0.0, 0.0, 1.0])
    points = (np.einsum("nij,lj->nli", R, bench.leds_m) + t[:, None]).reshape(-1, 3)
    px = bench.lens.project(points).reshape(5, 4, 2)
    by_lens, by_led = sensor_sensitivities(bench.lens, bench.leds_m, R, t)

    def solved(lens_step: FloatArray, led_step: FloatArray) -> FloatArray:
        lens = bench.lens.with_parameters(bench.lens.parameters + lens_step)
        found = solve_batch(lens, bench.leds_m + led_step, px, np.full(4, 0.05))
        assert found.converged.all()
        return pose_residuals(replace(obs, R_cb=found.R_cb, t_cb_m=found.t_cb_m), R, t)

    none = np.zeros(bench.lens.parameters.size), np.zeros((4, 3))
    for k, step in ((0, 0.05), (2, 0.05), (4, 1e-4)):
        lens_step = none[0].copy()
        lens_step[k] = step
        change = (solved(lens_step, none[1]) - solved(-lens_step, none[1])) / (2.0 * step)
        # 1 in 1000: the solver weighs and stops a little differently than the linear answer.
        np.testing.assert_allclose(by_lens[:, :, k], change, atol=1e-3 * np.abs(by_lens[:, :, k]).max())
    for k in (0, 5, 11):
        led_step = none[1].copy()
        led_step.ravel()[k] = 1e-5
        change = (solved(none[0], led_step) - solved(none[0], -led_step)) / 2e-5
        np.testing.assert_allclose(by_led[:, :, k], change, atol=1e-3 * np.abs(by_led[:, :, k]).max())
