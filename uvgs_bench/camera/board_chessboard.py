"""Chessboards: inner corners of black and white squares.

Corners come from OpenCV's classic detector, refined with a window that stays clear of the neighbouring corners; its
sector-based detector is the second try where they are none or noisy, and the quieter corners are kept. Both also find
a small pattern inside a larger board, so the ring of places where a larger board would have its next corners is looked
at, too. Where an odd and an even number of corners make the ends differ, the first corner is that at the black end.
"""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray

if TYPE_CHECKING:
    from uvgs_bench.camera.boards import Board

# A wider refining window gains nothing and reaches into uneven light.
_MAX_WINDOW_PX = 11
# Wide enough for a board half as wide as the picture; its small copy is looked at in a millisecond.
_GLANCE_WIDTH_PX = 640
# Corners of the classic detector noisier than this are looked for once more, and given up for clearly quieter ones.
_NOISY_PX, _CLEARLY_LESS = 0.25, 0.9


def points(board: Board) -> FloatArray:
    """Inner corners, row by row; the origin is the first one."""
    y, x = np.mgrid[0 : board.rows, 0 : board.columns]
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * board.square_m


def check(board: Board) -> None:
    """Every chessboard can exist."""


def find(grey: NDArray[np.uint8], board: Board) -> tuple[FloatArray, NDArray[np.intp]] | tuple[str, str]:
    """Find all inner corners, or say why not."""
    px = _find_size(grey, board.columns, board.rows)
    if px is None:
        return _explain(grey, board)
    grid = px.reshape(board.rows, board.columns, 2)
    if _is_irregular(grid) or not _alternates(grey, grid):
        return (
            "board_mismatch",
            f"corners were found, but not in even steps: not a board of {board.columns}x{board.rows}?",
        )
    along, across = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if along[0] * across[1] - along[1] * across[0] < 0.0:
        # The detector may count a row from the right; a board seen from its front is never mirrored.
        grid = grid[:, ::-1]
    if (board.columns + board.rows) % 2 == 1 and _black_share(grey, grid) < 0.0:
        # The first corner lies at a black square of the board's own corner; the other end has a white one.
        grid = grid[::-1, ::-1]
    side = _side_that_goes_on(grey, grid)
    if side:
        return (
            "board_larger_than_declared",
            f"the pattern goes on {side}: the board has more than {board.columns}x{board.rows} inner corners",
        )
    return np.ascontiguousarray(grid.reshape(-1, 2)), np.arange(board.columns * board.rows)


def glance(grey: NDArray[np.uint8], board: Board) -> bool:
    """Whether a small copy or the picture itself has enough dark and bright patches with four corners."""
    import cv2

    size = (board.columns, board.rows)
    # The quick test expects deep black and bright white.
    low, high = (float(value) for value in np.percentile(grey[::4, ::4], (0.2, 99.8)))
    gain = 255.0 / max(high - low, 1.0)
    grey = np.asarray(cv2.LUT(grey, np.clip((np.arange(256) - low) * gain, 0, 255).astype(np.uint8)), dtype=np.uint8)
    factor = _GLANCE_WIDTH_PX / grey.shape[1]
    if factor < 1.0:
        small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        if cv2.checkChessboard(small, size):
            return True
    return bool(cv2.checkChessboard(grey, size))


def draw(board: Board, px_per_square: int) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """Squares around the inner corners, black first."""
    y, x = np.mgrid[0 : board.rows + 1, 0 : board.columns + 1]
    squares = np.where((x + y) % 2 == 0, 0, 255).astype(np.uint8)
    return np.kron(squares, np.ones((px_per_square, px_per_square), np.uint8)), (-1.0, -1.0)


def _find_size(grey: NDArray[np.uint8], columns: int, rows: int) -> FloatArray | None:
    import cv2

    flags = cv2.CALIB_CB_ADAPTIVE_THRESH + cv2.CALIB_CB_NORMALIZE_IMAGE
    is_found, corners = cv2.findChessboardCorners(grey, (columns, rows), flags=flags)
    if not is_found:
        return _find_by_sectors(grey, columns, rows)
    px = np.asarray(corners, dtype=np.float32).reshape(-1, 2)
    window = min(_MAX_WINDOW_PX, int(_smallest_spacing(px, columns, rows) / 2.0) - 1)
    if window < 1:
        return None
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-3)
    refined = cv2.cornerSubPix(grey, px.reshape(-1, 1, 2), (window, window), (-1, -1), stop)
    found = np.asarray(refined, dtype=np.float64).reshape(-1, 2)
    noise_px = local_noise_px(found.reshape(rows, columns, 2))
    if noise_px < _NOISY_PX:
        return found
    other = _find_by_sectors(grey, columns, rows)
    if other is None or local_noise_px(other.reshape(rows, columns, 2)) > _CLEARLY_LESS * noise_px:
        return found
    return other


def _find_by_sectors(grey: NDArray[np.uint8], columns: int, rows: int) -> FloatArray | None:
    import cv2

    is_found, corners = cv2.findChessboardCornersSB(grey, (columns, rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    return np.asarray(corners, dtype=np.float64).reshape(-1, 2) if is_found else None


def local_noise_px(grid: FloatArray) -> float:
    """How far corners lie off the flat, undistorted board their nearest neighbours make.

    Args:
        grid: Corners by row and column, shape (rows, columns, 2), px.

    Returns:
        Deviation of a coordinate over all blocks of three by three corners, px: the noise of the corners, and where the
        lens bends strongly, its bend across two squares.
    """
    import cv2

    plane = np.array([[x, y] for y in range(3) for x in range(3)], dtype=np.float64)
    homogeneous = np.column_stack([plane, np.ones(9)])
    squares = []
    for i in range(grid.shape[0] - 2):
        for j in range(grid.shape[1] - 2):
            block = np.ascontiguousarray(grid[i : i + 3, j : j + 3].reshape(9, 2))
            H, _ = cv2.findHomography(plane, block)
            if H is None:
                return inf
            mapped = homogeneous @ H.T
            squares.append(float(((mapped[:, :2] / mapped[:, 2:] - block) ** 2).sum()))
    # Eighteen coordinates, eight of them taken up by the homography.
    return float(np.sqrt(np.median(squares) / 10.0))


def _black_share(grey: NDArray[np.uint8], grid: FloatArray) -> float:
    """Positive when the cell at the first corner, and every second one, is darker than the others."""
    place = 0.25 * (grid[:-1, :-1] + grid[:-1, 1:] + grid[1:, :-1] + grid[1:, 1:])
    column = np.clip(place[..., 0].round().astype(int), 0, grey.shape[1] - 1)
    row = np.clip(place[..., 1].round().astype(int), 0, grey.shape[0] - 1)
    parity = (-1.0) ** np.add.outer(np.arange(place.shape[0]), np.arange(place.shape[1]))
    value = grey[row, column].astype(np.float64)
    return float(value[parity < 0.0].mean() - value[parity > 0.0].mean())


def _is_irregular(grid: FloatArray) -> bool:
    """Whether a row or column skips corners: a skipped one doubles the step, which bends by 0.67 of the mean step."""
    for lines in (grid, grid.swapaxes(0, 1)):
        bend = np.linalg.norm(lines[2:] - 2.0 * lines[1:-1] + lines[:-2], axis=2)
        step = 0.5 * np.linalg.norm(lines[2:] - lines[:-2], axis=2)
        if (bend > 0.55 * step).any():
            return True
    return False


def _alternates(grey: NDArray[np.uint8], grid: FloatArray) -> bool:
    """Whether neighbouring cells between the corners alternate; a grid that takes every second or third does not."""
    steps: list[FloatArray] = []
    for a in (0.25, 0.5, 0.75):
        place = (1 - a) * ((1 - a) * grid[:-1, :-1] + a * grid[:-1, 1:]) + a * (
            (1 - a) * grid[1:, :-1] + a * grid[1:, 1:]
        )
        column = np.clip(place[..., 0].round().astype(int), 0, grey.shape[1] - 1)
        row = np.clip(place[..., 1].round().astype(int), 0, grey.shape[0] - 1)
        value = grey[row, column].astype(np.float64)
        parity = (-1.0) ** np.add.outer(np.arange(value.shape[0]), np.arange(value.shape[1]))
        steps += [(np.diff(value, axis=1) * parity[:, 1:]).ravel(), (np.diff(value, axis=0) * parity[1:]).ravel()]
    signed = np.concatenate(steps)
    typical = float(np.median(np.abs(signed)))
    agreeing = max(float(np.mean(signed > 0.3 * typical)), float(np.mean(signed < -0.3 * typical)))
    return typical > 0.0 and agreeing > 0.8


def _smallest_spacing(px: NDArray[np.float32], columns: int, rows: int) -> float:
    grid = px.reshape(rows, columns, 2)
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
    return float(min(steps))


def _explain(grey: NDArray[np.uint8], board: Board) -> tuple[str, str]:
    """Look for the sizes people declare by mistake: squares instead of inner corners, one too many or too few."""
    import cv2

    columns, rows = board.columns, board.rows
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH + cv2.CALIB_CB_NORMALIZE_IMAGE + cv2.CALIB_CB_FAST_CHECK
    for step, reason in ((1, "board_larger_than_declared"), (-1, "board_smaller_than_declared")):
        for other in ((columns + step, rows + step), (columns + step, rows), (columns, rows + step)):
            if min(other) >= 3 and cv2.findChessboardCorners(grey, other, flags=flags)[0]:
                hint = ": count inner corners, not squares" if step < 0 else ""
                return reason, f"no {columns}x{rows} inner corners, but {other[0]}x{other[1]}{hint}"
    return "board_not_found", f"no chessboard of {columns}x{rows} inner corners"


def _side_that_goes_on(grey: NDArray[np.uint8], grid: FloatArray) -> str:
    """Name of a side beyond which the chessboard continues, or nothing.

    One step beyond the last row of inner corners a board ends in its margin: the outer two quadrants there are alike.
    On a larger board there is another crossing, with four quadrants of alternating brightness.
    """
    inner = np.array([_quadrants(grey, grid, i, j) for i in (1, -2) for j in (1, -2)])
    contrast = float(np.nanmedian(_alternation(inner)))
    if not contrast > 0.0:
        return ""
    sides = {"above": grid, "below": grid[::-1], "to the left": grid.swapaxes(0, 1)}
    sides["to the right"] = grid.swapaxes(0, 1)[::-1]
    for name, lines in sides.items():
        beyond = 3.0 * lines[0] - 3.0 * lines[1] + lines[2]
        extended = np.concatenate([(2.0 * beyond - lines[0])[None], beyond[None], lines])
        seen = _alternation(np.array([_quadrants(grey, extended, 1, j) for j in range(1, lines.shape[1] - 1)]))
        seen = seen[np.isfinite(seen)]
        if len(seen) >= 2 and float(np.mean(seen > 0.5 * contrast)) > 0.7:
            return name
    return ""


def _quadrants(grey: NDArray[np.uint8], grid: FloatArray, i: int, j: int) -> FloatArray:
    """Mean brightness of the four squares that meet at a grid point; NaN outside the picture."""
    height, width = grey.shape
    point = grid[i, j]
    out = np.full(4, np.nan)
    down, right = 0.5 * (grid[i + 1, j] - grid[i - 1, j]), 0.5 * (grid[i, j + 1] - grid[i, j - 1])
    for k, (a, b) in enumerate(((1, 1), (1, -1), (-1, -1), (-1, 1))):
        x, y = point + 0.3 * (a * down + b * right)
        if 1.0 <= x < width - 2.0 and 1.0 <= y < height - 2.0:
            column, row = int(x + 0.5), int(y + 0.5)
            out[k] = grey[row - 1 : row + 2, column - 1 : column + 2].mean()
    return out


def _alternation(quadrants: FloatArray) -> FloatArray:
    """How strongly neighbouring quadrants alternate: the smallest step that has the right sign, in grey values."""
    steps = np.roll(quadrants, -1, axis=1) - quadrants
    signed = steps * np.array([1.0, -1.0, 1.0, -1.0])
    lowest: FloatArray = np.maximum(signed.min(axis=1), (-signed).min(axis=1))
    return lowest
