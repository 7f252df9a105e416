"""Calibrations of simulated corners: every lens comes back, and the stated doubt is the true one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from uvgs_bench.camera import BoardView, Lens, calibrate
from uvgs_bench.camera.bundle import Bundle, Corners, refine_poses
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.fitting import fit
from uvgs_bench.camera.projection_uncertainty import projection_uncertainty
from uvgs_bench.camera.verdict import judge_calibration
from uvgs_bench.geometry.se3 import se3_log, so3_exp

NOISE_PX = 0.1
TRUE = {
    "plumb_bob": [1000.0, 1003.0, 645.0, 470.0, -0.2, 0.08, 8e-4, -5e-4, 0.01],
    "rational_polynomial": [620.0, 622.0, 645.0, 470.0, 0.35, 0.12, 8e-4, -5e-4, 0.01, 0.75, 0.3, 0.05],
    "thin_prism": [620.0, 622.0, 645.0, 470.0, 0.35, 0.12, 8e-4, -5e-4, 0.01, 0.75, 0.3, 0.05, 2e-3, 1e-3, -1e-3, 1e-3],
    "equidistant": [400.0, 401.0, 645.0, 470.0, 0.03, -0.01, 0.004, -0.001],
    "fov": [608.8073, 607.61439, 632.53684, 549.08386, 0.998693],
}


def board() -> np.ndarray:
    y, x = np.mgrid[0:6, 0:9]
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(54)]) * 0.03


def views(lens: Lens, count: int, rng: np.random.Generator, noise_px: float = NOISE_PX) -> list[BoardView]:
    points_m = board()
    centred = points_m - points_m.mean(axis=0)
    found: list[BoardView] = []
    while len(found) < count:
        axis = rng.normal(size=3)
        R = so3_exp(axis / np.linalg.norm(axis) * rng.uniform(0.2, 0.8))
        direction = lens.unproject(rng.uniform([100.0, 100.0], [1180.0, 860.0]))[0]
        seen = centred @ R.T + direction * 260.0 * rng.uniform(0.8, 1.4) / lens.fx_px
        px = lens.project(seen)
        if lens.contains(px, 5.0).all():
            px = px + rng.normal(0.0, noise_px, px.shape)
            found.append(BoardView(f"v{len(found)}", px, points_m, lens.width_px, lens.height_px))
    return found


@pytest.mark.parametrize("model", list(TRUE))
def test_every_lens_is_recovered_without_a_guess(model):
    lens = Lens(model, 1280, 960, np.array(TRUE[model]))
    rng = np.random.default_rng(21)
    fitted = fit(views(lens, 15, rng), model, reject_outliers=False)
    residuals = fitted.bundle.residuals_px(fitted.corners)
    assert np.sqrt((residuals**2).mean()) == pytest.approx(NOISE_PX, rel=0.08)
    grid = np.stack(np.meshgrid(np.linspace(250, 1030, 9), np.linspace(200, 760, 7)), axis=-1).reshape(-1, 2)
    rays = lens.unproject(grid)
    px, _, by_lens = fitted.bundle.lens.project_with_jacobians(rays)
    sigma_px = np.sqrt(np.einsum("nij,jk,nik->ni", by_lens, fitted.doubt.covariance, by_lens))
    assert np.isfinite(px).all()
    # Five standard deviations of the predicted pixel: 126 correlated values, so four are expected to be rare.
    assert (np.abs(px - grid) < 5.0 * sigma_px).all()


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant", "fov"])
def test_noise_free_corners_give_the_lens_back(model):
    lens = Lens(model, 1280, 960, np.array(TRUE[model]))
    fitted = fit(views(lens, 10, np.random.default_rng(4), noise_px=0.0), model, reject_outliers=False).bundle
    # Rounding of pixels (1e-13) times the condition of the problem; coefficients of high order are the weakest.
    np.testing.assert_allclose(fitted.lens.parameters, lens.parameters, rtol=0, atol=1e-6)


# Seeds at which an adjustment from the focal length of a pinhole stopped in a bent valley, with residuals of 0.11 to
# 0.36 px and a focal length up to 130 px off.
@pytest.mark.parametrize("seed", [1012, 1020, 1026, 1028])
def test_wide_lenses_end_at_the_minimum_and_not_in_a_valley(seed):
    lens = Lens("equidistant", 1280, 960, np.array(TRUE["equidistant"]))
    rng = np.random.default_rng(seed)
    exact = views(lens, 15, rng, noise_px=0.0)
    noisy = [replace(view, px=view.px + rng.normal(0.0, NOISE_PX, view.px.shape)) for view in exact]
    fitted = fit(noisy, "equidistant", reject_outliers=False)
    assert fitted.is_at_rest
    deviation = (fitted.bundle.lens.parameters - lens.parameters) / np.sqrt(np.diag(fitted.doubt.covariance))
    # Eight correlated parameters of four calibrations: five deviations never.
    assert np.abs(deviation).max() < 5.0


def test_an_adjustment_that_did_not_come_to_rest_is_never_usable():
    seen = views(Lens("plumb_bob", 1280, 960, np.array(TRUE["plumb_bob"])), 12, np.random.default_rng(5))
    result = calibrate(seen, "plumb_bob")
    assert result.is_at_rest
    assert result.calibration.verdict.is_usable
    verdict = judge_calibration(replace(result, is_at_rest=False))
    assert verdict.word == "not_usable"
    assert "did not come to rest" in verdict.reasons[0]


def test_a_high_order_lens_in_a_wrong_minimum_is_never_usable():
    """So wide and so bent that the adjustment ends, at rest, with residuals of seventeen times the noise."""
    lens = Lens("thin_prism", 1280, 960, np.array(TRUE["thin_prism"]) * np.r_[0.75, 0.75, np.ones(14)])
    result = calibrate(views(lens, 14, np.random.default_rng(3)), "thin_prism")
    assert result.calibration.verdict.word == "not_usable"
    assert not any("views are too few" in reason for reason in result.calibration.verdict.reasons)


def check_coverage(model: str, count: int, *, is_noise_equal: bool = True) -> None:
    """95 % intervals of parameters and 95 % ellipses of projected points hold the truth as often as they say."""
    lens = Lens(model, 1280, 960, np.array(TRUE[model]))
    rays = lens.unproject(np.stack(np.meshgrid([300.0, 640.0, 980.0], [250.0, 480.0, 710.0]), -1).reshape(-1, 2))
    distances, inside, seen = [], [], []
    for seed in range(count):
        rng = np.random.default_rng(1000 + seed)
        exact = views(lens, 15, rng, noise_px=0.0)
        noises = np.full(15, NOISE_PX) if is_noise_equal else np.where(np.arange(15) % 3 == 0, 0.4, 0.07)
        noisy = [
            replace(view, px=view.px + rng.normal(0.0, noise, view.px.shape))
            for view, noise in zip(exact, noises, strict=True)
        ]
        fitted = fit(noisy, model, reject_outliers=not is_noise_equal)
        covariance = fitted.doubt.covariance
        d = fitted.bundle.lens.parameters - lens.parameters
        distances.append(float(d @ np.linalg.solve(covariance, d)))
        inside.append(np.abs(d) < 1.96 * np.sqrt(np.diag(covariance)))
        # True poses: those of the true lens for the exact corners.
        corners = Corners.of(exact)
        true = refine_poses(Bundle(lens, fitted.bundle.R_cb, fitted.bundle.t_cb), corners)
        pairs = zip(true.R_cb, true.t_cb, fitted.bundle.R_cb, fitted.bundle.t_cb, strict=True)
        twist = np.mean([se3_log(R2 @ R.T, t2 - R2 @ R.T @ t) for R, t, R2, t2 in pairs], axis=0)
        calibration = Calibration(lens, joint_covariance=fitted.doubt.joint)
        moved = rays + np.cross(twist[:3], rays) + twist[3:]
        px = lens.project(rays)
        error = fitted.bundle.lens.project(moved) - px
        expected = np.linalg.inv(projection_uncertainty(calibration, px, 1.0))
        seen.append(np.einsum("ni,nij,nj->n", error, expected, error) < chi2.ppf(0.95, 2))
    size = lens.parameters.size
    by_parameter, by_place = np.mean(inside, axis=0), np.mean(seen, axis=0)
    names = zip(lens.parameter_names, by_parameter, strict=True)
    print(f"{model}, {count} calibrations: " + ", ".join(f"{name} {100 * share:.1f} %" for name, share in names))
    print("  projected points " + ", ".join(f"{100 * share:.1f} %" for share in by_place))
    low, high = chi2.ppf([0.0005, 0.9995], size * count)
    # The sum of squared Mahalanobis distances of honest covariances is chi-square; 99.9 % of seeds lie between.
    # Variances estimated picture by picture spread a little more.
    assert low < sum(distances) < (high if is_noise_equal else 1.2 * high)
    # 95 % intervals; parameters of one calibration are correlated, so each calibration counts as two draws. The points
    # of one calibration likewise.
    allowed = 3.3 * np.sqrt(0.95 * 0.05 / (2 * count))
    assert abs(float(np.mean(inside)) - 0.95) < allowed
    assert abs(float(np.mean(seen)) - 0.95) < allowed
    if count >= 1000:
        # What a long study must reach, parameter by parameter and place by place: one and a half percent, 2.2 standard
        # errors of a share of 1000.
        shares = np.concatenate([by_parameter, by_place])
        assert np.abs(shares - 0.95).max() < 0.015


@pytest.mark.parametrize("model", ["plumb_bob", "fov"])
def test_stated_deviations_are_the_true_ones(model):
    check_coverage(model, 15)


def test_stated_deviations_are_the_true_ones_when_some_pictures_are_blurred():
    check_coverage("plumb_bob", 15, is_noise_equal=False)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("model", ["plumb_bob", "equidistant", "fov"])
def test_stated_deviations_are_the_true_ones_in_long(model):
    check_coverage(model, 1000)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_stated_deviations_are_the_true_ones_in_long_when_some_pictures_are_blurred():
    check_coverage("plumb_bob", 1000, is_noise_equal=False)
