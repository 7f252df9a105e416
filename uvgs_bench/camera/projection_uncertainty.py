"""How well a calibration knows where a point is seen: over the picture, in pixels and across the line of sight.

The boards move along: a change of the lens that the board poses can follow is no error of projection. A point is
carried by the mean motion of all boards; because poses are updated from the left, the mean twist says everything, and
lens and mean twist together have one small covariance.

Source: D. Kogan, mrcal documentation, "Projection uncertainty" (method mean-pcam), with N - p degrees of freedom.
"""

from __future__ import annotations

from math import inf, isinf

import numpy as np
from numpy.typing import ArrayLike

from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.lens import Lens
from uvgs_bench.errors import CalibrationError
from uvgs_bench.geometry import FloatArray


def projection_uncertainty(calibration: Calibration, px: ArrayLike, distance_m: float = inf) -> FloatArray:
    """Covariance of the projection of points that are seen at given pixels.

    Args:
        calibration: With ``joint_covariance``.
        px: Pixels, shape (N, 2), px.
        distance_m: Distance of the points from the camera, m; infinity leaves the translation of the boards out.

    Returns:
        Covariances, shape (N, 2, 2), px^2; NaN where the lens has no ray.

    Raises:
        CalibrationError: The calibration has no joint covariance.
        ValueError: The distance is not positive.
    """
    by_all, _, joint = _jacobians(calibration, px, distance_m)
    result: FloatArray = by_all @ joint @ by_all.swapaxes(1, 2)
    return result


def lateral_uncertainty(calibration: Calibration, px: ArrayLike, distance_m: float) -> FloatArray:
    """Covariance of the place, across the line of sight, of points seen at given pixels.

    Args:
        calibration: With ``joint_covariance``.
        px: Pixels, shape (N, 2), px.
        distance_m: Distance of the points from the camera, m.

    Returns:
        Covariances along two axes perpendicular to the ray (the first in the plane of x and the ray), shape (N, 2, 2),
        m^2; NaN where the lens has no ray.

    Raises:
        CalibrationError: The calibration has no joint covariance.
        ValueError: The distance is not positive, or infinite.
    """
    if isinf(distance_m):
        raise ValueError("a lateral uncertainty needs a finite distance")
    by_all, by_lateral, joint = _jacobians(calibration, px, distance_m)
    back = np.full_like(by_lateral, np.nan)
    good = np.isfinite(by_lateral).all(axis=(1, 2))
    back[good] = np.linalg.inv(by_lateral[good])
    moved = back @ by_all
    result: FloatArray = moved @ joint @ moved.swapaxes(1, 2)
    return result


def worst_sigma(covariances: FloatArray) -> FloatArray:
    """Standard deviation along the worst direction of each covariance.

    Args:
        covariances: Shape (N, 2, 2).

    Returns:
        Deviations, shape (N,), in the root of the covariances' unit; NaN stays NaN.
    """
    a, b, c = covariances[:, 0, 0], covariances[:, 1, 1], covariances[:, 0, 1]
    result: FloatArray = np.sqrt(0.5 * (a + b) + np.sqrt(0.25 * (a - b) ** 2 + c * c))
    return result


def picture_grid(lens: Lens, columns: int, rows: int) -> FloatArray:
    """Pixels spread evenly over a picture, its outermost pixels included, row by row, shape (columns * rows, 2), px."""
    u, v = np.meshgrid(np.linspace(0.0, lens.width_px - 1.0, columns), np.linspace(0.0, lens.height_px - 1.0, rows))
    return np.column_stack([u.ravel(), v.ravel()])


def _jacobians(calibration: Calibration, px: ArrayLike, distance_m: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Derivatives of pixels by lens and mean twist (N, 2, P + 6), by place across the ray (N, 2, 2), and joint."""
    joint = calibration.joint_covariance
    if joint is None:
        raise CalibrationError("the calibration does not say how sure it is of its projection: calibrate again")
    if not distance_m > 0.0:
        raise ValueError(f"the distance must be positive, got {distance_m}")
    # At infinity only directions count: a point one metre away, turned but not shifted.
    reach_m = 1.0 if isinf(distance_m) else distance_m
    rays = calibration.lens.unproject(px)
    points_m = rays * reach_m
    _, by_point, by_lens = calibration.lens.project_with_jacobians(points_m)
    by_turn = np.cross(points_m[:, None, :], by_point)
    by_shift = np.zeros_like(by_point) if isinf(distance_m) else by_point
    first = np.cross(np.cross(rays, [1.0, 0.0, 0.0]), rays)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    across = np.stack([first, np.cross(rays, first)], axis=2)
    return np.concatenate([by_lens, by_turn, by_shift], axis=2), by_point @ across, joint
