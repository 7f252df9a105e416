"""Calibration boards on disk: ``calib/boards/<name>.toml``."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path

from uvgs_bench.camera.boards import BOARDS, Board, check_board
from uvgs_bench.errors import CalibrationError, ConfigError
from uvgs_bench.store.documents import read_document
from uvgs_bench.units import m_from_mm

_LONGEST_MM = 10_000.0


@dataclass(frozen=True, slots=True)
class BoardFile:
    """Keys of a board file; lengths in mm.

    Args:
        name: For people.
        kind: Key of ``BOARDS``.
        columns: Inner corners (chessboard) or squares (ChArUco) along x.
        rows: The same along y.
        square_mm: Side of a square, mm, as measured on the print.
        marker_mm: Side of a marker, mm; ChArUco only.
        dictionary: Marker dictionary by its OpenCV name; ChArUco only.
        legacy: ChArUco pattern of OpenCV before 4.6.
    """

    name: str
    kind: str
    columns: int
    rows: int
    square_mm: float
    marker_mm: float | None = None
    dictionary: str = ""
    legacy: bool = False


def read_board(path: Path | str) -> Board:
    """Read a board file.

    Args:
        path: A TOML file with ``schema = 1``.

    Returns:
        The board, in metres.

    Raises:
        ConfigError: Missing file, unknown or missing key, unknown kind, or a value that cannot be meant.
    """
    path = Path(path)
    read = read_document(path, BoardFile)
    if read.kind not in BOARDS:
        near = difflib.get_close_matches(read.kind, BOARDS, n=1)
        hint = f", did you mean '{near[0]}'?" if near else f", expected one of: {', '.join(BOARDS)}"
        raise ConfigError(f"unknown kind '{read.kind}'{hint}", str(path), "kind")
    has_markers = read.kind == "charuco"
    for key, value in (("marker_mm", read.marker_mm), ("dictionary", read.dictionary)):
        if has_markers and not value:
            raise ConfigError(f"a {read.kind} board needs this key", str(path), key)
        if not has_markers and value:
            raise ConfigError(f"a {read.kind} board has no markers", str(path), key)
    for key in ("square_mm", "marker_mm"):
        length_mm = getattr(read, key)
        if length_mm is not None and not 0.0 < length_mm <= _LONGEST_MM:
            raise ConfigError(f"must be between 0 and {_LONGEST_MM:.0f}, got {length_mm}", str(path), key)
    if has_markers and read.marker_mm is not None and read.marker_mm >= read.square_mm:
        raise ConfigError(
            f"must be less than square_mm = {read.square_mm}, got {read.marker_mm}", str(path), "marker_mm"
        )
    try:
        board = Board(
            read.name,
            read.kind,
            read.columns,
            read.rows,
            m_from_mm(read.square_mm),
            m_from_mm(read.marker_mm or 0.0),
            read.dictionary,
            read.legacy,
        )
        check_board(board)
    except CalibrationError as error:
        raise ConfigError(str(error), str(path)) from None
    return board
