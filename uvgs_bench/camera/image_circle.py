"""The circle a fisheye draws on a sensor larger than its picture; outside it there is nothing to calibrate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray

_RAYS = 180
# Outside the circle it is dark in every picture: below this share of the bright parts.
_DARK_SHARE = 0.15
# Edge points this near to the circle, as a share of its radius, and at least so many of all rays, make it one.
_NEAR_SHARE, _LEAST_NEAR, _LEAST_RAYS = 0.03, 0.7, 60
_LEAST_RADIUS_SHARE = 0.25


@dataclass(frozen=True, slots=True)
class ImageCircle:
    """Where a lens draws its picture.

    Args:
        u_px: Centre, column, px.
        v_px: Centre, row, px.
        radius_px: Radius, px.
    """

    u_px: float
    v_px: float
    radius_px: float

    def contains(self, px: FloatArray) -> NDArray[np.bool_]:
        """Whether pixels, shape (N, 2), lie inside."""
        inside: NDArray[np.bool_] = np.hypot(px[:, 0] - self.u_px, px[:, 1] - self.v_px) <= self.radius_px
        return inside


def find_image_circle(brightest: NDArray[np.generic]) -> ImageCircle | None:
    """Find the image circle in the brightest value each pixel had over all pictures.

    Args:
        brightest: Grey values, shape (H, W).

    Returns:
        The circle; None when the picture fills its corners, or what is lit is no circle.
    """
    grey = np.asarray(brightest, dtype=np.float64)
    lit = grey > _DARK_SHARE * float(np.percentile(grey, 95))
    height, width = lit.shape
    corner = max(2, min(height, width) // 50)
    if any(lit[rows, columns].any() for rows in _ends(corner) for columns in _ends(corner)):
        return None
    v, u = np.nonzero(lit)
    if not len(u):
        return None
    edge = _edge_points(lit, float(u.mean()), float(v.mean()))
    if len(edge) < _LEAST_RAYS:
        return None
    near = np.ones(len(edge), dtype=np.bool_)
    for _ in range(5):
        # u^2 + v^2 = 2 a u + 2 b v + c is linear in centre and radius.
        rows = np.column_stack([2.0 * edge[near], np.ones(int(near.sum()))])
        a, b, c = np.linalg.lstsq(rows, (edge[near] ** 2).sum(axis=1), rcond=None)[0]
        radius = float(np.sqrt(max(c + a * a + b * b, 0.0)))
        off = np.abs(np.hypot(edge[:, 0] - a, edge[:, 1] - b) - radius)
        near = off < max(_NEAR_SHARE * radius, float(np.median(off)))
    is_circle = float((off < _NEAR_SHARE * radius).mean()) >= _LEAST_NEAR
    if not is_circle or radius < _LEAST_RADIUS_SHARE * min(height, width):
        return None
    return ImageCircle(float(a), float(b), radius)


def _ends(count: int) -> tuple[slice, slice]:
    return slice(None, count), slice(-count, None)


def _edge_points(lit: NDArray[np.bool_], u: float, v: float) -> FloatArray:
    """Where rays from the middle leave what is lit for the last time, unless the picture ends before, shape (N, 2)."""
    height, width = lit.shape
    steps = np.arange(0.0, float(np.hypot(height, width)))
    found = []
    for angle in np.linspace(0.0, 2.0 * np.pi, _RAYS, endpoint=False):
        column = np.rint(u + np.cos(angle) * steps).astype(np.intp)
        row = np.rint(v + np.sin(angle) * steps).astype(np.intp)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        seen = np.flatnonzero(lit[row[inside], column[inside]])
        if len(seen) and seen[-1] < int(inside.sum()) - 2:
            found.append((float(column[seen[-1]]), float(row[seen[-1]])))
    return np.array(found).reshape(-1, 2)
