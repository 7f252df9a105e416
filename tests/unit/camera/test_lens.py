"""The five lenses against published examples, OpenCV, and their own contract."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from uvgs_bench.camera import LENSES, Lens
from uvgs_bench.camera.lens_kernels import project_point, unproject_point
from uvgs_bench.errors import CalibrationError

EXAMPLES = {
    "plumb_bob": [800.0, 790.0, 330.0, 236.0, -0.28, 0.11, 1.2e-3, -7e-4, -0.02],
    "rational_polynomial": [800.0, 790.0, 330.0, 236.0, 0.4, 0.2, 1.2e-3, -7e-4, 0.02, 0.7, 0.25, 0.03],
    "thin_prism": [800.0, 790.0, 330.0, 236.0, 0.4, 0.2, 1e-3, -7e-4, 0.02, 0.7, 0.25, 0.03, 2e-3, -1e-3, 1e-3, 5e-4],
    "equidistant": [320.0, 318.0, 330.0, 236.0, 0.02, -0.011, 0.004, -0.0011],
    "fov": [608.8073, 607.61439, 332.0, 236.0, 0.998693],
}
# Nine worked examples of the Astrobee cameras: model, parameters, point (m), raw pixel printed to 1e-6.
NAV = [608.8073, 607.61439, 632.53684, 549.08386, 0.998693]
DOCK = [753.51021, 751.3611, 631.11512, 508.69621, 1.00762]
QUEEN_NAV = [604.19903, 602.67924, 588.79562, 509.73835, 1.00201]
QUEEN_DOCK = [757.05068, 755.16581, 711.13238, 489.98967, 1.01007]
SCI = [1023.6054, 1023.6054, 683.97547, 511.2185, -0.025598438, 0.048258987, -0.00041380657, 0.0056673533, 0.0]
ASTROBEE = [
    ("fov", NAV, (0.10, -0.05, 1.0), (698.712215, 516.061005)),
    ("fov", NAV, (0.5, 0.3, 1.5), (842.194807, 674.632155)),
    ("fov", NAV, (-0.8, 0.4, 1.0), (210.996493, 759.441046)),
    ("fov", DOCK, (0.5, 0.3, 1.5), (890.755396, 664.036059)),
    ("fov", DOCK, (-0.8, 0.4, 1.0), (110.464143, 768.279216)),
    ("fov", QUEEN_NAV, (0.5, 0.3, 1.5), (796.911255, 634.293637)),
    ("fov", QUEEN_DOCK, (0.10, -0.05, 1.0), (793.587838, 448.864588)),
    ("plumb_bob", SCI, (0.10, -0.05, 1.0), (786.496801, 459.988797)),
    ("plumb_bob", SCI, (0.5, 0.3, 1.5), (1026.342705, 716.048865)),
]


def make(model: str) -> Lens:
    return Lens(model, 640, 480, np.array(EXAMPLES[model]))


def points(count: int = 200, width: float = 0.6) -> np.ndarray:
    rng = np.random.default_rng(7)
    return np.column_stack([rng.uniform(-width, width, (count, 2)), rng.uniform(0.7, 2.0, count)])


@pytest.mark.parametrize(("model", "parameters", "point", "pixel"), ASTROBEE)
def test_astrobee_examples_come_out_to_the_printed_digits(model, parameters, point, pixel):
    lens = Lens(model, 1280, 960, np.array(parameters))
    # 1e-6 px: the examples are printed with six decimals (half a unit, and as much again for the coordinates).
    np.testing.assert_allclose(lens.project(point)[0], pixel, rtol=0, atol=1e-6)


def test_astrobee_test_camera_agrees_both_ways():
    lens = Lens("fov", 1200, 600, np.array([300.0, 300.0, 660.5, 500.3, 0.7]))
    # 1e-6 px: printed with six decimals.
    np.testing.assert_allclose(
        lens.project([-40 / 300, 77.3 / 300, 1.0])[0], (619.390018, 579.745040), rtol=0, atol=1e-6
    )
    ray = lens.unproject([542.4, 182.5])[0]
    np.testing.assert_allclose(300.0 * ray[:2] / ray[2], (-144.779236, -389.592219), rtol=0, atol=1e-6)


@pytest.mark.opencv
@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial", "thin_prism"])
def test_polynomial_lenses_equal_opencv(model):
    import cv2

    lens, pts = make(model), points()
    theirs, _ = cv2.projectPoints(
        pts.reshape(-1, 1, 3),
        np.zeros((3, 1)),
        np.zeros((3, 1)),
        lens.camera_matrix(),
        lens.coefficients.reshape(-1, 1),
    )
    mine = lens.project(pts)
    assert np.isfinite(mine).all()
    # 1e-10 px: the same formula in double precision.
    np.testing.assert_allclose(mine, theirs.reshape(-1, 2), rtol=0, atol=1e-10)


@pytest.mark.opencv
def test_equidistant_lens_equals_opencv_fisheye():
    import cv2

    lens, pts = make("equidistant"), points(width=3.0)
    theirs, _ = cv2.fisheye.projectPoints(
        pts.reshape(1, -1, 3),
        np.zeros((3, 1)),
        np.zeros((3, 1)),
        lens.camera_matrix(),
        lens.coefficients.reshape(-1, 1),
    )
    np.testing.assert_allclose(lens.project(pts), theirs.reshape(-1, 2), rtol=0, atol=1e-10)


@pytest.mark.parametrize("model", list(LENSES))
def test_every_lens_puts_the_axis_on_the_principal_point_and_back(model):
    lens = make(model)
    assert lens.project([0.0, 0.0, 1.3])[0].tolist() == [lens.cx_px, lens.cy_px]
    np.testing.assert_allclose(lens.unproject([lens.cx_px, lens.cy_px])[0], [0, 0, 1], atol=1e-15)


@pytest.mark.parametrize("model", list(LENSES))
def test_points_behind_and_not_finite_give_nan(model):
    lens = make(model)
    out = lens.project([[0.0, 0.0, -1.0], [0.1, 0.0, -5.0], [np.nan, 0.0, 1.0], [0.0, 0.0, 0.0], [0.1, 0.1, 1.0]])
    assert np.isnan(out[:4]).all()
    assert np.isfinite(out[4]).all()
    assert np.isnan(lens.unproject([[np.nan, 3.0]])).all()


def test_folding_lens_is_cut_where_it_stops_growing():
    # r (1 - 0.3 r^2) grows up to r = 1 / sqrt(0.9) and then folds back.
    lens = Lens("plumb_bob", 640, 480, np.array([400.0, 400.0, 320.0, 240.0, -0.3, 0.0, 0.0, 0.0, 0.0]))
    edge = 1.0 / np.sqrt(0.9)
    assert np.tan(lens.limit_rad) == pytest.approx(edge, rel=1e-12)
    assert np.isfinite(lens.project([0.999 * edge, 0.0, 1.0])).all()
    assert np.isnan(lens.project([1.001 * edge, 0.0, 1.0])).all()
    largest_px = 320.0 + 400.0 * edge * (1.0 - 0.3 * edge**2)
    assert np.isfinite(lens.unproject([largest_px - 0.01, 240.0])).all()
    assert np.isnan(lens.unproject([largest_px + 0.01, 240.0])).all()


def test_pole_of_the_rational_lens_ends_its_field():
    # Denominator 1 - 0.25 r^2 vanishes at r = 2.
    k = [0.0, 0.0, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0]
    lens = Lens("rational_polynomial", 640, 480, np.array([400.0, 400.0, 320.0, 240.0, *k]))
    assert np.tan(lens.limit_rad) == pytest.approx(2.0, rel=1e-9)
    assert np.isnan(lens.project([2.1, 0.0, 1.0])).all()


def test_fisheye_sees_behind_itself_and_comes_back():
    lens = Lens("equidistant", 1280, 960, np.array([200.0, 200.0, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0]))
    point = np.array([np.sin(1.9), 0.0, np.cos(1.9)])
    px = lens.project(point)
    assert px[0].tolist() == pytest.approx([640.0 + 200.0 * 1.9, 480.0])
    np.testing.assert_allclose(lens.unproject(px)[0], point, atol=1e-14)


def test_fov_inverse_ends_at_ninety_degrees():
    lens = make("fov")
    edge = lens.cx_px + lens.fx_px * 0.5 * np.pi / lens.parameters[4]
    assert np.isfinite(lens.unproject([edge - 1e-3, lens.cy_px])).all()
    assert np.isnan(lens.unproject([edge + 1e-3, lens.cy_px])).all()


@pytest.mark.parametrize("model", list(LENSES))
def test_near_axis_series_joins_without_a_step(model):
    lens = make(model)
    radii = np.array([0.9e-5, 1.1e-5, 0.99e-4, 1.01e-4])
    px = lens.project(np.column_stack([radii, np.zeros(4), np.ones(4)]))[:, 0] - lens.cx_px
    slope = px / radii
    # The map is smooth: slopes at neighbouring radii differ by O(r^2) = 1e-8, and by p2 r for tangential terms.
    for a, b in pairwise(slope):
        assert a == pytest.approx(b, rel=5e-7)


def test_contains_counts_the_outer_half_pixel():
    lens = make("plumb_bob")
    px = [[-0.5, 0.0], [-0.6, 0.0], [639.5, 479.5], [639.6, 0.0], [np.nan, 0.0], [5.0, 5.0]]
    assert lens.contains(px).tolist() == [True, False, True, False, False, True]
    assert lens.contains(px, margin_px=10.0).tolist() == [False] * 6


@pytest.mark.parametrize(
    ("model", "size", "parameters", "said"),
    [
        ("pinhole", (640, 480), [1.0] * 4, "unknown lens model"),
        ("fov", (640, 480), [600.0, 600.0, 320.0, 240.0], "5 parameters"),
        ("fov", (640, 480), [600.0, 600.0, 320.0, 240.0, 4.0], "between 0 and pi"),
        ("plumb_bob", (640, 480), [-600.0, 600.0, 320.0, 240.0, 0, 0, 0, 0, 0], "positive"),
        ("plumb_bob", (0, 480), [600.0, 600.0, 320.0, 240.0, 0, 0, 0, 0, 0], "positive"),
        ("plumb_bob", (640, 480), [600.0, 600.0, 320.0, 240.0, np.nan, 0, 0, 0, 0], "finite"),
    ],
)
def test_impossible_lens_is_refused(model, size, parameters, said):
    with pytest.raises(CalibrationError, match=said):
        Lens(model, *size, np.array(parameters))


def test_kernels_refuse_parameters_without_their_limit():
    lens = make("fov")
    with pytest.raises(ValueError, match="kernel_parameters"):
        project_point(lens.model_id, lens.parameters, 0.1, 0.1, 1.0)
    with pytest.raises(ValueError, match="kernel_parameters"):
        unproject_point(lens.model_id, lens.parameters, 3.0, 4.0)
