"""The analytic pose Jacobian against finite differences, for every lens and both pivots."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.camera.lens import LENSES, Lens
from uvgs_bench.geometry.se3 import se3_exp
from uvgs_bench.sensor.pose_kernels import normal_equations, turn_and_shift

COEFFICIENTS = {
    "plumb_bob": [-0.1, 0.05, 1e-3, -5e-4, 0.01],
    "rational_polynomial": [0.1, 0.05, 1e-3, -5e-4, 0.01, 0.2, 0.03, 0.002],
    "thin_prism": [0.1, 0.05, 1e-3, -5e-4, 0.01, 0.2, 0.03, 0.002, 1e-3, -4e-4, 5e-4, 2e-4],
    "equidistant": [-0.02, 0.005, -0.001, 0.0002],
    "fov": [0.9],
}


def lens_of(model: str) -> Lens:
    return Lens(model, 1280, 960, np.array([800.0, 810.0, 640.0, 480.0, *COEFFICIENTS[model]]))


@pytest.mark.parametrize("model", sorted(LENSES))
@pytest.mark.parametrize("pivot", ["left", "beacon"])
def test_gradient_is_the_derivative_of_chi_square(model, pivot):
    lens = lens_of(model)
    rng = np.random.default_rng(11)
    points = spots.beacon().positions_m.copy()
    for _ in range(20):
        pose = spots.random_pose(rng)
        R, t = pose.R.copy(), pose.t_m.copy()
        px = lens.project(pose.apply(points)) + rng.normal(size=(4, 2)) * 3.0
        sigma = rng.uniform(0.5, 2.0, 4)
        about = np.zeros(3) if pivot == "left" else t.copy()
        H, g, e = np.empty((6, 6)), np.empty(6), np.empty((4, 2))
        chi2 = normal_equations(lens.model_id, lens.kernel_parameters, points, px, sigma, R, t, about, H, g, e)

        def cost(xi, pivot=pivot, R=R, t=t, px=px, sigma=sigma):
            if pivot == "left":
                dR, dt = se3_exp(xi)
                moved = points @ (dR @ R).T + dR @ t + dt
            else:
                R_new, t_new = np.empty((3, 3)), np.empty(3)
                turn_and_shift(R, t, xi, R_new, t_new)
                moved = points @ R_new.T + t_new
            return float((((px - lens.project(moved)) / sigma[:, None]) ** 2).sum())

        assert chi2 == pytest.approx(cost(np.zeros(6)), rel=1e-12)
        h = 1e-6
        numeric = np.array([(cost(h * d) - cost(-h * d)) / (2 * h) for d in np.eye(6)])
        # chi2 = sum e^2 w falls along +g; central differences of chi2 carry h^2 curvature, about 1e-6 relative.
        np.testing.assert_allclose(-2.0 * g, numeric, rtol=1e-5, atol=1e-5 * np.abs(numeric).max())


def test_information_is_the_square_of_the_jacobian():
    lens, points = lens_of("plumb_bob"), spots.beacon().positions_m.copy()
    pose = spots.random_pose(np.random.default_rng(2))
    R, t = pose.R.copy(), pose.t_m.copy()
    sigma = np.array([0.3, 0.5, 0.7, 0.9])
    H, g, e = np.empty((6, 6)), np.empty(6), np.empty((4, 2))
    px = lens.project(pose.apply(points))
    normal_equations(lens.model_id, lens.kernel_parameters, points, px, sigma, R, t, np.zeros(3), H, g, e)
    h = 1e-6
    columns = []
    for d in np.eye(6):
        plus, minus = (lens.project(pose.perturbed(s * h * d).apply(points)) / sigma[:, None] for s in (1.0, -1.0))
        columns.append(((plus - minus) / (2 * h)).ravel())
    J = np.array(columns).T
    # Central differences of a pixel of size 1e3 with h = 1e-6 are good to 1e-7 of J.
    np.testing.assert_allclose(H, J.T @ J, rtol=1e-6, atol=1e-6 * np.abs(J.T @ J).max())
