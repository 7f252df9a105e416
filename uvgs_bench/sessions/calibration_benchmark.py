"""How long a calibration takes on drawn corners, next to OpenCV on the same corners, and on a large set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from time import process_time

import numpy as np

from uvgs_bench.camera import Board, BoardView, Lens, calibrate
from uvgs_bench.camera.fitting import fit
from uvgs_bench.devices.sim.board_views import place_board
from uvgs_bench.geometry import FloatArray
from uvgs_bench.sessions.events import EventSink, StageAdvanced, StageFinished, StageStarted

PEER = "cv2.calibrateCamera"
_WIDTH_PX, _HEIGHT_PX = 1280, 960
_NOISE_PX = 0.1
_STAGE = "benchmark calibration"
_PARAMETERS = {
    "plumb_bob": [1000.0, 1003.0, 645.0, 470.0, -0.2, 0.08, 8e-4, -5e-4, 0.01],
    "rational_polynomial": [1000.0, 1003.0, 645.0, 470.0, 0.1, 0.05, 8e-4, -5e-4, 0.01, 0.3, 0.02, 0.01],
}
_ANCHORS = ((0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0), (0.5, 0.5))


@dataclass(frozen=True, slots=True)
class CalibrationBenchmark:
    """What the run measured; all times are those of the processor, all threads together.

    Args:
        views: Views of the smaller set.
        corners: Corners of each of its views.
        fit_s: Least time of our adjustment with its covariance, s.
        peer_s: Least time of OpenCV, which gives no covariance, s.
        ratio: Median over the repeats of ours over OpenCV's, taken in turns.
        rms_difference_px: Difference of the two RMS, px: that both found the same minimum.
        whole_s: Least time of our adjustment with everything the verdict needs, s.
        large_views: Views of the larger set.
        large_corners: Corners of each of its views.
        large_parameters: Parameters of its lens.
        large_fit_s: Time of our adjustment of the larger set, s.
        large_whole_s: The same with everything the verdict needs, s.
    """

    views: int
    corners: int
    fit_s: float
    peer_s: float
    ratio: float
    rms_difference_px: float
    whole_s: float
    large_views: int
    large_corners: int
    large_parameters: int
    large_fit_s: float
    large_whole_s: float


def benchmark_calibration(sink: EventSink, *, repeats: int = 15, seed: int = 0) -> CalibrationBenchmark:
    """Time calibrations of 26 views of 54 corners and of 186 views of 100 corners.

    Args:
        sink: Where progress goes.
        repeats: How often the smaller set is calibrated by each.
        seed: Of poses and noise.

    Returns:
        The measured times.
    """
    import cv2

    rng = np.random.default_rng(seed)
    small = drawn_views("plumb_bob", 9, 6, 26, rng)
    large = drawn_views("rational_polynomial", 10, 10, 186, rng)
    board = [np.ascontiguousarray(view.board_m, dtype=np.float32) for view in small]
    px = [np.ascontiguousarray(view.px, dtype=np.float32).reshape(-1, 1, 2) for view in small]

    def peer() -> float:
        none = np.zeros((3, 3)), np.zeros(5)
        return float(cv2.calibrateCamera(board, px, (_WIDTH_PX, _HEIGHT_PX), *none)[0])

    # Compiled, and the peer's threads started, before the clock runs.
    rms_px = calibrate(small, "plumb_bob", reject_outliers=False).calibration.rms_px
    assert rms_px is not None
    difference_px = abs(rms_px - peer())
    sink(StageStarted(_STAGE, repeats + 1))
    ours, theirs = [], []
    for i in range(repeats):
        ours.append(_spent_s(lambda: fit(small, "plumb_bob", reject_outliers=False)))
        theirs.append(_spent_s(peer))
        sink(StageAdvanced(_STAGE, i + 1, "26 views"))
    whole_s = min(_spent_s(lambda: calibrate(small, "plumb_bob")) for _ in range(3))
    large_fit_s = _spent_s(lambda: fit(large, "rational_polynomial"))
    large_whole_s = _spent_s(lambda: calibrate(large, "rational_polynomial"))
    sink(StageFinished(_STAGE))
    return CalibrationBenchmark(
        len(small),
        len(small[0].px),
        min(ours),
        min(theirs),
        median(a / b for a, b in zip(ours, theirs, strict=True)),
        difference_px,
        whole_s,
        len(large),
        len(large[0].px),
        len(_PARAMETERS["rational_polynomial"]),
        large_fit_s,
        large_whole_s,
    )


def drawn_views(model: str, columns: int, rows: int, count: int, rng: np.random.Generator) -> list[BoardView]:
    """Corners of a flat board as a lens sees them, with normal noise of 0.1 px.

    Args:
        model: ``plumb_bob`` or ``rational_polynomial``.
        columns: Corners along x.
        rows: Corners along y.
        count: Number of views.
        rng: Source of poses and noise.

    Returns:
        The views.
    """
    lens = Lens(model, _WIDTH_PX, _HEIGHT_PX, np.array(_PARAMETERS[model]))
    points_m = Board("drawn", "chessboard", columns, rows, 0.03).points_m
    views = []
    for i in range(count):
        pose = place_board(lens, points_m, _ANCHORS[i % len(_ANCHORS)], rng)
        px: FloatArray = lens.project(pose.apply(points_m))
        noisy = px + rng.normal(0.0, _NOISE_PX, px.shape)
        views.append(BoardView(f"view {i}", noisy, points_m, _WIDTH_PX, _HEIGHT_PX))
    return views


def _spent_s(work: Callable[[], object]) -> float:
    start_s = process_time()
    work()
    return process_time() - start_s
