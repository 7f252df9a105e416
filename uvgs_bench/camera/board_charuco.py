"""ChArUco boards: a chessboard whose white squares carry markers, so that a part of it is enough.

OpenCV refines the corners with a window that reaches into the markers, which pulls them by up to 0.7 px in a clean
picture; here they are refined again with a window that ends before the nearest marker (0.03 px in the same picture).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.marker_ratio import ratio_misfit
from uvgs_bench.errors import CalibrationError
from uvgs_bench.geometry import FloatArray

if TYPE_CHECKING:
    from uvgs_bench.camera.boards import Board

_MIN_WINDOW_PX, _MAX_WINDOW_PX = 2, 11
_APRON_PX = 1.7


def points(board: Board) -> FloatArray:
    """Chessboard corners, row by row; the origin is the outer corner of the board, as in OpenCV."""
    y, x = np.mgrid[1 : board.rows, 1 : board.columns]
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * board.square_m


def check(board: Board) -> None:
    """Raises CalibrationError when the dictionary is unknown or too small."""
    _opencv_board(board, board.legacy)


def find(grey: NDArray[np.uint8], board: Board) -> tuple[FloatArray, NDArray[np.intp]] | tuple[str, str]:
    """Find the visible corners with their numbers, or say why not."""
    from uvgs_bench.camera.boards import nearest_distance

    seen = _detect(grey, board, board.legacy)
    if isinstance(seen, tuple):
        return _explain(grey, board, *seen)
    px = _refined(grey, board, seen.px)
    square_px = float(np.median(nearest_distance(px))) if len(px) > 1 else 0.0
    misfit = ratio_misfit(board, _marker_shares(grey, board, seen, px), square_px)
    return misfit or (px, seen.numbers)


def draw(board: Board, px_per_square: int) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """The board as OpenCV draws it."""
    size = (board.columns * px_per_square, board.rows * px_per_square)
    picture = _opencv_board(board, board.legacy).generateImage(size, marginSize=0, borderBits=1)
    return np.asarray(picture, dtype=np.uint8), (0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Corners (N, 2) with their numbers, markers (M, 4, 2) with theirs."""

    px: FloatArray
    numbers: NDArray[np.intp]
    markers_px: FloatArray
    marker_numbers: NDArray[np.intp]


def _marker_shares(grey: NDArray[np.uint8], board: Board, seen: _Seen, px: FloatArray) -> FloatArray:
    """Side of each marker over the side of its square, of squares whose four corners are seen, shape (N,)."""
    import cv2

    places = np.asarray(_opencv_board(board, board.legacy).getObjPoints()).reshape(-1, 4, 3)[:, :, :2]
    known = dict(zip(seen.numbers.tolist(), px, strict=True))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-3)
    shares = []
    for number, marker in zip(seen.marker_numbers, seen.markers_px, strict=True):
        column, row = (places[number].mean(axis=0) / board.square_m).astype(int)
        wide = board.columns - 1
        if not (0 < column < wide and 0 < row < board.rows - 1):
            continue
        first = int((row - 1) * wide + column - 1)
        square = [known.get(i) for i in (first, first + 1, first + wide + 1, first + wide)]
        if any(corner is None for corner in square):
            continue
        side_px = _mean_side(np.array(square))
        window = int(np.clip(0.5 * (1.0 - board.marker_m / board.square_m) * side_px - _APRON_PX, 2, 5))
        start = marker.astype(np.float32).reshape(-1, 1, 2)
        refined = np.reshape(cv2.cornerSubPix(grey, start, (window, window), (-1, -1), stop), (4, 2))
        shares.append(_mean_side(refined) / side_px)
    return np.array(shares)


def _mean_side(four: FloatArray) -> float:
    return float(np.linalg.norm(four - np.roll(four, 1, axis=0), axis=1).mean())


def _opencv_board(board: Board, legacy: bool) -> Any:
    import cv2

    number = getattr(cv2.aruco, board.dictionary, None)
    if not board.dictionary.startswith("DICT_") or number is None:
        raise CalibrationError(f"unknown marker dictionary '{board.dictionary}', expected for example DICT_5X5_100")
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    count = board.columns * board.rows // 2
    if count > len(dictionary.bytesList):
        raise CalibrationError(
            f"board '{board.name}' has {count} markers, but {board.dictionary} only {len(dictionary.bytesList)}"
        )
    made = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_m, board.marker_m, dictionary)
    made.setLegacyPattern(legacy)
    return made


def _detect(grey: NDArray[np.uint8], board: Board, legacy: bool) -> _Seen | tuple[str, str]:
    import cv2

    made = _opencv_board(board, legacy)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    detector = cv2.aruco.CharucoDetector(made, detectorParams=parameters)
    corners, numbers, markers, marker_numbers = detector.detectBoard(grey)
    if marker_numbers is None or len(marker_numbers) == 0:
        return "no_markers", f"no marker of {board.dictionary}"
    on_board = np.isin(np.ravel(marker_numbers), np.ravel(made.getIds()))
    if int((~on_board).sum()) >= 3:
        # One stray marker may be a misreading; three belong to a larger board.
        return (
            "board_larger_than_declared",
            f"markers {sorted(np.ravel(marker_numbers)[~on_board].tolist())[:5]} are not on a "
            f"{board.columns}x{board.rows} board",
        )
    if corners is None or numbers is None or len(numbers) == 0:
        return "no_corners", f"{len(marker_numbers)} markers, but no chessboard corner between them"
    return _Seen(
        np.asarray(corners, dtype=np.float64).reshape(-1, 2),
        np.asarray(numbers, dtype=np.intp).ravel(),
        np.asarray(markers, dtype=np.float64).reshape(-1, 4, 2)[on_board.ravel()],
        np.ravel(marker_numbers)[on_board.ravel()].astype(np.intp),
    )


def _refined(grey: NDArray[np.uint8], board: Board, corners: FloatArray) -> FloatArray:
    import cv2

    from uvgs_bench.camera.boards import nearest_distance

    if len(corners) < 2:
        return corners
    # White between a corner and the nearest marker; the filter of the gradient takes almost two pixels of it. A corner
    # whose neighbours are hidden would seem to have more room than it has.
    spacing = nearest_distance(corners)
    spacing = np.minimum(spacing, 1.2 * float(np.median(spacing)))
    clear_px = 0.5 * (1.0 - board.marker_m / board.square_m) * spacing
    windows = np.clip((clear_px - _APRON_PX).astype(int), _MIN_WINDOW_PX, _MAX_WINDOW_PX)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-3)
    refined = corners.copy()
    for window in np.unique(windows):
        chosen = windows == window
        start = corners[chosen].astype(np.float32).reshape(-1, 1, 2)
        size = (int(window), int(window))
        refined[chosen] = np.reshape(cv2.cornerSubPix(grey, start, size, (-1, -1), stop), (-1, 2))
    return refined


def _explain(grey: NDArray[np.uint8], board: Board, reason: str, detail: str) -> tuple[str, str]:
    """Look for what real sets get wrong: the other pattern, a mirrored picture, inverted colours."""
    if reason == "no_corners" and isinstance(_detect(grey, board, not board.legacy), _Seen):
        return "legacy_pattern", f"the board is there with legacy = {str(not board.legacy).lower()}"
    if reason == "no_markers":
        if isinstance(_detect(np.ascontiguousarray(grey[:, ::-1]), board, board.legacy), _Seen):
            return "mirrored", "the board is there when the picture is mirrored"
        if isinstance(_detect(255 - grey, board, board.legacy), _Seen):
            return "inverted", "the board is there when black and white are exchanged"
    return reason, detail
