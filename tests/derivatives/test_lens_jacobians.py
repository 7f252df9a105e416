"""Each analytic derivative of the lenses against central differences."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.camera import LENSES, Lens

EXAMPLES = {
    "plumb_bob": [800.0, 790.0, 330.0, 236.0, -0.28, 0.11, 1.2e-3, -7e-4, -0.02],
    "rational_polynomial": [800.0, 790.0, 330.0, 236.0, 0.4, 0.2, 1.2e-3, -7e-4, 0.02, 0.7, 0.25, 0.03],
    "thin_prism": [800.0, 790.0, 330.0, 236.0, 0.4, 0.2, 1e-3, -7e-4, 0.02, 0.7, 0.25, 0.03, 2e-3, -1e-3, 1e-3, 5e-4],
    "equidistant": [320.0, 318.0, 330.0, 236.0, 0.02, -0.011, 0.004, -0.0011],
    "fov": [608.8073, 607.61439, 332.0, 236.0, 0.998693],
}


def points(model: str) -> np.ndarray:
    rng = np.random.default_rng(11)
    spread = np.column_stack([rng.uniform(-0.5, 0.5, (60, 2)), rng.uniform(0.7, 2.0, 60)])
    near_axis = np.array([[3e-5, -2e-5, 1.1], [2e-4, 1e-4, 0.9], [0.0, 1e-7, 1.0]])
    behind = np.array([[0.8, 0.3, -0.2], [-0.4, 0.9, 0.0]]) if model == "equidistant" else np.empty((0, 3))
    return np.vstack([spread, near_axis, behind])


@pytest.mark.parametrize("model", list(LENSES))
def test_derivative_by_the_point(model):
    lens, pts = Lens(model, 640, 480, np.array(EXAMPLES[model])), points(model)
    _, by_point, _ = lens.project_with_jacobians(pts)
    h = 1e-6
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = h
        numeric = (lens.project(pts + step) - lens.project(pts - step)) / (2 * h)
        # Differences with h = 1e-6 m on 1e3 px have rounding near 1e-7 px/m and truncation h^2 f''' below 1e-8.
        np.testing.assert_allclose(by_point[:, :, axis], numeric, rtol=1e-6, atol=2e-6)


@pytest.mark.parametrize("model", list(LENSES))
def test_derivative_by_the_parameters(model):
    lens, pts = Lens(model, 640, 480, np.array(EXAMPLES[model])), points(model)
    _, _, by_parameters = lens.project_with_jacobians(pts)
    assert by_parameters.shape == (len(pts), 2, lens.parameters.size)
    for i, value in enumerate(lens.parameters):
        h = 1e-6 * max(1.0, abs(value))
        high, low = lens.parameters.copy(), lens.parameters.copy()
        high[i] += h
        low[i] -= h
        numeric = (lens.with_parameters(high).project(pts) - lens.with_parameters(low).project(pts)) / (2 * h)
        # Rounding of pixels (1e-13) over h = 1e-6 is 1e-7 px per unit; columns reach 1e3.
        np.testing.assert_allclose(by_parameters[:, :, i], numeric, rtol=1e-6, atol=2e-6)


def test_outside_the_field_the_derivatives_are_nan():
    lens = Lens("plumb_bob", 640, 480, np.array(EXAMPLES["plumb_bob"]))
    px, by_point, by_parameters = lens.project_with_jacobians([[0.1, 0.1, -1.0]])
    assert np.isnan(px).all()
    assert np.isnan(by_point).all()
    assert np.isnan(by_parameters).all()
