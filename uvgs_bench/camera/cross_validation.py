"""What a calibration says about pictures it has not seen: held-out error, and two halves against each other."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.bundle import Bundle, Corners, adjust, refine_poses
from uvgs_bench.camera.lens import Lens
from uvgs_bench.camera.lens_covariance import Doubt, doubt_of
from uvgs_bench.camera.projection_uncertainty import picture_grid
from uvgs_bench.errors import CalibrationError, TooFewViews
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.geometry.se3 import so3_exp

MIN_VIEWS = 3
_FOLDS = 5
_SPLITS = 4
_SEED = 20
_GRID = (9, 7)
_ROTATION_STEPS = 5


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Errors of views the lens was not fitted to, their poses from half their corners, scored on the other half.

    Args:
        rms_px: RMS of the residual lengths over all views, px; infinite when a corner lay beyond the fitted lens.
        fold_rms_px: The same for each fold, px.
        view_rms_px: The same for each view, shape (V,), px.
    """

    rms_px: float
    fold_rms_px: FloatArray
    view_rms_px: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class SplitHalf:
    """Two halves of the views calibrated on their own, compared after the rotation that fits them best.

    Args:
        difference_px: RMS difference of the two projections over the covered picture, all splits together, px.
        predicted_px: The same as the halves' own covariances predict it, px.
        ratio: How many times larger the difference is than predicted; 1 when the covariances are honest.
        ratios: The ratio of each split, shape (S,).
        grid_px: Where the projections were compared, shape (G, 2), px.
        grid_difference_px: RMS difference of all splits at each of these pixels, shape (G,), px; NaN without a ray.
        grid_predicted_px: The same as predicted, shape (G,), px.
    """

    difference_px: float
    predicted_px: float
    ratio: float
    ratios: FloatArray
    grid_px: FloatArray
    grid_difference_px: FloatArray
    grid_predicted_px: FloatArray


def held_out(bundle: Bundle, corners: Corners, prior: FloatArray | None) -> HeldOut | None:
    """K-fold by picture. A pose free to follow every corner would hide a bad lens, so it sees every other corner only.

    Args:
        bundle: Fit to all views.
        corners: Kept corners.
        prior: As in ``adjust``.

    Returns:
        The errors, or None with too few views.
    """
    count = corners.view_count
    folds = min(_FOLDS, count)
    if count - -(-count // folds) < MIN_VIEWS:
        return None
    squares_of_view = np.full(count, inf)
    sizes = corners.per_view(np.ones(len(corners.px)))
    for fold in range(folds):
        out = [i for i in range(count) if i % folds == fold]
        rest = [i for i in range(count) if i % folds != fold]
        try:
            fitted = adjust(bundle.only(rest), corners.only(rest), prior)
        except CalibrationError:
            continue
        unseen = corners.only(out)
        posed = Bundle(fitted.lens, bundle.R_cb[out], bundle.t_cb[out], fitted.shape)
        is_even = _alternating(unseen)
        squares = np.zeros(len(unseen.px))
        for half in (is_even, ~is_even):
            refined = refine_poses(posed, unseen.kept(half))
            e = refined.residuals_px(unseen.kept(~half))
            squares[~half] = np.nan_to_num(np.einsum("ni,ni->n", e, e), nan=inf)
        squares_of_view[out] = unseen.per_view(squares)
    fold_of = np.arange(count) % folds
    return HeldOut(
        float(np.sqrt(squares_of_view.sum() / sizes.sum())),
        read_only(
            [float(np.sqrt(squares_of_view[fold_of == i].sum() / sizes[fold_of == i].sum())) for i in range(folds)]
        ),
        read_only(np.sqrt(squares_of_view / sizes)),
    )


def _alternating(corners: Corners) -> NDArray[np.bool_]:
    """Every other corner of each view."""
    first = corners.bounds()[:-1]
    result: NDArray[np.bool_] = (np.arange(len(corners.view)) - first[corners.view]) % 2 == 0
    return result


def split_half(bundle: Bundle, corners: Corners, prior: FloatArray | None, radius_px: float) -> SplitHalf | None:
    """Calibrate random halves of the views and compare them with what they say of themselves.

    A covariance knows nothing of a lens or board that is not as modelled; two halves see it differently and disagree.

    Args:
        bundle: Fit to all views.
        corners: Kept corners.
        prior: As in ``adjust``.
        radius_px: Distance from the principal point up to which the picture is compared, px.

    Returns:
        The comparison, or None when no split could be calibrated on both sides.

    Source: D. Kogan, mrcal documentation, "Differencing", for the implied rotation.
    """
    count = corners.view_count
    if count < 2 * MIN_VIEWS:
        return None
    grid = picture_grid(bundle.lens, *_GRID)
    grid = grid[np.linalg.norm(grid - bundle.lens.parameters[2:4], axis=1) <= radius_px]
    if len(grid) < 4:
        return None
    rng = np.random.default_rng(_SEED)
    seen, expected = [], []
    for _ in range(_SPLITS):
        order = rng.permutation(count)
        try:
            a, b = (_half(bundle, corners, prior, np.sort(half)) for half in (order[::2], order[1::2]))
            difference, predicted = _compare(a, b, grid)
        except (CalibrationError, np.linalg.LinAlgError):
            continue
        seen.append(difference)
        expected.append(predicted)
    if not seen:
        return None
    by_place, wanted_by_place = np.stack(seen), np.stack(expected)
    squares, wanted = np.nanmean(by_place, axis=1), np.nanmean(wanted_by_place, axis=1)
    return SplitHalf(
        float(np.sqrt(squares.mean())),
        float(np.sqrt(wanted.mean())),
        float(np.sqrt((squares / np.maximum(wanted, 1e-300)).mean())),
        read_only(np.sqrt(squares / np.maximum(wanted, 1e-300))),
        read_only(grid),
        read_only(np.sqrt(by_place.mean(axis=0))),
        read_only(np.sqrt(wanted_by_place.mean(axis=0))),
    )


def _half(
    bundle: Bundle, corners: Corners, prior: FloatArray | None, views: NDArray[np.intp]
) -> tuple[Lens, FloatArray]:
    chosen = [int(view) for view in views]
    part = corners.only(chosen)
    fitted = adjust(bundle.only(chosen), part, prior)
    doubt: Doubt = doubt_of(fitted, part, prior)
    return fitted.lens, doubt.covariance


def _compare(a: tuple[Lens, FloatArray], b: tuple[Lens, FloatArray], grid: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Squared difference of two lenses at each pixel after the rotation that fits them best, and its expectation."""
    at_grid = (np.full(len(grid), np.nan), np.full(len(grid), np.nan))
    rays = a[0].unproject(grid)
    good = np.isfinite(rays).all(axis=1)
    if int(good.sum()) < 4:
        raise TooFewViews("the halves see too little of the picture")
    rays, grid = rays[good], grid[good]
    R = np.eye(3)
    for step in range(_ROTATION_STEPS + 1):
        turned = rays @ R.T
        px, by_point, by_lens = b[0].project_with_jacobians(turned)
        if not np.isfinite(px).all():
            raise TooFewViews("the halves do not see the same picture")
        by_turn = np.cross(turned[:, None, :], by_point).reshape(-1, 3)
        difference = (px - grid).ravel()
        if step < _ROTATION_STEPS:
            turn = np.asarray(np.linalg.lstsq(by_turn, -difference, rcond=None)[0], dtype=np.float64)
            R = so3_exp(turn) @ R
    _, _, by_lens_a = a[0].project_with_jacobians(rays)
    # What the rotation can follow is no difference: project it out of both predictions.
    basis = np.linalg.qr(by_turn)[0]
    variance = np.zeros(len(difference))
    for jacobian, covariance in ((by_lens_a, a[1]), (by_lens, b[1])):
        flat = jacobian.reshape(len(difference), -1)
        free = flat - basis @ (basis.T @ flat)
        variance += np.einsum("ij,jk,ik->i", free, covariance, free)
    for values, of_component in zip(at_grid, (difference**2, variance), strict=True):
        values[good] = of_component.reshape(-1, 2).sum(axis=1)
    return at_grid
