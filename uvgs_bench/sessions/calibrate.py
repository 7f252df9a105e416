"""Leading a calibration: take pictures of a board, find it in each, fit a lens."""

from __future__ import annotations

import hashlib
from collections import Counter, deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import islice

from uvgs_bench import __version__
from uvgs_bench.camera import Board, BoardView, CalibrationResult, calibrate, find_board
from uvgs_bench.camera.boards import BoardMiss
from uvgs_bench.camera.fitting import MIN_VIEWS
from uvgs_bench.camera.lens_choice import choose_lens
from uvgs_bench.devices.cameras.source import CameraSource
from uvgs_bench.errors import CaptureError, ConfigError, TooFewViews
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sessions.events import EventSink, Remark, StageAdvanced, StageFinished, StageStarted, ignore_events
from uvgs_bench.units import mm_from_m

# OpenCV works outside the interpreter lock; more pictures in flight only cost memory.
_WORKERS = 2
_IN_FLIGHT = 4

AUTO_LENS = "auto"
"""In place of a lens: the pictures choose it."""


def calibrate_from_source(
    source: CameraSource,
    board: Board,
    model: str,
    *,
    sink: EventSink = ignore_events,
    camera_name: str = "",
    reject_outliers: bool = True,
    limit: int | None = None,
    is_board_free: bool = False,
) -> CalibrationResult:
    """Find the board in every capture of a source and fit a lens.

    Args:
        source: Captures of the board; it stays open.
        board: The board as declared.
        model: Key of ``LENSES``, or ``auto`` to compare them on pictures they have not seen.
        sink: Where progress and remarks go.
        camera_name: For people.
        reject_outliers: Whether outlier corners are set aside.
        limit: At most so many captures; a live camera needs one.
        is_board_free: Whether the bow and the stretch of the printed board are estimated too.

    Returns:
        The calibration, with the pictures in which no usable board was found in ``misses``.

    Raises:
        ConfigError: A live camera without a limit.
        CaptureError: The source cannot be read, or gives no pictures.
        TooFewViews: The board was found in fewer than three pictures; the message says why.
        CalibrationError: The pictures differ in size, or no lens of the model fits.
    """
    if source.is_live and limit is None:
        raise ConfigError("a live camera needs a number of captures to take", source.spec)
    views, misses, digest = _find_boards(source, board, sink, limit)
    if len(views) < MIN_VIEWS:
        if not views and not misses:
            raise CaptureError("gives no pictures", source.spec)
        raise TooFewViews(_too_few(views, misses, board))
    sink(StageStarted("calibrate"))
    notes = {
        "board": f"{board.name} ({board.kind} {board.columns}x{board.rows}, {mm_from_m(board.square_m):g} mm squares)",
        "source": source.spec,
        "pictures_sha256": digest,
        "created_utc": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "uvgs_bench": __version__,
        "numpy": version("numpy"),
        "opencv": _opencv_version(),
    }
    if model == AUTO_LENS:
        choice = choose_lens(views)
        for trial in choice.trials:
            if trial.remark:
                sink(Remark("info", trial.remark))
        model = choice.model
        notes["lens_choice"] = "; ".join(
            f"{trial.model} {trial.rms_px:.4f} px, unseen {trial.held_out_rms_px:.4f} px" for trial in choice.trials
        )
    result = calibrate(
        views,
        model,
        camera_name=camera_name,
        reject_outliers=reject_outliers,
        is_board_free=is_board_free,
        notes=notes,
    )
    for text in result.warnings:
        sink(Remark("warning", text))
    fitted = result.calibration
    sink(StageFinished("calibrate", f"{model}, RMS {fitted.rms_px:.3f} px over {fitted.view_count} views"))
    return replace(result, misses=tuple(misses))


def _find_boards(
    source: CameraSource, board: Board, sink: EventSink, limit: int | None
) -> tuple[list[BoardView], list[BoardMiss], str]:
    total = source.length if limit is None else min(limit, source.length or limit)
    sink(StageStarted("find board", total))
    views: list[BoardView] = []
    misses: list[BoardMiss] = []
    digest = hashlib.sha256()

    def collect(answer: Future[BoardView | BoardMiss]) -> None:
        found = answer.result()
        if isinstance(found, BoardView):
            views.append(found)
            detail = f"{found.name}: {len(found.px)} corners"
        else:
            misses.append(found)
            detail = f"{found.name}: {found.reason}"
            sink(Remark("warning", f"{found.name}: {found.reason}: {found.detail}"))
        sink(StageAdvanced("find board", len(views) + len(misses), detail))

    with ThreadPoolExecutor(_WORKERS) as pool:
        waiting: deque[Future[BoardView | BoardMiss]] = deque()
        for capture in islice(source, limit):
            digest.update(capture.image.tobytes())
            waiting.append(pool.submit(find_board, capture.image, board, _name(capture)))
            if len(waiting) >= _IN_FLIGHT:
                collect(waiting.popleft())
        while waiting:
            collect(waiting.popleft())
    sink(StageFinished("find board", f"{len(views)} of {len(views) + len(misses)} pictures usable"))
    return views, misses, digest.hexdigest()


def _name(capture: Capture) -> str:
    return capture.source or f"capture {capture.index}"


def _too_few(views: list[BoardView], misses: list[BoardMiss], board: Board) -> str:
    """The one line that says what to change."""
    counted = Counter(miss.reason for miss in misses)
    reasons = ", ".join(f"{count}x {reason}" for reason, count in counted.most_common())
    line = f"board '{board.name}' usable in {len(views)} of {len(views) + len(misses)} pictures, need {MIN_VIEWS}"
    if not misses:
        return line
    example = next(miss for miss in misses if miss.reason == counted.most_common(1)[0][0])
    return f"{line}: {reasons}; {example.name}: {example.detail}"


def _opencv_version() -> str:
    import cv2

    return str(cv2.__version__)
