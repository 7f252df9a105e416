"""Calibration boards on disk: ``calib/boards/<name>.toml``."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path

from uvgs_bench.camera.boards import BOARDS, WITH_DISCS, WITH_MARKERS, Board, check_board
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
        columns: Inner corners (chessboard), squares (ChArUco), tags, circles or lights along x.
        rows: The same along y.
        square_mm: Side of a square, mm, as measured on the print; chessboard and ChArUco.
        marker_mm: Side of a marker or tag, mm; ChArUco and AprilGrid.
        dictionary: Marker dictionary by its OpenCV name; ChArUco only.
        legacy: ChArUco pattern of OpenCV before 4.6.
        pitch_mm: Distance of neighbouring circles or lights, mm; between rows where they are staggered.
        diameter_mm: Diameter of a circle or light, mm.
        tag_spacing: Gap between tags over their side, as in Kalibr; AprilGrid only.
    """

    name: str
    kind: str
    columns: int
    rows: int
    square_mm: float | None = None
    marker_mm: float | None = None
    dictionary: str = ""
    legacy: bool = False
    pitch_mm: float | None = None
    diameter_mm: float | None = None
    tag_spacing: float | None = None


# Keys that some kinds need and the others must not have.
_KEYS_OF_KIND: dict[str, tuple[str, ...]] = {
    "square_mm": ("chessboard", "charuco"),
    "marker_mm": WITH_MARKERS,
    "dictionary": ("charuco",),
    "pitch_mm": WITH_DISCS,
    "diameter_mm": WITH_DISCS,
    "tag_spacing": ("aprilgrid",),
}


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
    for key, kinds in _KEYS_OF_KIND.items():
        value = getattr(read, key)
        # Nought is a wrong length, not a missing one.
        is_said = value is not None and value != ""
        if read.kind in kinds and not is_said:
            raise ConfigError(f"a {read.kind} board needs this key", str(path), key)
        if read.kind not in kinds and is_said:
            has = "markers" if key in ("marker_mm", "dictionary") and read.kind == "chessboard" else f"{key}"
            raise ConfigError(f"a {read.kind} board has no {has}", str(path), key)
        if key.endswith("_mm") and is_said and not 0.0 < value <= _LONGEST_MM:
            raise ConfigError(f"must be between 0 and {_LONGEST_MM:.0f}, got {value}", str(path), key)
    if read.tag_spacing is not None and not 0.0 < read.tag_spacing <= 2.0:
        raise ConfigError(f"must be between 0 and 2, got {read.tag_spacing}", str(path), "tag_spacing")
    step_mm = read.square_mm or read.pitch_mm or (read.marker_mm or 0.0) * (1.0 + (read.tag_spacing or 0.0))
    for key, within in (("marker_mm", "square_mm"), ("diameter_mm", "pitch_mm")):
        length_mm = getattr(read, key)
        if length_mm is not None and length_mm >= step_mm:
            raise ConfigError(f"must be less than {within} = {step_mm}, got {length_mm}", str(path), key)
    try:
        board = Board(
            read.name,
            read.kind,
            read.columns,
            read.rows,
            m_from_mm(step_mm),
            m_from_mm(read.marker_mm or 0.0),
            read.dictionary,
            read.legacy,
            m_from_mm(read.diameter_mm or 0.0),
        )
        check_board(board)
    except CalibrationError as error:
        raise ConfigError(str(error), str(path)) from None
    return board
