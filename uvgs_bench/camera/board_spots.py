"""Round spots in a picture, and the grid they form: shared by circle boards and grids of lights.

Spots are regions of the shape of an ellipse; their centres are centroids of grey value, so that blur and pixel steps
do not move them. The grid grows from one spot to the next, each step predicted by the one before, so that lens
distortion and perspective bend it at will.
"""

from __future__ import annotations

from collections import deque
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray

Cell = tuple[int, int]
_MIN_AREA_PX = 4
_MAX_AREA_SHARE = 0.02
# Area over that of the ellipse of the same second moments; a square has 0.95, a ring or a letter far less.
_ELLIPSE_SHARE = (0.85, 1.1)
_MAX_ASPECT = 4.0
_RING_PX = 3
# How far from its predicted place the next spot may lie, in steps.
_TOLERANCE = 0.3
# Under tilt a diagonal may be the shorter step: the same lattice, counted along it.
_SHEARS = tuple(
    np.array(shear)
    for shear in ([[1, 0], [0, 1]], [[1, 1], [0, 1]], [[1, -1], [0, 1]], [[1, 0], [1, 1]], [[1, 0], [-1, 1]])
)


def find_spots(bright: NDArray[np.uint8], threshold: NDArray[np.uint8], min_area_px: int = 12) -> FloatArray:
    """Centres of bright, elliptic regions.

    Args:
        bright: Picture with bright spots, shape (H, W).
        threshold: The same thresholded, nonzero where bright.
        min_area_px: Smallest region that counts, px; below 12 its shape is not looked at.

    Returns:
        Centres, shape (N, 2), px.
    """
    import cv2

    height, width = bright.shape
    count, labels, stats, _ = cv2.connectedComponentsWithStats(threshold, connectivity=8)
    found: list[tuple[float, float, float]] = []
    for label in range(1, count):
        left, top, wide, high, area = (int(value) for value in stats[label])
        if not min_area_px <= area <= _MAX_AREA_SHARE * width * height:
            continue
        reach = _RING_PX + 1
        x0, y0 = left - reach, top - reach
        x1, y1 = left + wide + reach, top + high + reach
        if x0 < 0 or y0 < 0 or x1 > width or y1 > height:
            continue
        own = labels[y0:y1, x0:x1] == label
        if area >= 12 and not _is_elliptic(own):
            continue
        centre = _grey_centroid(bright[y0:y1, x0:x1], own, (labels[y0:y1, x0:x1] > 0) & ~own)
        if centre is not None:
            found.append((x0 + centre[0], y0 + centre[1], float(area)))
    if not found:
        return np.empty((0, 2))
    spots = np.array(found)
    # Spots of one board differ in size by perspective, not by more.
    like = np.abs(np.log(spots[:, 2] / np.median(spots[:, 2]))) < np.log(6.0)
    return np.ascontiguousarray(spots[like, :2])


def _is_elliptic(own: NDArray[np.bool_]) -> bool:
    y, x = np.nonzero(own)
    # Each pixel is a square, not a point: a twelfth of a pixel squared more.
    covariance = np.cov(np.stack([x, y])) + np.eye(2) / 12.0
    small, large = np.linalg.eigvalsh(covariance)
    if large > _MAX_ASPECT**2 * small:
        return False
    share = len(x) / (4.0 * np.pi * np.sqrt(small * large))
    return bool(_ELLIPSE_SHARE[0] < share < _ELLIPSE_SHARE[1])


def _grey_centroid(
    patch: NDArray[np.uint8], own: NDArray[np.bool_], others: NDArray[np.bool_]
) -> tuple[float, float] | None:
    import cv2

    kernel = np.ones((3, 3), np.uint8)
    near = cv2.dilate(own.astype(np.uint8), kernel, iterations=_RING_PX).astype(bool) & ~others
    ring = ~near & ~others
    if not ring.any():
        return None
    weight = np.where(near, patch.astype(np.float64) - float(np.median(patch[ring])), 0.0)
    total = float(weight.sum())
    if total <= 0.0:
        return None
    y, x = np.mgrid[0 : patch.shape[0], 0 : patch.shape[1]]
    return float((weight * x).sum() / total), float((weight * y).sum() / total)


def grow_grid(px: FloatArray) -> dict[Cell, int]:
    """Number spots along the two shortest directions of the grid they form.

    Args:
        px: Spots, shape (N, 2), px; some may belong to no grid.

    Returns:
        Index of a spot by its cell (along the first, along the second direction); the largest grid found.
    """
    best: dict[Cell, int] = {}
    if len(px) < 4:
        return best
    apart = np.linalg.norm(px[:, None] - px[None], axis=2)
    # From the middle outwards: there the grid is most even.
    for seed in np.argsort(np.linalg.norm(px - np.median(px, axis=0), axis=1))[:8]:
        basis = _basis(px, apart, int(seed))
        if basis is None:
            continue
        grid = _grown(px, int(seed), basis)
        if len(grid) > len(best):
            best = grid
        if len(best) > 0.8 * len(px):
            break
    return _completed(px, best) if best else best


def _basis(px: FloatArray, apart: FloatArray, seed: int) -> FloatArray | None:
    """Two steps from a spot that it has in both directions, the shortest such."""
    near = np.argsort(apart[seed])[1:13]
    steps = px[near] - px[seed]
    both_ways = [
        step for step in steps if (np.linalg.norm(steps + step, axis=1) < _TOLERANCE * np.linalg.norm(step)).any()
    ]
    for i, first in enumerate(both_ways):
        for second in both_ways[i + 1 :]:
            cross = abs(float(first[0] * second[1] - first[1] * second[0]))
            if cross > 0.4 * float(np.linalg.norm(first) * np.linalg.norm(second)):
                return np.array([first, second])
        break
    return None


def _grown(px: FloatArray, seed: int, basis: FloatArray) -> dict[Cell, int]:
    grid: dict[Cell, int] = {(0, 0): seed}
    taken = {seed}
    steps: dict[Cell, FloatArray] = {(0, 0): basis}
    queue: deque[Cell] = deque([(0, 0)])
    while queue:
        a, b = queue.popleft()
        here, local = px[grid[a, b]], steps[a, b]
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            cell = (a + sign, b) if axis == 0 else (a, b + sign)
            if cell in grid:
                continue
            step = sign * local[axis]
            error = np.linalg.norm(px - (here + step), axis=1)
            nearest = int(np.argmin(error))
            if nearest in taken or error[nearest] > _TOLERANCE * float(np.linalg.norm(step)):
                continue
            grid[cell] = nearest
            taken.add(nearest)
            fresh = local.copy()
            fresh[axis] = sign * (px[nearest] - here)
            steps[cell] = fresh
            queue.append(cell)
    return grid


def _completed(px: FloatArray, grid: dict[Cell, int]) -> dict[Cell, int]:
    """The grid with the ends of its lines, which steps along a diagonal may not reach."""
    cells = squared_up(np.array(list(grid)))
    whole = {(int(a), int(b)): spot for (a, b), spot in zip(cells, grid.values(), strict=True)}
    taken = set(whole.values())
    queue = deque(whole)
    while queue:
        a, b = queue.popleft()
        for da, db in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            cell, before = (a + da, b + db), (a - da, b - db)
            if cell in whole or before not in whole:
                continue
            step = px[whole[a, b]] - px[whole[before]]
            error = np.linalg.norm(px - (px[whole[a, b]] + step), axis=1)
            nearest = int(np.argmin(error))
            if nearest not in taken and error[nearest] < _TOLERANCE * float(np.linalg.norm(step)):
                whole[cell] = nearest
                taken.add(nearest)
                queue += [cell, (a, b)]
    return whole


def squared_up(cells: NDArray[np.intp]) -> NDArray[np.intp]:
    """Cells counted along the two directions in which they fill the smallest rectangle, shape (N, 2)."""
    return min((cells @ shear.T for shear in _SHEARS), key=lambda form: int(np.prod(np.ptp(form, axis=0) + 1)))


def match_cells(
    found: dict[Cell, int], wanted: dict[Cell, int], px: FloatArray, min_share: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]] | tuple[str, str]:
    """Lay a found grid over the declared one.

    Args:
        found: Index of a spot by cell, any origin and orientation.
        wanted: Index of a board point by cell of the same lattice; origin at the smallest cell.
        px: Spots, shape (N, 2), px.
        min_share: Share of the wanted points that must be there.

    Returns:
        Indices of spots and of their board points; or reason and detail. Where several orientations fit, the one whose
        columns run most to the right is taken: such a board looks the same when turned.
    """
    cells = np.array(list(found))
    spots = np.array(list(found.values()))
    size = np.max(list(wanted), axis=0) + 1
    fits: list[tuple[float, Any, Any]] = []
    for shear, turn in product(_SHEARS, _turns(cells, px[spots])):
        shifted = cells @ (turn @ shear).T
        shifted = shifted - shifted.min(axis=0)
        extent = shifted.max(axis=0) + 1
        if tuple(extent) != tuple(size):
            continue
        chosen = [
            (spot, wanted[a, b]) for spot, (a, b) in zip(spots, shifted.tolist(), strict=True) if (a, b) in wanted
        ]
        if len(chosen) < len(spots) or len(chosen) < min_share * len(wanted):
            continue
        along = np.polyfit(shifted[:, 0], px[spots, 0], 1)[0]
        fits.append((float(along), [c[0] for c in chosen], [c[1] for c in chosen]))
    if fits:
        _, chosen_spots, points = max(fits, key=lambda fit: fit[0])
        order = np.argsort(points)
        return np.array(chosen_spots, dtype=np.intp)[order], np.array(points, dtype=np.intp)[order]
    extent = np.sort(np.ptp(squared_up(cells), axis=0) + 1)
    shown = (
        f"a grid of {extent[1]}x{extent[0]} steps with {len(cells)} points, "
        f"wanted {size[0]}x{size[1]} with {len(wanted)}"
    )
    if len(cells) > len(wanted):
        return "board_larger_than_declared", shown
    if tuple(extent) == tuple(np.sort(size)):
        return "points_missing", shown
    return "board_smaller_than_declared", shown


def _turns(cells: NDArray[np.intp], px: FloatArray) -> list[NDArray[np.intp]]:
    """The four quarter turns of the lattice that do not mirror the picture."""
    fit = np.linalg.lstsq(np.column_stack([cells, np.ones(len(cells))]), px, rcond=None)[0][:2]
    mirror = np.eye(2, dtype=np.intp) if np.linalg.det(fit) > 0.0 else np.array([[0, 1], [1, 0]])
    quarter = np.array([[0, -1], [1, 0]])
    return [np.linalg.matrix_power(quarter, n) @ mirror for n in range(4)]
