"""A run on disk: ``reports/<utc>_<procedure>/``, readable at any instant of its making.

``run.toml`` says what was known before and how it ended, ``setup/`` holds copies of everything it depends on,
``samples.jsonl`` gains one flushed line per capture, ``gantry.log`` every line on the wire, ``captures/`` pictures.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, get_args

from uvgs_bench.errors import RunError, UvgsError
from uvgs_bench.store.run_format import manifest_from_tables, sample_from_line, seam_from_table
from uvgs_bench.store.run_types import Ending, Run, RunManifest, Sample, Seam
from uvgs_bench.store.run_writer import (
    JOURNAL,
    MANIFEST,
    SETUP,
    SETUP_BEACON,
    SETUP_CALIBRATION,
    RunWriter,
)

if TYPE_CHECKING:
    from uvgs_bench.beacon.geometry import Beacon
    from uvgs_bench.camera.calibration import Calibration

__all__ = ["Ending", "Run", "RunManifest", "RunWriter", "Sample", "Seam", "is_run", "read_run"]


def is_run(path: Path) -> bool:
    """Whether a path is a run folder."""
    return (path / MANIFEST).is_file()


def read_run(path: Path) -> Run:
    """Read a run, finished or not.

    Args:
        path: The run folder.

    Returns:
        The run. A torn last line, left by a crash, is dropped with a remark; a run without an end has ``ended`` empty;
        of a station that was taken again only the last try counts; the name of a picture that is no longer there is
        left empty.

    Raises:
        RunError: No run folder, an unknown schema, a broken line before the last, or a set-up copy that is missing or
            unreadable.
    """
    if not path.is_dir():
        raise RunError("no such run folder", str(path))
    if not is_run(path):
        raise RunError(f"no run folder: it has no {MANIFEST}", str(path))
    tables = _read_tables(path / MANIFEST)
    try:
        manifest = manifest_from_tables(tables)
        seams = tuple(seam_from_table(table) for table in tables.get("seams", []))
        end = tables.get("end", {})
        ended = end.get("status", "")
        if ended not in get_args(Ending):
            raise ValueError(f"end.status is {ended!r}, expected one of completed, interrupted, failed")
    except (ValueError, TypeError, AttributeError) as error:
        raise RunError(str(error), str(path / MANIFEST)) from None
    samples, remarks = _read_samples(path / JOURNAL)
    kept = _last_attempts(samples)
    calibration, beacon = _read_setup(path / SETUP)
    return Run(
        path=path,
        manifest=manifest,
        samples=tuple(_with_existing_capture(sample, path) for sample in kept),
        ended=cast(Ending, ended),
        end_reason=str(end.get("reason", "")),
        calibration=calibration,
        beacon=beacon,
        ended_utc=str(end.get("ended_utc", "")),
        seams=seams,
        remarks=remarks,
    )


def _read_tables(path: Path) -> Mapping[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise RunError(f"cannot be read: {error}", str(path)) from None


def _read_samples(path: Path) -> tuple[list[Sample], tuple[str, ...]]:
    try:
        lines = path.read_bytes().split(b"\n")
    except FileNotFoundError:
        return [], (f"{path.name} is missing: no capture was taken",)
    except OSError as error:
        raise RunError(f"cannot be read: {error}", str(path)) from None
    torn = lines.pop()
    remarks = (f"the last line of {path.name} is torn and was dropped",) if torn else ()
    samples = []
    for number, line in enumerate(lines, start=1):
        try:
            samples.append(sample_from_line(line.decode("utf-8")))
        except ValueError as error:
            raise RunError(f"line {number} is no sample: {error}", str(path)) from None
    return samples, remarks


def _last_attempts(samples: list[Sample]) -> list[Sample]:
    last: dict[int, int] = {}
    for sample in samples:
        last[sample.station] = max(sample.attempt, last.get(sample.station, 0))
    return [sample for sample in samples if sample.attempt == last[sample.station]]


def _with_existing_capture(sample: Sample, run: Path) -> Sample:
    if not sample.capture_file or (run / sample.capture_file).is_file():
        return sample
    return replace(sample, capture_file="")


def _read_setup(folder: Path) -> tuple[Calibration, Beacon]:
    from uvgs_bench.store.beacons import read_beacon
    from uvgs_bench.store.calibrations import read_calibration

    try:
        return read_calibration(folder / SETUP_CALIBRATION), read_beacon(folder / SETUP_BEACON)
    except RunError:
        raise
    except UvgsError as error:
        raise RunError(f"its copy of the set-up cannot be read: {error}", str(folder)) from None
