"""The derivatives of the registration against central differences."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.planted_bench import Noise, planted_observations, planted_poses
from uvgs_bench.accuracy.bench_model import (
    carriage_motion,
    pose_residuals,
    predicted,
    prediction_jacobian,
    residual_jacobian,
)
from uvgs_bench.accuracy.observability import gauge_gradient
from uvgs_bench.accuracy.observations import Mount
from uvgs_bench.accuracy.tangent import left_jacobian_inverses
from uvgs_bench.geometry.se3 import se3_left_jacobian_inverse

STEP = 1e-6  # rad and m: truncation 1e-12, rounding 1e-10


@pytest.mark.parametrize("mount", ["beacon_on_carriage", "camera_on_carriage"])
def test_residual_jacobian_matches_differences(mount: Mount) -> None:
    rng = np.random.default_rng(4)
    # Errors of 0.1 rad and 50 mm, so that the left Jacobian's inverse is far from the identity.
    noise = Noise(capture_m=(0.05, 0.05, 0.05), capture_rad=(0.1, 0.1, 0.1))
    obs = planted_observations("3T2R", 6, 1, rng, noise, mount=mount)
    left, right = planted_poses(mount)
    R_g, t_g = carriage_motion(obs)

    residuals = pose_residuals(obs, *predicted(left, right, R_g, t_g))
    analytic = residual_jacobian(residuals, prediction_jacobian(left, R_g, t_g))

    for k in range(12):
        step = np.zeros(12)
        step[k] = STEP
        ahead, behind = (
            pose_residuals(obs, *predicted(left.perturbed(s[:6]), right.perturbed(s[6:]), R_g, t_g))
            for s in (step, -step)
        )
        numeric = (ahead - behind) / (2.0 * STEP)
        # 1e-8: rounding of a central difference with this step, in rad/rad, m/rad and m/m.
        np.testing.assert_allclose(analytic[:, :, k], numeric, atol=1e-8)


def test_batched_left_jacobian_inverse_matches_the_closed_form() -> None:
    xi = np.random.default_rng(2).uniform(-0.3, 0.3, (50, 6))
    exact = np.array([se3_left_jacobian_inverse(x) for x in xi])
    # The series is cut after the tenth power: below 1e-10 for angles under 0.6 rad.
    np.testing.assert_allclose(left_jacobian_inverses(xi), exact, atol=1e-10)


def test_gauge_gradient_matches_differences() -> None:
    _, part = planted_poses()
    nominal, _ = planted_poses("camera_on_carriage")
    nominal = type(part)(nominal.R, nominal.t_m, part.target, part.source)
    deviation, analytic = gauge_gradient(part, nominal, 1.5)
    assert deviation.shape == (6,)
    for k in range(6):
        step = np.zeros(6)
        step[k] = STEP
        ahead = gauge_gradient(part.perturbed(step), nominal, 1.5)[0]
        behind = gauge_gradient(part.perturbed(-step), nominal, 1.5)[0]
        np.testing.assert_allclose(analytic[:, k], (ahead - behind) / (2.0 * STEP), atol=1e-8)
