"""Leading work on camera files: reading anybody's, converting, checking against new pictures."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from pathlib import Path

import numpy as np

from uvgs_bench.camera import Board, Calibration
from uvgs_bench.camera.difference import Refit, refit
from uvgs_bench.camera.validity import MIN_VIEWS, Validity, ValidityLimits, check_validity
from uvgs_bench.devices.cameras.source import CameraSource
from uvgs_bench.errors import CalibrationError, ConfigError, FormatError, TooFewViews
from uvgs_bench.interop.camera_files import CAMERA_FORMATS, exact_lens, format_of, lens_text, read_lenses
from uvgs_bench.sessions.events import EventSink, ignore_events
from uvgs_bench.sessions.find_boards import find_boards
from uvgs_bench.store.calibrations import calibration_text, read_calibration
from uvgs_bench.store.documents import write_atomically

OWN_FORMAT = "uvgs"
"""``camera_info`` YAML with the ``uvgs:`` mapping: the only format that keeps the doubt."""
FORMATS = (OWN_FORMAT, *CAMERA_FORMATS)
_BY_ENDING = {
    ".yaml": OWN_FORMAT,
    ".yml": OWN_FORMAT,
    ".cameramodel": "mrcal",
    ".txt": "colmap",
    ".lua": "astrobee",
    ".config": "astrobee",
}


def read_camera(path: Path, camera: str = "", size_px: tuple[int, int] | None = None) -> Calibration:
    """Read a camera file of any known format.

    Args:
        path: The file; its content says the format.
        camera: Name of the camera, where the file holds several.
        size_px: Width and height of the picture, where the file does not say it.

    Returns:
        The calibration; without doubt unless the file is of this program.

    Raises:
        ConfigError: A broken ``camera_info``, or no camera of that name.
        FormatError: Missing file, no known format, or a broken file.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise FormatError("no such file", str(path)) from None
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"cannot be read: {error}", str(path)) from None
    if format_of(text, str(path)) == "ros":
        calibration = read_calibration(path)
        if camera not in ("", calibration.camera_name):
            raise ConfigError(f"no camera '{camera}' in {path}, it has {calibration.camera_name}", "--camera")
        return calibration
    lenses = read_lenses(text, str(path), size_px)
    if not camera and len(lenses) == 1:
        camera = next(iter(lenses))
    if camera not in lenses:
        said = f"no camera '{camera}' in {path}" if camera else f"{path} has several cameras"
        raise ConfigError(f"{said}, expected one of {', '.join(lenses)}", "--camera")
    name = camera if camera not in ("camera", "1") else path.stem
    return Calibration(lenses[camera], name, notes={"converted_from": path.name})


@dataclass(frozen=True, slots=True, eq=False)
class Conversion:
    """What a conversion did.

    Args:
        path: The file written.
        target: Its format, one of ``FORMATS``.
        source: The calibration read.
        written: The calibration written.
        refit: How well the new lens stands in for the old one; None for an exact conversion.
        remarks: What the new file does not hold.
    """

    path: Path
    target: str
    source: Calibration
    written: Calibration
    refit: Refit | None
    remarks: tuple[str, ...]


def convert_camera(
    source: Path,
    out: Path,
    *,
    target: str = "",
    refit_model: str = "",
    camera: str = "",
    size_px: tuple[int, int] | None = None,
    force: bool = False,
) -> Conversion:
    """Convert a camera file, exactly or not at all, unless a refit is asked for.

    Args:
        source: The file to read, of any known format.
        out: The file to write.
        target: One of ``FORMATS``; by the ending of ``out`` when empty.
        refit_model: Lens to refit to; empty for an exact conversion.
        camera: Name of the camera, where the file holds several.
        size_px: Width and height of the picture, where the file does not say it.
        force: Whether an existing file may be replaced.

    Returns:
        What was done.

    Raises:
        ConfigError: Unknown format, no camera of that name, or the output exists.
        FormatError: The source is broken.
        CalibrationError: The target has no exact form for the lens, or the refit covers the field nowhere near.
    """
    target = target or _BY_ENDING.get(out.suffix.lower(), "")
    if target not in FORMATS:
        said = f"unknown format '{target}'" if target else f"the ending of {out.name} names no format"
        raise ConfigError(f"{said}, expected one of {', '.join(FORMATS)}", "--to")
    if out.exists() and not force:
        raise ConfigError("exists already; use --force to replace it", str(out))
    read = read_camera(source, camera, size_px)
    written, refitted = read, None
    if refit_model:
        zeros = () if target == OWN_FORMAT else CAMERA_FORMATS[target].must_be_zero.get(refit_model, ())
        verdict = read.verdict
        is_partial = verdict is not None and verdict.word == "usable_within_radius"
        # Beyond, the lens is a guess, and no new lens need follow it there.
        refitted = refit(read.lens, refit_model, zeros, verdict.radius_px if verdict and is_partial else inf)
        figures = (
            f"refitted from {read.lens.model}: RMS {refitted.rms_px:.4f} px, at most {refitted.max_px:.4f} px off "
            f"over {100.0 * refitted.covered_share:.1f} % of the picture"
        )
        written = Calibration(refitted.lens, read.camera_name, notes={**read.notes, "refit": figures})
    remarks = _remarks(read, target, refitted)
    if target == OWN_FORMAT:
        text = calibration_text(written)
    else:
        # Refused here, with the file's name, before anything is written.
        try:
            lens = exact_lens(written.lens, target)
        except CalibrationError as error:
            raise CalibrationError(f"{source}: {error}") from None
        written = Calibration(lens, read.camera_name, notes=written.notes)
        comments = [written.notes["refit"]] if refitted else []
        text = lens_text(lens, target, read.camera_name or "camera", tuple(comments))
    write_atomically(out, text, force=force)
    return Conversion(out, target, read, written, refitted, remarks)


def _remarks(read: Calibration, target: str, refitted: Refit | None) -> tuple[str, ...]:
    said = []
    if refitted is not None and read.covariance is not None:
        said.append("the covariance belongs to the old parameters and is left out")
    elif target != OWN_FORMAT and read.covariance is not None:
        said.append(f"{CAMERA_FORMATS[target].what} has no place for the covariance and the residuals: keep the source")
    if target == "opencv" and (refitted.lens if refitted else read.lens).model == "equidistant":
        said.append("OpenCV files do not name the lens: these 4 coefficients are for cv2.fisheye (fisheye_model: 1)")
    return tuple(said)


def check_camera(
    calibration: Calibration,
    source: CameraSource,
    board: Board,
    *,
    limits: ValidityLimits | None = None,
    sink: EventSink = ignore_events,
    limit: int | None = None,
    seed: int = 0,
) -> Validity:
    """Judge an existing calibration on new pictures of a board.

    Args:
        calibration: The calibration.
        source: New captures of the board; it stays open.
        board: The board as declared.
        limits: How much may have changed.
        sink: Where progress and remarks go.
        limit: At most so many captures; a live camera needs one.
        seed: Of the intervals over the views.

    Returns:
        Verdict and figures.

    Raises:
        ConfigError: A live camera without a limit.
        CaptureError: The source cannot be read, or gives no pictures.
        TooFewViews: The board was found in too few pictures, or they do not say enough.
        CalibrationError: The pictures have another size than the calibration.
    """
    found = find_boards(source, board, sink=sink, limit=limit)
    if len(found.views) < MIN_VIEWS:
        pictures = len(found.views) + len(found.misses)
        raise TooFewViews(
            f"board '{board.name}' usable in {len(found.views)} of {pictures} pictures, need {MIN_VIEWS}: "
            f"{found.misses[0].name}: {found.misses[0].detail}"
            if found.misses
            else f"{len(found.views)} pictures, need {MIN_VIEWS}"
        )
    return check_validity(calibration, found.views, np.random.default_rng(seed), limits)
