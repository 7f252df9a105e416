"""What changed from picture to picture: a focus that moved, and pictures taken in motion.

A lens has one focal length for all pictures. Here each picture gets its own, the rest of the lens held, and the change
is looked at in the order the pictures were taken.

Source: K. Madsen et al., Methods for non-linear least squares problems (2004), for the step from the normal equations.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi

import numpy as np

from uvgs_bench.camera.bundle import Bundle, Corners, normal_of_views
from uvgs_bench.geometry import FloatArray, read_only

# A line through fewer changes says nothing.
_LEAST_VIEWS = 5
# Residuals of few corners lie along a line by chance.
_LEAST_CORNERS = 15
# Deviation of residuals along over across beyond which a picture was taken in motion: noise alone reaches 1.5
# with 24 corners.
_STREAK_RATIO = 2.0


@dataclass(frozen=True, slots=True)
class Streak:
    """A picture whose residuals lie along one direction.

    Args:
        view: Its number.
        ratio: Deviation along over deviation across.
        direction_rad: The direction, from the columns' axis towards the rows' axis, 0 to pi, rad.
    """

    view: int
    ratio: float
    direction_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class ViewTrends:
    """Changes over the pictures, in their order.

    Args:
        focal_change: Relative change of the focal length in each picture, shape (V,); NaN where a picture cannot tell.
        focal_sigma: Its deviation, shape (V,).
        drift: Change from the first to the last picture by a straight line, relative.
        drift_sigma: Its deviation, by the scatter about the line where that is more than the pictures' own.
        streaks: Pictures taken in motion, worst first.
    """

    focal_change: FloatArray
    focal_sigma: FloatArray
    drift: float
    drift_sigma: float
    streaks: tuple[Streak, ...]


def view_trends(bundle: Bundle, corners: Corners, view_noise_px: FloatArray) -> ViewTrends:
    """Look for changes over the pictures.

    Args:
        bundle: The fit.
        corners: The kept corners, in the order the pictures were taken.
        view_noise_px: Deviation of a residual component in each view, shape (V,), px.

    Returns:
        The changes.
    """
    change, sigma = _focal_changes(bundle, corners, view_noise_px)
    drift, drift_sigma = _line(change, sigma)
    residuals = bundle.residuals_px(corners)
    bounds = corners.bounds()
    streaks = [_streak(i, residuals[bounds[i] : bounds[i + 1]]) for i in range(corners.view_count)]
    found = sorted((s for s in streaks if s is not None), key=lambda streak: -streak.ratio)
    return ViewTrends(read_only(change), read_only(sigma), drift, drift_sigma, tuple(found))


def _focal_changes(bundle: Bundle, corners: Corners, noise_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """One step of each picture's own focal length, its pose following."""
    normal = normal_of_views(bundle, corners)
    along = np.zeros(bundle.common.size)
    along[:2] = bundle.lens.parameters[:2]
    mixed = normal.mixed @ along
    follow = np.linalg.solve(normal.poses, mixed[:, :, None])[:, :, 0]
    told = normal.common @ along @ along - np.einsum("vi,vi->v", mixed, follow)
    pull = normal.gradient_common @ along - np.einsum("vi,vi->v", follow, normal.gradient_poses)
    with np.errstate(divide="ignore", invalid="ignore"):
        is_told = told > 0.0
        return np.where(is_told, pull / told, np.nan), np.where(is_told, noise_px / np.sqrt(told), inf)


def _line(change: FloatArray, sigma: FloatArray) -> tuple[float, float]:
    """Weighted straight line over the order: its rise from first to last, and the deviation of that."""
    good = np.isfinite(change) & np.isfinite(sigma)
    if int(good.sum()) < _LEAST_VIEWS:
        return 0.0, inf
    place = np.linspace(-0.5, 0.5, len(change))[good]
    weight = 1.0 / sigma[good] ** 2
    offset = place - (weight @ place) / weight.sum()
    spread = float(weight @ offset**2)
    rise = float(weight @ (offset * change[good])) / spread
    left = change[good] - (weight @ change[good]) / weight.sum() - rise * offset
    excess = float(weight @ left**2) / (len(left) - 2)
    return rise, float(np.sqrt(max(excess, 1.0) / spread))


def _streak(view: int, e: FloatArray) -> Streak | None:
    if len(e) < _LEAST_CORNERS:
        return None
    squares, axes = np.linalg.eigh(e.T @ e)
    ratio = float(np.sqrt(squares[1] / max(float(squares[0]), 1e-300)))
    if ratio < _STREAK_RATIO or squares[1] == 0.0:
        return None
    return Streak(view, ratio, float(np.arctan2(axes[1, 1], axes[0, 1]) % pi))
