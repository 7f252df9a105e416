"""Kalibr's AprilGrid: tags of family 36h11 in a grid, small black squares where the gaps between them meet.

``marker_m`` is the side of a tag, ``square_m`` the pitch from tag to tag: the side times one plus Kalibr's tag spacing.
As in Kalibr, tag 0 stands at the lower left, numbers run along the rows and the rows upwards, and points are numbered
so, too: corners of the lowest row of tags first, each row from the left. The board frame has y downwards, its origin
in the upper left corner of the upper left tag.

Kalibr prints tags with a border of two cells, others with one; both are tried.

Source: ethz-asl/kalibr wiki, "Calibration targets", for the layout.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.marker_ratio import ratio_misfit
from uvgs_bench.errors import CalibrationError
from uvgs_bench.geometry import FloatArray

if TYPE_CHECKING:
    from uvgs_bench.camera.boards import Board

_FAMILY_SIZE = 587
_BORDER_CELLS = 2
_CODE_CELLS = 6
_MIN_WINDOW_PX, _MAX_WINDOW_PX = 2, 11
_APRON_PX = 1.7
_MIN_TAGS = 2
_MIN_SIDE_PX = 12.0
_CELL_PX = 8
_MIN_CONTRAST_DN = 20.0
# Share of the bits the family could correct: two of five, so that no wrong tag is read.
_CORRECTION = 0.4


def points(board: Board) -> FloatArray:
    """Tag corners, numbered as in Kalibr: row by row from the lower left."""
    first = np.arange(2 * max(board.columns, board.rows))
    place = (first // 2) * board.square_m + (first % 2) * board.marker_m
    x, up = place[: 2 * board.columns], place[: 2 * board.rows]
    grid_x, grid_y = np.meshgrid(x, up[-1] - up)
    return np.column_stack([grid_x.ravel(), grid_y.ravel(), np.zeros(grid_x.size)])


def check(board: Board) -> None:
    """Raises CalibrationError when the family has too few tags."""
    if board.columns * board.rows > _FAMILY_SIZE:
        raise CalibrationError(f"board '{board.name}' has more than the {_FAMILY_SIZE} tags of family 36h11")


def find(grey: NDArray[np.uint8], board: Board) -> tuple[FloatArray, NDArray[np.intp]] | tuple[str, str]:
    """Find the corners of all visible tags, or say why not."""
    tags = _tags(grey)
    if not tags:
        if _tags(np.ascontiguousarray(grey[:, ::-1])):
            return "mirrored", "tags are there when the picture is mirrored"
        if _tags(255 - grey):
            return "inverted", "tags are there when black and white are exchanged"
        return "no_markers", "no tag of family 36h11"
    count = board.columns * board.rows
    strangers = sorted(number for number in tags if number >= count)
    if len(strangers) >= 2:
        # One may be a misreading; two belong to a larger board.
        return (
            "board_larger_than_declared",
            f"tags {strangers[:5]} are not on a board of {board.columns}x{board.rows} tags",
        )
    own = {number: corners for number, corners in tags.items() if number < count}
    if len(own) < _MIN_TAGS:
        return "too_few_corners", f"{len(own)} tags, need {_MIN_TAGS}"
    places = {number: _corner_indices(number, board.columns) for number in own}
    turn = _turn(own, places, points(board))
    if isinstance(turn, str):
        return "board_mismatch", turn
    px = np.concatenate([np.roll(own[number], turn, axis=0) for number in own])
    indices = np.concatenate([places[number] for number in own])
    order = np.argsort(indices)
    refined = _refined(grey, board, px[order])
    shares = _tag_shares(board, dict(zip(indices[order].tolist(), refined, strict=True)))
    misfit = ratio_misfit(board, shares, np.inf)
    return misfit or (refined, indices[order].astype(np.intp))


def _tag_shares(board: Board, seen: dict[int, FloatArray]) -> FloatArray:
    """Side of a tag over the pitch, of neighbours in a row, shape (N,): perspective takes as much of both."""
    shares = []
    for first in range(4 * board.columns * board.rows):
        is_pair = first % 2 == 0 and first % (2 * board.columns) <= 2 * board.columns - 4
        if is_pair and all(first + i in seen for i in range(4)):
            a, b, c, d = (seen[first + i] for i in range(4))
            tag, pitch = np.linalg.norm(b - a) + np.linalg.norm(d - c), np.linalg.norm(c - a) + np.linalg.norm(d - b)
            shares.append(float(tag / pitch))
    return np.array(shares)


def draw(board: Board, px_per_square: int) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """The board as Kalibr prints it; edges shaded by the covered part of each pixel."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    side = board.marker_m / board.square_m
    gap = 1.0 - side
    columns, rows = (int(np.ceil((n + gap) * px_per_square)) for n in (board.columns, board.rows))
    ink = np.zeros((rows, columns))

    def fill(x: float, y: float, wide: float) -> None:
        across, down = (_covered(at * px_per_square, wide * px_per_square, n) for at, n in ((x, columns), (y, rows)))
        ink[:] += down[:, None] * across

    for i in range(board.rows + 1):
        for j in range(board.columns + 1):
            fill(float(j), float(i), gap)
    cells = _CODE_CELLS + 2 * _BORDER_CELLS
    for number in range(board.columns * board.rows):
        row, column = board.rows - 1 - number // board.columns, number % board.columns
        tag = cv2.aruco.generateImageMarker(dictionary, number, cells, borderBits=_BORDER_CELLS)
        # OpenCV stores the family turned by half a turn from what its authors, and Kalibr, print.
        for i, j in np.argwhere(np.rot90(np.asarray(tag), 2) == 0):
            fill(column + gap + j * side / cells, row + gap + i * side / cells, side / cells)
    return np.clip(255.0 * (1.0 - ink) + 0.5, 0, 255).astype(np.uint8), (-gap, -gap)


def _covered(start: float, wide: float, count: int) -> FloatArray:
    """Part of each of ``count`` pixels that lies between start and start + wide, in pixels."""
    edges = np.arange(count + 1.0)
    inside = np.clip(edges, start, start + wide)
    return np.diff(inside)


def _corner_indices(number: int, columns: int) -> NDArray[np.intp]:
    """Points of a tag: upper left, upper right, lower right, lower left."""
    row, column = divmod(number, columns)
    lower = 4 * columns * row + 2 * column
    upper = lower + 2 * columns
    return np.array([upper, upper + 1, lower + 1, lower], dtype=np.intp)


def _tags(grey: NDArray[np.uint8]) -> dict[int, FloatArray]:
    """Corners of tags by number, clockwise from the first of the code; with whichever border finds more.

    Found here and not by OpenCV's detector, because the small squares join the tags to one dark region.
    """
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    best: dict[int, FloatArray] = {}
    for shrink in (1, 2, 3):
        quads = _quads(grey, shrink)
        for border in (_BORDER_CELLS, 1):
            seen: list[tuple[int, FloatArray]] = []
            for quad in quads:
                bits = _bits(grey, quad, border)
                if bits is None:
                    continue
                is_known, number, rotation = dictionary.identify(bits, _CORRECTION)
                if is_known:
                    seen.append((int(number), np.roll(quad, int(rotation), axis=0)))
            numbers = [number for number, _ in seen]
            # A number seen twice is a reflection or another board: neither copy can be trusted.
            tags = {number: quad for number, quad in seen if numbers.count(number) == 1}
            if len(tags) > len(best):
                best = tags
    return best


def _quads(grey: NDArray[np.uint8], shrink: int) -> list[FloatArray]:
    """Dark convex quadrangles, clockwise, after dark regions shrank by some pixels on every side."""
    import cv2

    side = max(31, (min(grey.shape) // 6) | 1)
    dark = cv2.adaptiveThreshold(grey, 1, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, side, 10)
    dark = cv2.erode(dark, np.ones((3, 3), np.uint8), iterations=shrink)
    # Outer outlines of all regions, also of those inside a dark frame.
    outlines, family = cv2.findContours(dark, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    found: list[FloatArray] = []
    for i, outline in enumerate(outlines):
        if np.reshape(family, (-1, 4))[i, 3] >= 0 or len(outline) < 4 * _MIN_SIDE_PX:
            continue
        hull = cv2.convexHull(outline)
        four = cv2.approxPolyDP(hull, 0.04 * cv2.arcLength(hull, True), True).reshape(-1, 2).astype(np.float64)
        if len(four) != 4 or cv2.contourArea(hull) > 1.2 * cv2.contourArea(four.astype(np.float32)):
            continue
        if np.linalg.norm(four - np.roll(four, 1, axis=0), axis=1).min() < _MIN_SIDE_PX:
            continue
        centre = four.mean(axis=0)
        arms = four - centre
        if np.cross(np.append(arms[0], 0.0), np.append(arms[1], 0.0))[2] < 0.0:
            arms = arms[::-1]
        # Back to where the edges were: half a diagonal grows by the square root of two.
        length = np.linalg.norm(arms, axis=1)[:, None]
        found.append(centre + arms * (1.0 + np.sqrt(2.0) * shrink / length))
    return found


def _bits(grey: NDArray[np.uint8], quad: FloatArray, border: int) -> NDArray[np.uint8] | None:
    """Code cells of a quadrangle, 1 where white; None where the border is not dark or nothing stands out."""
    import cv2

    cells = _CODE_CELLS + 2 * border
    size = _CELL_PX * cells
    square = np.array([[0, 0], [size, 0], [size, size], [0, size]], dtype=np.float32) - 0.5
    H = cv2.getPerspectiveTransform(quad.astype(np.float32), square.astype(np.float32))
    flat = cv2.warpPerspective(grey, H, (size, size), flags=cv2.INTER_LINEAR).astype(np.float64)
    # The middle of each cell only: its edges are blurred.
    mean = flat.reshape(cells, _CELL_PX, cells, _CELL_PX)[:, 2:-2, :, 2:-2].mean(axis=(1, 3))
    low, high = float(mean.min()), float(mean.max())
    if high - low < _MIN_CONTRAST_DN:
        return None
    white = mean > 0.5 * (low + high)
    inner = white[border:-border, border:-border]
    if int(white.sum()) - int(inner.sum()) > border:
        return None
    return np.ascontiguousarray(inner.astype(np.uint8))


def _turn(tags: dict[int, FloatArray], places: dict[int, NDArray[np.intp]], board_m: FloatArray) -> int | str:
    """By how many corners the detector's first corner lies off the upper left one: the same for all tags."""
    import cv2

    plane = np.concatenate([board_m[places[number], :2] for number in tags])
    errors = []
    for turn in range(4):
        px = np.concatenate([np.roll(corners, turn, axis=0) for corners in tags.values()])
        H, _ = cv2.findHomography(plane, px, 0)
        if H is None:
            errors.append(np.inf)
            continue
        mapped = np.column_stack([plane, np.ones(len(plane))]) @ H.T
        errors.append(float(np.median(np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - px, axis=1))))
    best = int(np.argmin(errors))
    side = float(np.median([np.linalg.norm(corners[1] - corners[0]) for corners in tags.values()]))
    if errors[best] > 0.3 * side:
        return f"tags lie {errors[best]:.1f} px off their places: another number of columns, or another spacing?"
    return best


def _refined(grey: NDArray[np.uint8], board: Board, px: FloatArray) -> FloatArray:
    """Refine with a window that ends within the small squares between the tags."""
    import cv2

    scale = _px_per_m(board, px)
    clear_px = min(board.square_m - board.marker_m, board.marker_m / (_CODE_CELLS + 2 * _BORDER_CELLS)) * scale
    window = int(np.clip(clear_px - _APRON_PX, _MIN_WINDOW_PX, _MAX_WINDOW_PX))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-3)
    start = px.astype(np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(grey, start, (window, window), (-1, -1), stop)
    return np.asarray(refined, dtype=np.float64).reshape(-1, 2)


def _px_per_m(board: Board, px: FloatArray) -> float:
    from uvgs_bench.camera.boards import nearest_distance

    # Nearest to a corner is the corner across the gap, or of the same tag where gaps are wide.
    nearest_m = min(board.square_m - board.marker_m, board.marker_m)
    return float(np.median(nearest_distance(px))) / nearest_m
