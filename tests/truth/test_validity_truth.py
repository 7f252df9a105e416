"""Lenses that changed by a known amount: the difference, its prediction and the verdict are the true ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.camera import BoardView, Calibration, Lens, calibrate
from uvgs_bench.camera.difference import difference, refit
from uvgs_bench.camera.validity import ValidityLimits, check_validity
from uvgs_bench.errors import CalibrationError, TooFewViews
from uvgs_bench.geometry.se3 import rotation_angle, so3_exp

NOISE_PX = 0.1
TRUE = Lens("plumb_bob", 1280, 960, np.array([1000.0, 1003.0, 645.0, 470.0, -0.2, 0.08, 8e-4, -5e-4, 0.01]))
GRID = np.stack(np.meshgrid(np.arange(9.0), np.arange(6.0)), axis=-1).reshape(-1, 2)
BOARD_M = np.column_stack([GRID, np.zeros(54)]) * 0.03


def views(lens: Lens, count: int, seed: int, tilt_rad: float = 0.8) -> list[BoardView]:
    rng = np.random.default_rng(seed)
    centred = BOARD_M - BOARD_M.mean(axis=0)
    found: list[BoardView] = []
    while len(found) < count:
        axis = np.array([*rng.normal(size=2), 0.2 * rng.normal()])
        R = so3_exp(axis / np.linalg.norm(axis) * rng.uniform(0.25 * tilt_rad, tilt_rad))
        direction = lens.unproject(rng.uniform([100.0, 100.0], [1180.0, 860.0]))[0]
        px = lens.project(centred @ R.T + direction * rng.uniform(0.26, 0.45))
        if lens.contains(px, 5.0).all():
            px = px + rng.normal(0.0, NOISE_PX, px.shape)
            found.append(BoardView(f"v{len(found)}", px, BOARD_M, 1280, 960))
    return found


@pytest.fixture(scope="module")
def file() -> Calibration:
    return calibrate(views(TRUE, 20, seed=1), "plumb_bob").calibration


def test_a_turned_camera_has_no_difference():
    """Turning is what a calibration cannot know: a lens with moved centre is, near the axis, a turned one."""
    pinhole = Lens("plumb_bob", 1280, 960, np.array([1000.0, 1000.0, 640.0, 480.0, 0, 0, 0, 0, 0]))
    moved = pinhole.with_parameters(pinhole.parameters + np.array([0, 0, 5.0, 0, 0, 0, 0, 0, 0]))
    found = difference(Calibration(pinhole), Calibration(moved))
    assert rotation_angle(found.R_ba) == pytest.approx(5.0 / 1000.0, rel=0.3)
    # A turn by 5 mrad moves pixels at the edge by f d tan^2: 2 px there on top of 5 everywhere; most is taken out.
    assert found.max_px < 2.5
    assert found.centre_px < 1.0
    assert found.compared_share == 1.0
    same = difference(Calibration(pinhole), Calibration(pinhole))
    # Rays are iterated to 1e-10 px.
    assert same.max_px < 1e-8


def test_a_planted_focal_shift_is_measured_in_the_corner():
    longer = TRUE.with_parameters(TRUE.parameters * np.array([1.001, 1.001, 1, 1, 1, 1, 1, 1, 1]))
    found = difference(Calibration(TRUE), Calibration(longer))
    # 0.1 % of the distance from the principal point; the far corner is 795 px away.
    farthest = float(np.hypot(645.0, 489.0))
    assert found.max_px == pytest.approx(1e-3 * farthest, rel=0.15)


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_two_calibrations_of_one_camera_differ_as_their_covariances_predict(seed):
    a = calibrate(views(TRUE, 12, seed), "plumb_bob", reject_outliers=False).calibration
    b = calibrate(views(TRUE, 12, seed + 100), "plumb_bob", reject_outliers=False).calibration
    found = difference(a, b)
    assert found.predicted_rms_px is not None
    # The nine parameters make the map smooth: few degrees of freedom, so a factor, not per cent.
    assert 0.3 < found.rms_px / found.predicted_rms_px < 2.0
    assert found.sigma_px is not None
    assert np.nanmax(found.sigma_px) > 2.0 * np.nanmin(found.sigma_px)


def test_refitting_is_judged_in_pixels():
    fov = Lens("fov", 1280, 960, np.array([608.8073, 607.61439, 632.53684, 549.08386, 0.998693]))
    found = refit(fov, "equidistant")
    # Four coefficients follow an arctangent to hundredths of a pixel, never exactly.
    assert 1e-6 < found.rms_px < 0.01
    assert found.max_px < 0.1
    assert refit(TRUE, "thin_prism").max_px == 0.0
    with pytest.raises(CalibrationError, match="no plumb_bob lens covers"):
        refit(fov, "plumb_bob")
    wide = Lens("equidistant", 1280, 960, np.array([380.0, 380.0, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0]))
    with pytest.raises(CalibrationError, match="sideways"):
        refit(wide, "fov")


def test_a_camera_that_did_not_change_is_ok(file):
    found = check_validity(file, views(TRUE, 15, seed=50), np.random.default_rng(0))
    assert found.verdict == "ok", found.reasons
    assert found.file_rms_px == pytest.approx(found.held_out_rms_px, rel=0.15)
    assert [figure.verdict for figure in found.figures] == ["ok"] * 4


@pytest.mark.parametrize(
    ("factors", "adds", "name"),
    [
        ([1.01, 1.01], [0.0, 0.0], "focal length"),
        ([1.0, 1.0], [15.0, 0.0], "centre, column"),
        ([1.0, 1.0], [0.0, -15.0], "centre, row"),
    ],
)
def test_planted_changes_are_found_and_measured(file, factors, adds, name):
    parameters = TRUE.parameters.copy()
    parameters[:2] *= factors
    parameters[2:4] += adds
    found = check_validity(file, views(TRUE.with_parameters(parameters), 15, seed=51), np.random.default_rng(0))
    assert found.verdict == "degraded"
    figure = next(figure for figure in found.figures if figure.name == name)
    planted = 1.0 if name == "focal length" else float(np.abs(adds).max()) * np.sign(sum(adds))
    assert figure.verdict == "degraded"
    # The 95 % interval, half as wide again: three cases must not fail by chance.
    slack = 0.25 * (figure.high - figure.low)
    assert figure.low - slack < planted < figure.high + slack
    assert any(name in reason for reason in found.reasons)


def test_changed_distortion_shows_in_the_residual(file):
    parameters = TRUE.parameters.copy()
    parameters[4] += 0.05
    found = check_validity(file, views(TRUE.with_parameters(parameters), 15, seed=52), np.random.default_rng(0))
    assert found.verdict == "degraded"
    assert found.figures[0].verdict == "degraded"
    assert found.held_out_rms_px > 2.0 * found.file_rms_px


def test_views_that_say_nothing_are_inconclusive_never_ok(file):
    flat = check_validity(file, views(TRUE, 4, seed=53, tilt_rad=0.02), np.random.default_rng(0))
    assert flat.verdict == "inconclusive"
    assert any("take more views" in reason for reason in flat.reasons)
    with pytest.raises(TooFewViews, match="2 usable views"):
        check_validity(file, views(TRUE, 2, seed=53), np.random.default_rng(0))
    small = [BoardView("s", v.px, v.board_m, 640, 480) for v in views(TRUE, 3, seed=53)]
    with pytest.raises(CalibrationError, match="640x480"):
        check_validity(file, small, np.random.default_rng(0))


def test_a_file_without_doubt_says_so(file):
    bare = Calibration(file.lens, "bare")
    found = check_validity(bare, views(TRUE, 15, seed=54), np.random.default_rng(0))
    assert [figure.name for figure in found.figures] == ["focal length", "centre, column", "centre, row"]
    assert any("residual" in reason for reason in found.reasons)
    assert any("taken as exact" in reason for reason in found.reasons)


def coverage(count: int) -> float:
    inside = []
    for seed in range(count):
        old = calibrate(views(TRUE, 10, 1000 + seed), "plumb_bob", reject_outliers=False).calibration
        found = check_validity(old, views(TRUE, 10, 5000 + seed), np.random.default_rng(seed), ValidityLimits())
        inside += [figure.low < 0.0 < figure.high for figure in found.figures if figure.name != "residual ratio"]
    return float(np.mean(inside))


def test_intervals_of_an_unchanged_camera_hold_zero():
    # 60 values, correlated in threes: below 0.85 is a 3-sigma surprise for a true 95 %; intervals err to the wide side.
    assert coverage(20) > 0.85


@pytest.mark.slow
def test_intervals_of_an_unchanged_camera_hold_zero_often_enough():
    # 600 values, about 300 independent: 3 sigma of 95 % are 4 %. Student's factor and the wider of two estimates of
    # the noise make the intervals cautious, so only the lower side is held tight.
    assert 0.92 < coverage(200) < 0.999


def test_limits_are_what_is_judged(file):
    found = check_validity(
        file,
        views(TRUE, 15, seed=50),
        np.random.default_rng(0),
        replace(ValidityLimits(), focal_shift_percent=1e-4),
    )
    assert found.verdict != "ok"
