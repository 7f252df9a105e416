"""Laws every lens obeys, for any plausible parameters."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uvgs_bench.camera import LENSES, Lens

RANGES = {
    "plumb_bob": [(-0.4, 0.2), (-0.1, 0.3), (-3e-3, 3e-3), (-3e-3, 3e-3), (-0.1, 0.1)],
    "equidistant": [(-0.05, 0.05), (-0.02, 0.02), (-0.01, 0.01), (-0.003, 0.003)],
    "fov": [(0.3, 1.6)],
}
RANGES["rational_polynomial"] = [*RANGES["plumb_bob"], (-0.1, 0.4), (-0.1, 0.2), (-0.02, 0.02)]
RANGES["thin_prism"] = [*RANGES["rational_polynomial"], *[(-2e-3, 2e-3)] * 4]


@st.composite
def lenses(draw, model):
    k = [draw(st.floats(*bounds)) for bounds in RANGES[model]]
    f = draw(st.floats(300.0, 1500.0))
    aspect = draw(st.floats(0.98, 1.02))
    return Lens(model, 1280, 960, np.array([f, f * aspect, 633.0, 487.0, *k]))


@pytest.mark.parametrize("model", list(LENSES))
@settings(max_examples=60, deadline=None, derandomize=True)
@given(data=st.data())
def test_unproject_undoes_project_in_the_picture(model, data):
    lens = data.draw(lenses(model))
    u = data.draw(st.lists(st.floats(-0.5, 1279.5), min_size=20, max_size=20))
    v = data.draw(st.lists(st.floats(-0.5, 959.5), min_size=20, max_size=20))
    px = np.column_stack([u, v])
    rays = lens.unproject(px)
    seen = np.isfinite(rays[:, 0])
    np.testing.assert_allclose(np.linalg.norm(rays[seen], axis=1), 1.0, rtol=0, atol=1e-14)
    # 1e-9 px: the promised 1e-10 px plus rounding of the unit ray times the focal length near the fold.
    np.testing.assert_allclose(lens.project(rays[seen]), px[seen], rtol=0, atol=1e-9)
    centre = np.linalg.norm(px - [633.0, 487.0], axis=1) < 0.2 * lens.fx_px
    # Every pixel within 0.2 f of the centre has a ray: no lens of these ranges folds before 0.6 f.
    assert seen[centre].all()


@pytest.mark.parametrize("model", list(LENSES))
@settings(max_examples=60, deadline=None, derandomize=True)
@given(data=st.data())
def test_project_depends_on_direction_only(model, data):
    lens = data.draw(lenses(model))
    direction = np.array([data.draw(st.floats(-0.4, 0.4)), data.draw(st.floats(-0.4, 0.4)), 1.0])
    scale = data.draw(st.floats(0.1, 50.0))
    near, far = lens.project(direction), lens.project(scale * direction)
    # 1e-9 px: rounding of coordinates of some hundred pixels.
    np.testing.assert_allclose(far, near, rtol=0, atol=1e-9)


@pytest.mark.parametrize("model", list(LENSES))
@settings(max_examples=40, deadline=None, derandomize=True)
@given(data=st.data())
def test_radius_grows_with_the_angle_up_to_the_limit(model, data):
    lens = data.draw(lenses(model))
    if model in ("plumb_bob", "rational_polynomial", "thin_prism"):
        k = lens.parameters.copy()
        k[6:8] = 0.0
        k[12:] = 0.0
        lens = lens.with_parameters(k)
    theta = np.linspace(1e-3, min(lens.limit_rad, 1.5) * 0.9999, 300)
    px = lens.project(np.column_stack([np.sin(theta), np.zeros(300), np.cos(theta)]))
    assert np.isfinite(px).all()
    assert (np.diff(px[:, 0]) > 0.0).all()
