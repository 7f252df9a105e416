"""Calibrating from circles: the bias of their centres must not reach the lens."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.camera.boards import Board
from uvgs_bench.devices.sim.board_views import SimulatedBoardSource
from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.sessions.calibrate import calibrate_from_source


@pytest.mark.opencv
def test_large_circles_give_the_true_lens():
    truth = SimulatedTruth()
    board = Board(name="dots", kind="circles", columns=8, rows=6, square_m=0.03, diameter_m=0.021)
    with SimulatedBoardSource(truth, board, 14, seed=5) as views:
        result = calibrate_from_source(views, board, truth.camera.model)
    fitted = result.calibration
    assert fitted.rms_px < 0.1  # px; without the correction it is 0.3 to 0.4
    assert fitted.covariance is not None
    off = fitted.lens.parameters - np.array(truth.camera.parameters_px)
    # 33.7 is the 99.99 % point of chi-squared with 9 degrees of freedom; uncorrected circles give thousands.
    assert off @ np.linalg.solve(fitted.covariance, off) < 33.7
    assert abs(off[0]) < 0.5  # px of focal length
