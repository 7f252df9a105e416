"""Somebody waves a calibration board before the simulated camera: moves, holds still, moves on."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from uvgs_bench.camera.boards import Board
from uvgs_bench.devices.cameras.base import ClosingSource
from uvgs_bench.devices.clock import Clock
from uvgs_bench.devices.sim.board_views import SimulatedBoardSource
from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.errors import CaptureError, ConfigError
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_exp, so3_log
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.units import s_from_ms

if TYPE_CHECKING:
    from uvgs_bench.devices.cameras.spec import CameraSpec

# The room that reads files lies above this one, so it is asked for by name, as every plug is.
_BOARD_OF_FILE = ("uvgs_bench.store.boards", "read_board")
STEP_NS = 200_000_000
"""Time between two captures, ns."""
# Captures on the way to a place, then at it; some places are held twice, as people do.
_MOVING, _HELD = 2, 3
_PLACES = 40
# A hand trembles: deviation of the board's attitude (rad) and place (m) between captures.
_TREMBLE_RAD, _TREMBLE_M = 1e-4, 2e-5


class WavedBoard(ClosingSource):
    """A live camera before a waved board; the same seed gives the same pixels.

    Args:
        truth: Camera and seed.
        board: The board, printed true to its declaration.
        spec: The spec string it is known by.
        seed: Seed in place of the truth's.

    Raises:
        CalibrationError: The board cannot be placed whole in the picture.
        ConfigError: The true lens is impossible.
    """

    def __init__(
        self, truth: SimulatedTruth, board: Board, spec: str = "sim-board:", *, seed: int | None = None
    ) -> None:
        super().__init__(spec, is_live=True, length=None)
        self._views = SimulatedBoardSource(truth, board, _PLACES, seed=seed)
        self._exposure_s = s_from_ms(truth.camera.exposure_ms)
        self._rng = np.random.default_rng((truth.seed if seed is None else seed, 7))
        self._next = 0
        self._is_closed = False

    @classmethod
    def open(cls, spec: CameraSpec, _clock: Clock) -> WavedBoard:
        """Open ``sim-board:BOARD.toml``, with the option ``seed``.

        Raises:
            CaptureError: There is no such file.
            ConfigError: An option is unknown or no number, or the board file is broken.
        """
        spec.check_options(("seed",))
        path, seed = Path(spec.target), spec.options.get("seed", "1")
        if not path.is_file():
            raise CaptureError("no such file, expected a board file", spec.target or spec.text)
        if not seed.isdigit():
            raise ConfigError(f"expected seed as a number, got '{seed}'", spec.text)
        module, function = _BOARD_OF_FILE
        board: Board = getattr(import_module(module), function)(path)
        return cls(SimulatedTruth(seed=int(seed)), board, spec.text)

    def grab(self) -> Capture:
        """Expose and return a capture.

        Raises:
            CaptureError: The camera is closed.
        """
        if self._is_closed:
            raise CaptureError("the camera is closed", self.spec)
        index = self._next
        self._next += 1
        image = self._views.view(self._pose(index), index)
        return Capture(image, index * STEP_NS, self.spec, index, self._exposure_s)

    def _pose(self, index: int) -> Pose:
        """Where the board is: on its way in a straight line, then at a place; after the last place the first again."""
        places = self._views.true_camera_from_board
        round_, phase = divmod(index, _MOVING + _HELD)
        start, end = places[(round_ - 1) % len(places)], places[round_ % len(places)]
        share = min((phase + 1.0) / (_MOVING + 1.0), 1.0)
        turn = share * so3_log(end.R @ start.R.T)
        t_m = (1.0 - share) * start.t_m + share * end.t_m + self._rng.normal(0.0, _TREMBLE_M, 3)
        R = so3_exp(turn + self._rng.normal(0.0, _TREMBLE_RAD, 3)) @ start.R
        return Pose(R, t_m, "camera", "board")

    def close(self) -> None:
        """Take no more captures. Safe to call twice."""
        self._is_closed = True
