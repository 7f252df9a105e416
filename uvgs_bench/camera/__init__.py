"""Lenses, boards, calibration.

Here: projection models, calibration boards, calibration and its doubt. In: pixels and board points. Out:
``Calibration``. Plug points: ``LENSES`` (lens.py), ``BOARDS`` (boards.py).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.lens import LENSES, Lens

if TYPE_CHECKING:
    from uvgs_bench.camera.boards import Board, BoardView, find_board
    from uvgs_bench.camera.fitting import CalibrationResult, calibrate

__all__ = ["LENSES", "Board", "BoardView", "Calibration", "CalibrationResult", "Lens", "calibrate", "find_board"]

_HOMES = {
    "Board": "boards",
    "BoardView": "boards",
    "find_board": "boards",
    "CalibrationResult": "fitting",
    "calibrate": "fitting",
}


def __getattr__(name: str) -> object:
    """Load what calibrates only when asked for: a sensor needs the lens and its doubt alone."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
