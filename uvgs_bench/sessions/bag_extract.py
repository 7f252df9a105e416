"""The pictures of bags as files, with their instants beside them: ``images:FOLDER`` reads back the same captures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from uvgs_bench.errors import ConfigError, FormatError, UvgsError
from uvgs_bench.interop.stamp_file import STAMP_FILE, PictureStamp, read_stamps, stamps_text
from uvgs_bench.sessions.events import EventSink, StageAdvanced, StageFinished, StageStarted
from uvgs_bench.sessions.interruption import check_interruption
from uvgs_bench.sessions.remarks import told_captures
from uvgs_bench.store.documents import write_atomically

if TYPE_CHECKING:
    from uvgs_bench.devices.cameras.source import CameraSource
    from uvgs_bench.sensor.capture import Capture

STAGE = "extract"


@dataclass(frozen=True, slots=True)
class Extracted:
    """What was written.

    Args:
        folder: Where to.
        pictures: Their number.
        stamps: The file of their instants.
        start_ns: Instant of the first, ns; None without pictures.
        end_ns: Instant of the last, ns; None without pictures.
    """

    folder: Path
    pictures: int
    stamps: Path
    start_ns: int | None
    end_ns: int | None


def extract_pictures(
    source: CameraSource,
    folder: Path,
    sink: EventSink,
    *,
    every: int = 1,
    limit: int | None = None,
    force: bool = False,
) -> Extracted:
    """Write the pictures of a source as PNG, and ``stamps.csv``.

    Args:
        source: The open source.
        folder: Where to; created.
        sink: Told about progress and what is wrong.
        every: Take every n-th picture only.
        limit: Take at most so many; all when None.
        force: Whether an earlier extraction in the folder is replaced.

    Returns:
        What was written; after an interruption what was written until then.

    Raises:
        CaptureError: The source fails; what was written until then stays.
        ConfigError: The folder is not empty and may not be written to, or holds what was not extracted.
        UvgsError: A file cannot be written.
    """
    _make_room(folder, force)
    total = None if source.length is None else (source.length + every - 1) // every
    known = [n for n in (total, limit) if n is not None]
    sink(StageStarted(STAGE, min(known) if known else None))
    stamps: list[PictureStamp] = []
    try:
        for capture in told_captures(source, sink):
            check_interruption()
            if capture.index % every:
                continue
            stamps.append(_write(folder, capture, len(stamps)))
            sink(StageAdvanced(STAGE, len(stamps), capture.source))
            if limit is not None and len(stamps) >= limit:
                break
    finally:
        if stamps:
            write_atomically(folder / STAMP_FILE, stamps_text(stamps))
    sink(StageFinished(STAGE, f"{len(stamps)} pictures"))
    ends_ns = (stamps[0].t_ns, stamps[-1].t_ns) if stamps else (None, None)
    return Extracted(folder, len(stamps), folder / STAMP_FILE, *ends_ns)


def _write(folder: Path, capture: Capture, number: int) -> PictureStamp:
    import cv2

    name = f"{number:06d}.png"
    # Level 1 costs a third of the time of the default, for files a tenth larger.
    _, payload = cv2.imencode(".png", capture.image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    try:
        (folder / name).write_bytes(payload.tobytes())
    except OSError as error:
        raise UvgsError(f"{folder / name}: cannot be written: {error.strerror or error}") from None
    return PictureStamp(name, capture.t_ns, capture.bayer, capture.source)


def _make_room(folder: Path, force: bool) -> None:
    """An empty folder: earlier pictures among new ones would be taken for them."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UvgsError(f"{folder}: cannot be written: {error.strerror or error}") from None
    there = {path.name for path in folder.iterdir()}
    if not there:
        return
    if not force:
        raise ConfigError("is not empty; use --force to replace an earlier extraction", str(folder))
    try:
        own = {stamp.file for stamp in read_stamps(folder / STAMP_FILE)} | {STAMP_FILE}
    except FormatError:
        own = set()
    if strange := sorted(there - own):
        raise ConfigError(f"holds {strange[0]}, which no extraction wrote; choose an empty folder", str(folder))
    for name in own & there:
        (folder / name).unlink()
