"""Calibration boards: what they are, where their points lie, and how to find them in a picture.

To add a kind: 1. write a file with the four functions of ``BoardKind``; 2. add one line to ``BOARDS``; 3. the contract
tests of ``tests/unit/camera`` then run over it.

Contract: ``points`` gives every point of the board in the board frame (x along columns, y along rows, z into the
board, seen from its front), m; ``find`` returns found pixels with the indices of their points, or reason and detail; a
board that does not match its declaration is a miss that says so, never a guess; ``draw`` paints the printed board.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.errors import CalibrationError
from uvgs_bench.geometry import FloatArray, read_only

if TYPE_CHECKING:
    GreyImage = NDArray[np.uint8]

BOARDS: dict[str, str] = {
    "chessboard": "uvgs_bench.camera.board_chessboard",
    "charuco": "uvgs_bench.camera.board_charuco",
    "circles": "uvgs_bench.camera.board_circles",
    "asymmetric_circles": "uvgs_bench.camera.board_circles",
    "aprilgrid": "uvgs_bench.camera.board_aprilgrid",
    "led_grid": "uvgs_bench.camera.board_led_grid",
}
WITH_MARKERS = ("charuco", "aprilgrid")
"""Kinds with ``marker_m``."""
WITH_DISCS = ("circles", "asymmetric_circles", "led_grid")
"""Kinds with ``diameter_m``."""
# Fewer points than this cannot hold a pose and a doubt.
MIN_POINTS = 8
_MOST_POINTS = 10_000


@dataclass(frozen=True, slots=True)
class Board:
    """A calibration board as declared.

    Args:
        name: For people.
        kind: Key of ``BOARDS``.
        columns: Inner corners (chessboard), squares (ChArUco), tags, circles or lights along x.
        rows: The same along y.
        square_m: Side of a square, or pitch of the grid, m.
        marker_m: Side of a marker or tag, m; 0 where the kind has none.
        dictionary: Name of the marker dictionary; empty where the kind has none.
        legacy: Whether a ChArUco board has the pattern of OpenCV before 4.6.
        diameter_m: Diameter of a circle or light, m; 0 where the kind has none.

    Raises:
        CalibrationError: Unknown kind, fewer than 3 columns or rows, or sizes that cannot be.
    """

    name: str
    kind: str
    columns: int
    rows: int
    square_m: float
    marker_m: float = 0.0
    dictionary: str = ""
    legacy: bool = False
    diameter_m: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in BOARDS:
            raise CalibrationError(f"unknown board kind '{self.kind}', expected one of {', '.join(BOARDS)}")
        if self.columns < 3 or self.rows < 3:
            raise CalibrationError(f"a board needs at least 3 columns and 3 rows, got {self.columns}x{self.rows}")
        if not 0.0 < self.square_m < 10.0:
            raise CalibrationError(f"square side {self.square_m} m is not between 0 and 10 m")
        if self.kind in WITH_MARKERS and not 0.0 < self.marker_m < self.square_m:
            raise CalibrationError(
                f"marker side {self.marker_m} m must be between 0 and the square side {self.square_m} m"
            )
        if self.kind in WITH_DISCS and not 0.0 < self.diameter_m < self.square_m:
            raise CalibrationError(
                f"diameter {self.diameter_m} m must be between 0 and the pitch of the grid {self.square_m} m"
            )

    @property
    def points_m(self) -> FloatArray:
        """All points in the board frame, shape (N, 3), m."""
        return read_only(_kind(self).points(self))


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """Found corners of one picture.

    Args:
        name: The picture.
        px: Corners, shape (N, 2), raw px.
        board_m: The same corners in the board frame, shape (N, 3), m.
        width_px: Picture width, px.
        height_px: Picture height, px.
    """

    name: str
    px: FloatArray
    board_m: FloatArray
    width_px: int
    height_px: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "px", read_only(self.px, (-1, 2)))
        object.__setattr__(self, "board_m", read_only(self.board_m, (len(self.px), 3)))


@dataclass(frozen=True, slots=True)
class BoardMiss:
    """No usable board in a picture, and why.

    Args:
        name: The picture.
        reason: A short, stable word for tables, for example ``board_not_found``.
        detail: One line for people.
    """

    name: str
    reason: str
    detail: str


class BoardKind(Protocol):
    """What a kind of board can do: a module with these functions.

    Besides, ``MARGIN`` where its ground is not white, and ``glance(grey, board) -> bool`` where a search in vain is
    slow.
    """

    def points(self, board: Board) -> FloatArray:
        """All points in the board frame, shape (N, 3), m."""
        ...

    def check(self, board: Board) -> None:
        """Raise CalibrationError when no such board can exist."""
        ...

    def find(self, grey: GreyImage, board: Board) -> tuple[FloatArray, NDArray[np.intp]] | tuple[str, str]:
        """Pixels (N, 2) with the indices of their points, or reason and detail."""
        ...

    def draw(self, board: Board, px_per_square: int) -> tuple[GreyImage, tuple[float, float]]:
        """The printed board without margin, and the board coordinates of its upper left corner in squares."""
        ...


def _kind(board: Board) -> BoardKind:
    return cast(BoardKind, importlib.import_module(BOARDS[board.kind]))


def symmetry(board: Board) -> Literal["", "half turn", "quarter turn"]:
    """By which turn a board looks the same again, so that its first point is one of several.

    Args:
        board: The board as declared.

    Returns:
        The smallest such turn; empty for a board that looks the same from no other side.
    """
    columns, rows = board.columns, board.rows
    if board.kind == "chessboard":
        is_half, is_quarter = (columns + rows) % 2 == 0, columns == rows and columns % 2 == 0
    elif board.kind == "circles":
        is_half, is_quarter = True, columns == rows
    else:
        is_half, is_quarter = board.kind == "asymmetric_circles" and rows % 2 == 0, False
    return "quarter turn" if is_quarter else "half turn" if is_half else ""


def check_board(board: Board) -> None:
    """Refuse a board that is declared well but cannot exist, before pictures are read.

    Args:
        board: The board as declared.

    Raises:
        CalibrationError: The marker dictionary is unknown or has too few markers.
    """
    if board.columns * board.rows > _MOST_POINTS:
        raise CalibrationError(f"a board of {board.columns}x{board.rows} is larger than any print")
    _kind(board).check(board)


def find_board(image: NDArray[np.generic], board: Board, name: str = "") -> BoardView | BoardMiss:
    """Find a board in a picture.

    Args:
        image: Mono (H, W) or BGR (H, W, 3), uint8 or uint16.
        board: The board as declared.
        name: Name of the picture.

    Returns:
        The found corners, or why there are none.
    """
    grey = _grey(image)
    first, second = _kind(board).find(grey, board)
    if isinstance(first, str):
        return BoardMiss(name, first, str(second))
    px, indices = first, cast("NDArray[np.intp]", second)
    height_px, width_px = grey.shape
    view = BoardView(name, px, board.points_m[indices], width_px, height_px)
    trouble = _trouble(view)
    return BoardMiss(name, *trouble) if trouble else view


def is_worth_a_search(image: NDArray[np.generic], board: Board) -> bool:
    """Whether a quick look sees something like the board; a full search for one that is not there takes long.

    Args:
        image: As for ``find_board``.
        board: The board as declared.

    Returns:
        False where it most likely shows no board, or one with squares too small to add anything; True for kinds that
        are searched quickly anyway.
    """
    glance = getattr(_kind(board), "glance", None)
    return glance is None or bool(glance(_grey(image), board))


def board_texture(board: Board, px_per_square: int = 64) -> tuple[GreyImage, float, FloatArray]:
    """The board as it would be printed, with a margin of one square (white; black around lights), for rendering.

    Args:
        board: The board.
        px_per_square: Pixels along one square; every square edge falls between two pixels.

    Returns:
        The picture (rows run along y); the side of one pixel, m; and the centre of its top-left pixel in the board
        frame, (x, y), m.
    """
    picture, corner = _kind(board).draw(board, px_per_square)
    margin = px_per_square
    ground = getattr(_kind(board), "MARGIN", 255)
    texture = np.pad(picture, margin, constant_values=ground)
    px_m = board.square_m / px_per_square
    origin = np.array(corner) * board.square_m - (margin - 0.5) * px_m
    return texture, px_m, read_only(origin)


def _grey(image: NDArray[np.generic]) -> GreyImage:
    import cv2

    if image.ndim == 3:
        image = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_BGR2GRAY)
    if image.dtype != np.uint8:
        # Twelve bits in sixteen are usual: use the range the picture has.
        low, high = float(image.min()), float(image.max())
        image = ((image.astype(np.float64) - low) * (255.0 / max(high - low, 1.0))).astype(np.uint8)
    return cast("GreyImage", np.ascontiguousarray(image))


def _trouble(view: BoardView) -> tuple[str, str] | None:
    """Why found corners cannot be used, by the best homography between board and picture."""
    import cv2

    if len(view.px) < MIN_POINTS:
        return "too_few_corners", f"{len(view.px)} corners, need {MIN_POINTS}"
    plane = view.board_m[:, :2]
    spread = np.linalg.svd(plane - plane.mean(axis=0), compute_uv=False)
    if spread[1] < 0.05 * spread[0]:
        return "corners_in_line", "all found corners lie on one line"
    H, _ = cv2.findHomography(plane, view.px, cv2.RANSAC, 0.02 * float(np.ptp(view.px, axis=0).max()))
    if H is None:
        return "board_mismatch", "the found corners do not fit a flat board"
    mapped = np.column_stack([plane, np.ones(len(plane))]) @ H.T
    error = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - view.px, axis=1)
    nearest = nearest_distance(view.px)
    # Lens distortion bends a board by a fraction of a square; a wrong column count shifts corners by whole squares.
    if float(np.median(error)) > 0.5 * float(np.median(nearest)):
        return "board_mismatch", f"corners lie {np.median(error):.1f} px off a flat board: wrong columns or rows?"
    if np.linalg.det(H) < 0.0:
        return "mirrored", "the board is seen mirrored"
    return None


def nearest_distance(px: FloatArray | Sequence[Sequence[float]]) -> FloatArray:
    """Distance of every point to its nearest neighbour, shape (N,), px."""
    points = np.asarray(px, dtype=np.float64)
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    result: FloatArray = apart.min(axis=1)
    return result
