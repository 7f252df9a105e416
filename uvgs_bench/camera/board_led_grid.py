"""Grids of lights: seen through the same filter, at the same exposure, as the beacon.

``columns`` x ``rows`` lights on a pitch, and one marker light halfway between the first and the second light of the
first row: it says which corner is the first, and whether the picture is mirrored. The marker is the last point. A
fifth of the lights may be dark or hidden, as long as the outline of the grid and the marker are seen.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.board_circles import disc_picture
from uvgs_bench.camera.board_spots import find_spots, grow_grid, squared_up
from uvgs_bench.geometry import FloatArray

if TYPE_CHECKING:
    from uvgs_bench.camera.boards import Board

_MIN_SHARE = 0.8
# A light is what is brighter than the ground by this share of the brightest.
_LEVEL = 0.3
_MIN_CONTRAST_DN = 30.0
# How far from halfway between its neighbours the marker may lie, in steps.
_TOLERANCE = 0.15
MARGIN = 0
"""Grey value around the drawn board."""


def points(board: Board) -> FloatArray:
    """Lights, row by row; the marker light is the last."""
    y, x = np.mgrid[0 : board.rows, 0 : board.columns]
    grid = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
    grid = np.vstack([grid, [0.5, 0.0]])
    return np.column_stack([grid, np.zeros(len(grid))]) * board.square_m


def check(board: Board) -> None:
    """Every grid of lights can exist."""


def find(grey: NDArray[np.uint8], board: Board) -> tuple[FloatArray, NDArray[np.intp]] | tuple[str, str]:
    """Find the lights and the marker, or say why not."""
    ground, brightest = float(np.median(grey)), float(grey.max())
    if brightest - ground < _MIN_CONTRAST_DN:
        return "no_lights", f"nothing is brighter than the ground ({ground:.0f} DN) by {_MIN_CONTRAST_DN:.0f} DN"
    threshold = (grey > ground + _LEVEL * (brightest - ground)).astype(np.uint8)
    px = find_spots(grey, threshold, min_area_px=3)
    columns, rows = board.columns, board.rows
    grid = grow_grid(px)
    if len(grid) < 0.5 * columns * rows:
        return "board_not_found", f"{len(px)} lights, but no grid of {columns}x{rows}"
    cells, spots = squared_up(np.array(list(grid))), np.array(list(grid.values()))
    loose = np.setdiff1d(np.arange(len(px)), spots)
    if tuple(sorted(np.ptp(cells, axis=0) + 1)) != tuple(sorted((columns, rows))):
        extent = np.ptp(cells, axis=0) + 1
        larger = extent.max() > max(columns, rows) or extent.min() > min(columns, rows)
        reason = "board_larger_than_declared" if larger else "board_smaller_than_declared"
        return reason, f"the lights form a grid of {extent.max()}x{extent.min()}, declared is {columns}x{rows}"
    if len(cells) < _MIN_SHARE * columns * rows:
        return "points_missing", f"{len(cells)} of {columns * rows} lights"
    marked = _marked(cells, px, spots, loose, (columns, rows))
    if not marked:
        return "no_marker", "the marker light between the first two lights of the first row is not seen"
    if len(marked) > 1:
        return "several_markers", f"{len(marked)} lights look like the marker: a reflection?"
    turn, mirrored, marker = marked[0]
    if mirrored:
        return "mirrored", "the marker light is where a mirrored picture would have it"
    placed = _placed(cells, turn)
    indices = placed[:, 1] * columns + placed[:, 0]
    order = np.argsort(indices)
    found = np.append(spots[order], marker)
    return np.ascontiguousarray(px[found]), np.append(indices[order], columns * rows).astype(np.intp)


def draw(board: Board, px_per_square: int) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """Bright discs on black."""
    return disc_picture(points(board) / board.square_m, board.diameter_m / board.square_m, px_per_square, False)


def _placed(cells: NDArray[np.intp], turn: NDArray[np.intp]) -> NDArray[np.intp]:
    turned = cells @ turn.T
    shifted: NDArray[np.intp] = turned - turned.min(axis=0)
    return shifted


def _marked(
    cells: NDArray[np.intp],
    px: FloatArray,
    spots: NDArray[np.intp],
    loose: NDArray[np.intp],
    size: tuple[int, int],
) -> list[tuple[NDArray[np.intp], bool, int]]:
    """Every way to lay the grid so that a loose light is its marker: turn, whether mirrored, which light."""
    fit = np.linalg.lstsq(np.column_stack([cells, np.ones(len(cells))]), px[spots], rcond=None)[0][:2]
    quarter, swap = np.array([[0, -1], [1, 0]]), np.array([[0, 1], [1, 0]])
    found = []
    for swapped in (False, True):
        for n in range(4):
            turn = np.linalg.matrix_power(quarter, n) @ (swap if swapped else np.eye(2, dtype=np.intp))
            placed = _placed(cells, turn)
            if tuple(placed.max(axis=0) + 1) != size:
                continue
            by_cell = {(int(a), int(b)): px[spot] for (a, b), spot in zip(placed, spots, strict=True)}
            if (0, 0) not in by_cell or (1, 0) not in by_cell:
                continue
            first, second = by_cell[0, 0], by_cell[1, 0]
            error = np.linalg.norm(px[loose] - 0.5 * (first + second), axis=1)
            mirrored = bool(np.linalg.det(fit) * np.linalg.det(turn) < 0.0)
            near = np.flatnonzero(error < _TOLERANCE * float(np.linalg.norm(second - first)))
            found += [(turn, mirrored, int(loose[i])) for i in near]
    return found
