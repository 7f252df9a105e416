"""Boards of filled circles, symmetric (``circles``) and staggered (``asymmetric_circles``).

The centre of the picture of a circle is not the picture of its centre: under tilt the nearer half is larger. What is
found is the centroid of the picture; ``circle_centre_bias`` says how far it lies from the projected centre, for any
lens, and ``corrected_view`` takes it out once lens and pose are roughly known.

A symmetric board looks the same after half a turn (a square one after a quarter); a staggered one with an odd number
of rows does not. Neither can show that a picture is mirrored.

Source: J. Heikkilä, Geometric camera calibration using circular control points (2000), for the bias; here it is
integrated over the disc, so that distortion within the circle counts, too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.board_spots import Cell, find_spots, grow_grid, match_cells
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose

if TYPE_CHECKING:
    from uvgs_bench.camera.boards import Board, BoardView

_MIN_SHARE = 1.0
_MARGIN = 0.5
_RINGS, _SPOKES = 4, 16


def points(board: Board) -> FloatArray:
    """Centres, row by row; ``square_m`` is the pitch, for staggered boards between neighbouring rows."""
    y, x = np.mgrid[0 : board.rows, 0 : board.columns]
    if board.kind == "asymmetric_circles":
        x = 2 * x + y % 2
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * board.square_m


def check(board: Board) -> None:
    """Circles on any pitch can exist."""


def find(grey: NDArray[np.uint8], board: Board) -> tuple[FloatArray, NDArray[np.intp]] | tuple[str, str]:
    """Find all circles, dark on white, or say why not."""
    first, second = _find(255 - grey, board)
    if isinstance(first, str) and first == "board_not_found" and not isinstance(_find(grey, board)[0], str):
        return "inverted", "the board is there when black and white are exchanged"
    return (first, str(second)) if isinstance(first, str) else (first, np.asarray(second, dtype=np.intp))


def draw(board: Board, px_per_square: int) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """Dark discs, edges shaded by the covered part of each pixel."""
    return disc_picture(points(board) / board.square_m, board.diameter_m / board.square_m, px_per_square, True)


def disc_picture(
    centres: FloatArray, diameter: float, px_per_square: int, dark: bool
) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """Discs of one size on a plain ground.

    Args:
        centres: Centres, shape (N, 3) or (N, 2), squares.
        diameter: Diameter, squares.
        px_per_square: Pixels along one square.
        dark: Dark discs on white, or white ones on black.

    Returns:
        The picture, half a square wider than the outer centres, and the place of its upper left corner, squares.
    """
    low, high = centres[:, :2].min(axis=0) - _MARGIN, centres[:, :2].max(axis=0) + _MARGIN
    columns, rows = np.ceil((high - low) * px_per_square).astype(int)
    ink = np.zeros((rows, columns))
    radius = 0.5 * diameter * px_per_square
    for x, y in (centres[:, :2] - low) * px_per_square - 0.5:
        x0, x1 = max(0, int(x - radius - 1)), min(columns, int(x + radius + 3))
        y0, y1 = max(0, int(y - radius - 1)), min(rows, int(y + radius + 3))
        yy, xx = np.mgrid[y0:y1, x0:x1]
        ink[y0:y1, x0:x1] += np.clip(radius - np.hypot(xx - x, yy - y) + 0.5, 0.0, 1.0)
    value = 255.0 * (1.0 - ink) if dark else 255.0 * ink
    return np.clip(value + 0.5, 0, 255).astype(np.uint8), (float(low[0]), float(low[1]))


def circle_centre_bias(lens: Lens, camera_from_board: Pose, centres_m: FloatArray, diameter_m: float) -> FloatArray:
    """How far the centroid of the picture of a circle lies from the picture of its centre.

    Args:
        lens: The lens.
        camera_from_board: Pose of the board.
        centres_m: Centres of the circles in the board frame, shape (N, 3), m.
        diameter_m: Their diameter, m.

    Returns:
        Centroid minus projected centre, shape (N, 2), px; NaN outside the valid field.
    """
    # Gauss-Legendre in the squared radius gives rings of the right area; a polynomial of degree 7 is exact.
    nodes, weights = np.polynomial.legendre.leggauss(_RINGS)
    radii = 0.5 * diameter_m * np.sqrt(0.5 * (nodes + 1.0))
    turns = 2.0 * np.pi * np.arange(_SPOKES) / _SPOKES
    around = np.stack([np.outer(radii, np.cos(turns)), np.outer(radii, np.sin(turns)), np.zeros((_RINGS, _SPOKES))], -1)
    samples = np.asarray(centres_m)[:, None, :] + around.reshape(1, -1, 3)
    area = np.repeat(weights, _SPOKES)
    px, by_point, _ = lens.project_with_jacobians(camera_from_board.apply(samples.reshape(-1, 3)))
    by_plane = by_point @ camera_from_board.R[:, :2]
    shown = np.abs(np.linalg.det(by_plane)).reshape(len(samples), -1) * area
    centroid = (shown[:, :, None] * px.reshape(len(samples), -1, 2)).sum(axis=1) / shown.sum(axis=1)[:, None]
    bias: FloatArray = centroid - lens.project(camera_from_board.apply(np.asarray(centres_m)))
    return bias


def corrected_view(view: BoardView, lens: Lens, camera_from_board: Pose, diameter_m: float) -> BoardView:
    """The view as if the centres themselves had been seen.

    Args:
        view: Found centroids, uncorrected.
        lens: The lens of a first calibration.
        camera_from_board: Pose of the board under that lens.
        diameter_m: Diameter of the circles, m.

    Returns:
        The view with corrected pixels; calibrate again with it. The bias changes so little with lens and pose that one
        repetition is enough.
    """
    from dataclasses import replace

    return replace(view, px=view.px - circle_centre_bias(lens, camera_from_board, view.board_m, diameter_m))


def _cells(board: Board) -> dict[Cell, int]:
    """Cells of the lattice: columns and rows, or for staggered boards its two diagonals."""
    grid = np.rint(points(board)[:, :2] / board.square_m).astype(int)
    if board.kind == "asymmetric_circles":
        x, y = grid.T
        grid = np.column_stack([(x + y) // 2, (y - x) // 2])
    grid = grid - grid.min(axis=0)
    return {(int(a), int(b)): i for i, (a, b) in enumerate(grid)}


def _find(bright: NDArray[np.uint8], board: Board) -> tuple[FloatArray, NDArray[np.intp]] | tuple[str, str]:
    import cv2

    answer: tuple[str, str] = ("board_not_found", f"no {board.columns}x{board.rows} circles")
    side = max(31, (min(bright.shape) // 8) | 1)
    for threshold in (
        cv2.threshold(bright, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)[1],
        cv2.adaptiveThreshold(bright, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, side, -10),
    ):
        spots = find_spots(bright, np.asarray(threshold, dtype=np.uint8))
        grid = grow_grid(spots)
        if len(grid) < 0.5 * board.columns * board.rows:
            continue
        first, second = match_cells(grid, _cells(board), spots, _MIN_SHARE)
        if not isinstance(first, str):
            return np.ascontiguousarray(spots[first]), np.asarray(second, dtype=np.intp)
        answer = first, str(second)
    return answer
