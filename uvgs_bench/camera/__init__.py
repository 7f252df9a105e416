"""Lenses, boards, calibration.

Here: projection models, calibration boards, calibration and its doubt. In: pixels and board points. Out:
``Calibration``. Plug points: ``LENSES`` (lens.py), ``BOARDS`` (boards.py).
"""

from uvgs_bench.camera.boards import Board, BoardView, find_board
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.fitting import CalibrationResult, calibrate
from uvgs_bench.camera.lens import LENSES, Lens

__all__ = ["LENSES", "Board", "BoardView", "Calibration", "CalibrationResult", "Lens", "calibrate", "find_board"]
