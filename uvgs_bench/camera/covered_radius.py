"""How far from the principal point boards covered the picture, on every side of it.

Two rules, the same for every camera:

1. Of the cells whose middle lies within the radius, ``COVERED_SHARE`` hold a corner.
2. On each of eight sides a corner lies as far out as the radius, or in the last ``EDGE_SHARE`` of the way to the
   picture's edge in its direction. Without this rule one side may stay empty while the others make up the share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.image_circle import ImageCircle
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray

COVERED_SHARE = 0.8
"""Less than all: a few cells stay empty by chance, and a lens does not change within one cell."""

EDGE_SHARE = 0.1
"""A board's outermost corners never reach the very edge of a picture: its margin must be seen, too."""

# Clockwise from the right, v points down.
_SIDES = (
    "right edge", "bottom right corner", "bottom edge", "bottom left corner",
    "left edge", "top left corner", "top edge", "top right corner",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class CoveredRadius:
    """How far boards covered the picture.

    Args:
        radius_px: Distance from the principal point, px.
        share_radius_px: The same by the first rule alone, px.
        short_sides: Sides by which it could be larger, for example ``left edge``, the one that limits it first; empty
            when it is no single side.
    """

    radius_px: float
    share_radius_px: float
    short_sides: tuple[str, ...] = ()


def covered_radius(
    lens: Lens,
    cells_px: FloatArray,
    is_seen: NDArray[np.bool_],
    is_lit: NDArray[np.bool_],
    corners_px: FloatArray,
    circle: ImageCircle | None,
) -> CoveredRadius:
    """Apply the two rules.

    Args:
        lens: The lens.
        cells_px: Centres of the cells of the picture, shape (N, 2), px.
        is_seen: Whether a corner was seen in each cell, shape (N,).
        is_lit: Whether the lens draws a picture in each cell, shape (N,).
        corners_px: All corners, shape (M, 2), px.
        circle: Where the lens draws its picture; None when it fills the sensor.

    Returns:
        The radius, at most that of the outermost corner.
    """
    middle = lens.parameters[2:4]
    offset = corners_px - middle
    distance = np.linalg.norm(offset, axis=1)
    by_share = _by_cells(np.linalg.norm(cells_px - middle, axis=1)[is_lit], is_seen[is_lit])
    by_share = min(by_share, float(distance.max()))
    side_of_corner = _side(offset)
    is_at_edge = distance >= (1.0 - EDGE_SHARE) * _edge_distance_px(lens, offset, circle)
    short = []
    for side in np.unique(_side(cells_px[is_lit] - middle)):
        here = side_of_corner == side
        reach = float(distance[here].max()) if here.any() else 0.0
        if reach < by_share and not is_at_edge[here].any():
            short.append((reach, _SIDES[side]))
    short.sort()
    return CoveredRadius(min([by_share, *(reach for reach, _ in short)]), by_share, tuple(name for _, name in short))


def _by_cells(radius: FloatArray, is_seen: NDArray[np.bool_]) -> float:
    """Largest radius within which enough cells hold a corner: up to the middle of the first cell that is too much."""
    order = np.argsort(radius, kind="stable")
    share = np.cumsum(is_seen[order]) / np.arange(1, len(order) + 1)
    enough = np.flatnonzero(share >= COVERED_SHARE)
    if not enough.size:
        return 0.0
    following = int(enough[-1]) + 1
    return float(radius[order[following]]) if following < len(order) else np.inf


def _side(offset: FloatArray) -> NDArray[np.intp]:
    """Number of the side each offset from the principal point, shape (N, 2), points to."""
    turns = np.arctan2(offset[:, 1], offset[:, 0]) * (len(_SIDES) / (2.0 * np.pi))
    result: NDArray[np.intp] = np.rint(turns).astype(np.intp) % len(_SIDES)
    return result


def _edge_distance_px(lens: Lens, offset: FloatArray, circle: ImageCircle | None) -> FloatArray:
    """How far from the principal point the picture ends in the direction of each offset, shape (N,), px."""
    direction = offset / np.maximum(np.linalg.norm(offset, axis=1), 1e-9)[:, None]
    high = np.where(direction > 0.0, [lens.width_px - 0.5, lens.height_px - 0.5], -0.5)
    steps = np.abs(high - lens.parameters[2:4]) / np.maximum(np.abs(direction), 1e-12)
    edge: FloatArray = steps.min(axis=1)
    if circle is None:
        return edge
    away = lens.parameters[2:4] - [circle.u_px, circle.v_px]
    along = direction @ away
    rim = -along + np.sqrt(np.maximum(along**2 - float(away @ away) + circle.radius_px**2, 0.0))
    result: FloatArray = np.minimum(edge, rim)
    return result
