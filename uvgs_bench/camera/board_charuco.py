"""ChArUco boards: a chessboard whose white squares carry markers, so that a part of it is enough.

OpenCV refines the corners with a window that reaches into the markers, which pulls them by up to 0.7 px in a clean
picture; here they are refined again with a window that ends before the nearest marker (0.03 px in the same picture).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

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
    first, second = _detect(grey, board, board.legacy)
    if isinstance(first, str):
        return _explain(grey, board, first, str(second))
    return _refined(grey, board, first), np.asarray(second, dtype=np.intp)


def draw(board: Board, px_per_square: int) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """The board as OpenCV draws it."""
    size = (board.columns * px_per_square, board.rows * px_per_square)
    picture = _opencv_board(board, board.legacy).generateImage(size, marginSize=0, borderBits=1)
    return np.asarray(picture, dtype=np.uint8), (0.0, 0.0)


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


def _detect(
    grey: NDArray[np.uint8], board: Board, legacy: bool
) -> tuple[FloatArray, NDArray[np.intp]] | tuple[str, str]:
    import cv2

    made = _opencv_board(board, legacy)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    detector = cv2.aruco.CharucoDetector(made, detectorParams=parameters)
    corners, numbers, _, marker_numbers = detector.detectBoard(grey)
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
    return np.asarray(corners, dtype=np.float64).reshape(-1, 2), np.asarray(numbers, dtype=np.intp).ravel()


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
    if reason == "no_corners" and not isinstance(_detect(grey, board, not board.legacy)[0], str):
        return "legacy_pattern", f"the board is there with legacy = {str(not board.legacy).lower()}"
    if reason == "no_markers":
        if not isinstance(_detect(np.ascontiguousarray(grey[:, ::-1]), board, board.legacy)[0], str):
            return "mirrored", "the board is there when the picture is mirrored"
        if not isinstance(_detect(255 - grey, board, board.legacy)[0], str):
            return "inverted", "the board is there when black and white are exchanged"
    return reason, detail
