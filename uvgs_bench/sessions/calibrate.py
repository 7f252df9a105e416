"""Leading a calibration: take pictures of a board, find it in each, fit a lens."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from uvgs_bench import __version__
from uvgs_bench.camera import Board, BoardView, CalibrationResult, calibrate
from uvgs_bench.camera.board_circles import corrected_view
from uvgs_bench.camera.boards import BoardMiss, symmetry
from uvgs_bench.camera.fitting import MIN_VIEWS, fit
from uvgs_bench.camera.lens_choice import LensTrial, choose_lens
from uvgs_bench.devices.cameras.source import CameraSource
from uvgs_bench.errors import ConfigError, TooFewViews
from uvgs_bench.geometry import Pose
from uvgs_bench.sessions.events import EventSink, Remark, StageFinished, StageStarted, ignore_events
from uvgs_bench.sessions.find_boards import find_boards
from uvgs_bench.sessions.guided_views import guide_views
from uvgs_bench.units import mm_from_m

AUTO_LENS = "auto"
"""In place of a lens: the pictures choose it."""
# One coefficient, near enough to any lens to see what is missing, with few views too.
_GUIDING_LENS = "fov"


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
    keep: Path | None = None,
) -> CalibrationResult:
    """Find the board in every capture of a recording, or lead through the views of a live camera, and fit a lens.

    Args:
        source: Captures of the board; it stays open.
        board: The board as declared.
        model: Key of ``LENSES``, or ``auto`` to compare them on pictures they have not seen.
        sink: Where progress and remarks go.
        camera_name: For people.
        reject_outliers: Whether outlier corners are set aside.
        limit: At most so many captures; of a live camera, those looked at.
        is_board_free: Whether the bow and the stretch of the printed board are estimated too.
        keep: Folder for the pictures taken from a live camera; none are kept when None.

    Returns:
        The calibration, with the pictures in which no usable board was found in ``misses``.

    Raises:
        ConfigError: A folder for pictures of a recording, which has them already, or one that cannot be written; the
            shape of a board that looks the same after a quarter turn.
        CaptureError: The source cannot be read, or gives no pictures.
        TooFewViews: The board was found in fewer than three pictures; the message says why.
        CalibrationError: The pictures differ in size, or no lens of the model fits.
    """
    if is_board_free and symmetry(board) == "quarter turn":
        said = "looks the same after a quarter turn, so its stretch along y and x is one"
        raise ConfigError(f"board '{board.name}' {said}: print another number of rows", "--board-shape")
    if source.is_live:
        guide = _GUIDING_LENS if model == AUTO_LENS else model
        found = guide_views(source, board, guide, sink=sink, limit=limit, keep=keep)
    elif keep is not None:
        raise ConfigError("is for live cameras: a recording keeps its pictures itself", "--keep")
    else:
        found = find_boards(source, board, sink=sink, limit=limit)
    views, misses = found.views, found.misses
    if len(views) < MIN_VIEWS:
        raise TooFewViews(_too_few(views, misses, board))
    sink(StageStarted("calibrate"))
    notes = {
        "board": f"{board.name} ({board.kind} {board.columns}x{board.rows}, {mm_from_m(board.square_m):g} mm squares)",
        "source": source.spec,
        "pictures_sha256": found.pictures_sha256,
        "created_utc": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "uvgs_bench": __version__,
        "numpy": version("numpy"),
        "opencv": _opencv_version(),
    }
    trials: tuple[LensTrial, ...] = ()
    if model == AUTO_LENS:
        views = _without_disc_bias(views, board, "plumb_bob", reject_outliers)
        choice = choose_lens(views)
        for trial in choice.trials:
            if trial.remark:
                sink(Remark("info", trial.remark))
        model, trials = choice.model, choice.trials
        notes["lens_choice"] = "; ".join(
            f"{trial.model} {trial.rms_px:.4f} px, unseen {trial.held_out_rms_px:.4f} px" for trial in choice.trials
        )
    result = calibrate(
        _without_disc_bias(found.views, board, model, reject_outliers),
        model,
        camera_name=camera_name,
        reject_outliers=reject_outliers,
        is_board_free=is_board_free,
        notes=notes,
        circle=found.circle,
    )
    for text in result.warnings:
        sink(Remark("warning", text))
    fitted = result.calibration
    sink(StageFinished("calibrate", f"{model}, RMS {fitted.rms_px:.3f} px over {fitted.view_count} views"))
    return replace(result, misses=misses, lens_trials=trials)


def _without_disc_bias(
    views: Sequence[BoardView], board: Board, model: str, reject_outliers: bool
) -> tuple[BoardView, ...]:
    """Views of printed circles as if their centres themselves had been seen; other boards as they are.

    The centre of a circle's picture is not the picture of its centre; lens and poses of a first fit tell by how much.
    """
    if board.kind not in ("circles", "asymmetric_circles"):
        return tuple(views)
    first = fit(views, model, reject_outliers=reject_outliers).bundle
    return tuple(
        corrected_view(view, first.lens, Pose(R, t, "camera", "board"), board.diameter_m)
        for view, R, t in zip(views, first.R_cb, first.t_cb, strict=True)
    )


def _too_few(views: Sequence[BoardView], misses: Sequence[BoardMiss], board: Board) -> str:
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
