"""What the residuals of a calibration look like beyond their size, and what the boards covered.

Residuals of a right model look like noise: neighbours are independent, no ring of the picture is pushed outwards,
no picture is worse than the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import inf

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.bundle import Bundle, Corners
from uvgs_bench.camera.covered_radius import covered_radius
from uvgs_bench.camera.image_circle import ImageCircle
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, read_only

GRID_COLUMNS, GRID_ROWS = 10, 8
_RINGS = 6


@dataclass(frozen=True, slots=True, eq=False)
class ResidualStructure:
    """Shape of the residuals of the kept corners.

    Args:
        ring_radius_px: Middle radius of rings about the principal point that hold equally many corners, shape (R,), px.
        ring_rms_px: RMS of the residual lengths in each ring, shape (R,), px.
        ring_outward_px: Mean residual away from the principal point in each ring, shape (R,), px.
        neighbour_correlation: Correlation of the residuals of nearest corners of one picture; 0 for noise.
        kurtosis: Fourth standardised moment of the residual components; 3 for normal noise, more with outliers.
        systematic_px: The part of the RMS that neighbours share, px: what the model does not describe.
        rms_rad: RMS angle between seen and predicted rays, rad.
    """

    ring_radius_px: FloatArray
    ring_rms_px: FloatArray
    ring_outward_px: FloatArray
    neighbour_correlation: float
    kurtosis: float
    systematic_px: float
    rms_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """Where the boards were.

    Args:
        counts: Corners in each cell of the picture, shape (rows, columns).
        radius_px: Distance from the principal point up to which the picture is covered, px.
        picture_radius_px: Distance of the picture's farthest corner, or of the farthest edge of its image circle, from
            the principal point, px.
        tilts_rad: Angle between each board and the plane of the picture, shape (V,), rad.
        distances_m: Distance of each board's middle, shape (V,), m.
        is_lit: Whether the middle of each cell lies in the image circle, shape (rows, columns); all without a circle.
        share_radius_px: Distance up to which enough of the picture is covered, empty sides not minded, px.
        short_sides: Sides of the picture by which the radius could be larger, the one that limits it first.
    """

    counts: NDArray[np.intp]
    radius_px: float
    picture_radius_px: float
    tilts_rad: FloatArray
    distances_m: FloatArray
    is_lit: NDArray[np.bool_]
    share_radius_px: float
    short_sides: tuple[str, ...]


def residual_structure(bundle: Bundle, corners: Corners) -> ResidualStructure:
    """Look at the residuals of a fit.

    Args:
        bundle: The fit.
        corners: The kept corners; each must be in the valid field.

    Returns:
        Their structure.
    """
    points_m = bundle.points_in_camera(corners)
    predicted_px = bundle.lens.project(points_m)
    e = corners.px - predicted_px
    offset = predicted_px - bundle.lens.parameters[2:4]
    radius = np.linalg.norm(offset, axis=1)
    outward = np.einsum("ni,ni->n", e, offset / np.maximum(radius, 1e-9)[:, None])
    squares = np.einsum("ni,ni->n", e, e)
    rings = np.array_split(np.argsort(radius, kind="stable"), _RINGS)
    mean_square = float(squares.mean())
    correlation = _neighbour_correlation(e, corners) if mean_square > 0.0 else 0.0
    rays = bundle.lens.unproject(corners.px)
    directions = points_m / np.linalg.norm(points_m, axis=1, keepdims=True)
    angles = np.linalg.norm(np.cross(rays, directions), axis=1)
    return ResidualStructure(
        read_only([float(np.median(radius[ring])) for ring in rings]),
        read_only([float(np.sqrt(squares[ring].mean())) for ring in rings]),
        read_only([float(outward[ring].mean()) for ring in rings]),
        correlation,
        float((e**4).mean() / max((e**2).mean() ** 2, 1e-300)),
        float(np.sqrt(max(correlation, 0.0) * mean_square)),
        float(np.sqrt(np.nanmean(angles**2))) if np.isfinite(angles).any() else inf,
    )


def _neighbour_correlation(e: FloatArray, corners: Corners) -> float:
    """Correlation of each residual with that of the nearest corner on the same board."""
    bounds = corners.bounds()
    product, scale = 0.0, 0.0
    for a, b in pairwise(bounds):
        if b - a < 2:
            continue
        place = corners.points_m[a:b]
        apart = np.linalg.norm(place[:, None] - place[None, :], axis=2)
        np.fill_diagonal(apart, inf)
        near = e[a:b][np.argmin(apart, axis=1)]
        product += float((e[a:b] * near).sum())
        scale += float(0.5 * ((e[a:b] ** 2).sum() + (near**2).sum()))
    return product / scale if scale > 0.0 else 0.0


def coverage(bundle: Bundle, corners: Corners, circle: ImageCircle | None = None) -> Coverage:
    """Say where in the picture, how tilted and how far the boards were.

    Args:
        bundle: The fit.
        corners: The kept corners.
        circle: Where the lens draws its picture; None when it fills the sensor.

    Returns:
        The coverage.
    """
    lens = bundle.lens
    column = np.clip(((corners.px[:, 0] + 0.5) * GRID_COLUMNS / lens.width_px).astype(np.intp), 0, GRID_COLUMNS - 1)
    row = np.clip(((corners.px[:, 1] + 0.5) * GRID_ROWS / lens.height_px).astype(np.intp), 0, GRID_ROWS - 1)
    counts = np.zeros((GRID_ROWS, GRID_COLUMNS), dtype=np.intp)
    np.add.at(counts, (row, column), 1)
    sizes = corners.per_view(np.ones(len(corners.px)))
    middle = corners.per_view(bundle.points_in_camera(corners)) / sizes[:, None]
    cells_px, is_lit = cell_centres_px(lens), np.ones(counts.size, dtype=np.bool_)
    whole_px = picture_radius_px(lens)
    if circle is not None:
        is_lit = circle.contains(cells_px)
        off_px = float(np.hypot(circle.u_px - lens.cx_px, circle.v_px - lens.cy_px))
        whole_px = min(whole_px, off_px + circle.radius_px)
    covered = covered_radius(lens, cells_px, counts.ravel() > 0, is_lit, corners.px, circle)
    return Coverage(
        counts,
        covered.radius_px,
        whole_px,
        read_only(np.arccos(np.clip(np.abs(bundle.R_cb[:, 2, 2]), 0.0, 1.0))),
        read_only(np.linalg.norm(middle, axis=1)),
        is_lit.reshape(counts.shape),
        covered.share_radius_px,
        covered.short_sides,
    )


def picture_radius_px(lens: Lens) -> float:
    """Distance of the picture's farthest corner from the principal point, px."""
    edges = np.array([[u, v] for u in (-0.5, lens.width_px - 0.5) for v in (-0.5, lens.height_px - 0.5)])
    return float(np.linalg.norm(edges - lens.parameters[2:4], axis=1).max())


def cell_centres_px(lens: Lens) -> FloatArray:
    """Centres of the cells of the coverage, row by row, shape (rows * columns, 2), px."""
    u, v = np.meshgrid(
        (np.arange(GRID_COLUMNS) + 0.5) * lens.width_px / GRID_COLUMNS - 0.5,
        (np.arange(GRID_ROWS) + 0.5) * lens.height_px / GRID_ROWS - 0.5,
    )
    return np.column_stack([u.ravel(), v.ravel()])
