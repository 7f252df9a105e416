"""Pose files: CSV with every capture, TUM with poses only, JSON lines with covariance. The file's ending chooses.

A held pose (an old one repeated because there is no fresh one) never looks fresh: its status is ``held``, its CSV line
has no deviations, and in a TUM file it stands in a comment.

To add a format: write a class with ``write`` and ``close``, and one line in ``WRITERS``.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self, TextIO

import numpy as np

from uvgs_bench.errors import ConfigError, FormatError, UvgsError
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.handover import Held
from uvgs_bench.sensor.outcome import Outcome, PoseEstimate
from uvgs_bench.units import NS_PER_S, s_from_ns

CSV_COLUMNS = (
    "index", "source", "t_ns", "status", "reason", "beacon", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw",
    "sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_rx_rad", "sigma_ry_rad", "sigma_rz_rad", "rms_px", "margin",
    "blob_count", "flags", "is_active", "held_age_s", "exposure_s", "next_exposure_s",
)  # fmt: skip
_OLDER_COLUMNS = CSV_COLUMNS[: CSV_COLUMNS.index("flags")]
_TUM_HEADER = (
    "# timestamp_s tx_m ty_m tz_m qx qy qz qw (camera_from_beacon; captures without a pose are left out,\n"
    "# a repeated pose stands in a line '# held')\n"
)


@dataclass(frozen=True, slots=True)
class LineNote:
    """What is known about a line besides the outcome.

    Args:
        flags: What a user should know about the pose, besides the flags it has already.
        is_active: Whether this beacon is the one that is believed now.
        switched: Why this beacon became active in this capture; empty when it did not.
        next_exposure_s: Exposure asked for after this capture, s; None when nothing was asked.
        exposure_reason: Why, in one line.
    """

    flags: tuple[str, ...] = ()
    is_active: bool = True
    switched: str = ""
    next_exposure_s: float | None = None
    exposure_reason: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class PoseRecord:
    """One line of a pose file.

    Args:
        index: Number of the capture, or of the line in a TUM file.
        source: Where the capture came from; empty in a TUM file.
        t_ns: Instant of the capture, ns.
        reason: ``stage/reason`` of a miss or of the miss behind a held pose; empty for a pose.
        pose: camera_from_beacon, or None for a miss and for a held pose.
        beacon: Its beacon; empty in a TUM file.
        held_pose: The repeated pose of a held line, or None.
        flags: The flags of the line.
    """

    index: int
    source: str
    t_ns: int
    reason: str
    pose: Pose | None
    beacon: str = ""
    held_pose: Pose | None = None
    flags: tuple[str, ...] = ()


_NO_NOTE = LineNote()


class PoseWriter:
    """Writes one line per capture and beacon, each handed to the system at once: a stopped run keeps its lines.

    Args:
        path: The file.
        force: Whether an existing file may be replaced.

    Raises:
        ConfigError: It exists and may not be replaced.
        UvgsError: It cannot be written.
    """

    header = ""

    def __init__(self, path: Path, *, force: bool = False) -> None:
        _check_free(path, force)
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream: TextIO = path.open("w", encoding="utf-8", newline="")
        except OSError as error:
            raise UvgsError(f"{path}: cannot be written: {error.strerror or error}") from None
        self._put(self.header)

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files it writes."""
        return (self.path,)

    def write(self, capture: Capture, outcome: Outcome | Held, note: LineNote = _NO_NOTE) -> None:
        """Append the outcome of a capture for one beacon. Raises UvgsError when the disk is full."""
        self._put(self.line(capture, outcome, note))

    def line(self, capture: Capture, outcome: Outcome | Held, note: LineNote) -> str:
        """The line with its end, or nothing when the format has no place for it."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the file. Safe to call twice."""
        self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _put(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError as error:
            # Closing tries once more to write what is left, and fails the same way.
            with suppress(OSError):
                self._stream.close()
            raise UvgsError(f"{self.path}: cannot be written: {error.strerror or error}") from None


class CsvPoses(PoseWriter):
    """One line per capture and beacon, misses included."""

    header = ",".join(CSV_COLUMNS) + "\r\n"

    def line(self, capture: Capture, outcome: Outcome | Held, note: LineNote) -> str:
        """A row with the columns ``CSV_COLUMNS``; what a miss or a held pose has no value for is empty."""
        head = [capture.index, capture.source, capture.t_ns]
        flags, age_s = " ".join(_flags(outcome, note)), ""
        if isinstance(outcome, Held):
            miss, pose = outcome.miss, outcome.last.camera_from_beacon
            reason, age_s = f"{miss.stage}/{miss.reason}", repr(s_from_ns(outcome.age_ns))
            where = [*_digits(pose.t_m), *_digits(pose.quaternion_xyzw())]
            row = [*head, "held", reason, miss.beacon, *where, *[""] * 8, miss.blob_count]
        elif isinstance(outcome, PoseEstimate):
            pose = outcome.camera_from_beacon
            row = [
                *head, "ok", "", outcome.beacon,
                *_digits(pose.t_m), *_digits(pose.quaternion_xyzw()),
                *_digits(outcome.position_sigma_m), *_digits(outcome.rotation_sigma_rad),
                repr(outcome.rms_px), repr(outcome.margin), outcome.blob_count,
            ]  # fmt: skip
        else:
            row = [*head, "miss", f"{outcome.stage}/{outcome.reason}", outcome.beacon, *[""] * 15, outcome.blob_count]
        exposures = ["" if value is None else repr(value) for value in (capture.exposure_s, note.next_exposure_s)]
        text = io.StringIO()
        csv.writer(text).writerow([*row, flags, int(note.is_active), age_s, *exposures])
        return text.getvalue()


class TumPoses(PoseWriter):
    """Fresh poses only: stamp in seconds, translation, quaternion with the scalar last. The rest is comments."""

    header = _TUM_HEADER

    def line(self, capture: Capture, outcome: Outcome | Held, note: LineNote) -> str:
        """A line for a pose, a comment for a held one, nothing for a miss; comments for what changed."""
        lines = []
        if note.switched:
            lines.append(f"# active from here on: {note.switched}")
        if isinstance(outcome, Held):
            age_s = repr(s_from_ns(outcome.age_ns))
            lines.append(f"# held {_tum(capture.t_ns, outcome.last.camera_from_beacon)} age_s {age_s}")
        elif isinstance(outcome, PoseEstimate):
            lines.append(_tum(capture.t_ns, outcome.camera_from_beacon))
        if note.next_exposure_s is not None:
            lines.append(f"# next_exposure_s {note.next_exposure_s!r}: {note.exposure_reason}")
        return "".join(f"{line}\n" for line in lines)


class TumPerBeacon(PoseWriter):
    """One TUM file per beacon, ``NAME_BEACON.tum``: poses of two beacons are no trajectory.

    Args:
        path: The file that was asked for; the beacon's name is added to its own.
        beacons: Names of the beacons.
        force: Whether existing files may be replaced.

    Raises:
        ConfigError: One of them exists and may not be replaced.
        UvgsError: One cannot be written.
    """

    def __init__(self, path: Path, beacons: Sequence[str], *, force: bool = False) -> None:
        self.path = path
        paths = {name: path.with_name(f"{path.stem}_{_file_word(name)}{path.suffix}") for name in beacons}
        for file in paths.values():
            _check_free(file, force)
        self._writers = {name: TumPoses(file, force=force) for name, file in paths.items()}

    @property
    def paths(self) -> tuple[Path, ...]:
        """One file per beacon."""
        return tuple(writer.path for writer in self._writers.values())

    def write(self, capture: Capture, outcome: Outcome | Held, note: LineNote = _NO_NOTE) -> None:
        """Append to the file of the outcome's beacon. Raises UvgsError when the disk is full."""
        name = outcome.miss.beacon if isinstance(outcome, Held) else outcome.beacon
        self._writers[name].write(capture, outcome, note)

    def close(self) -> None:
        """Close the files. Safe to call twice."""
        for writer in self._writers.values():
            writer.close()


class JsonLinesPoses(PoseWriter):
    """One JSON object per capture and beacon, with covariance and stage times."""

    def line(self, capture: Capture, outcome: Outcome | Held, note: LineNote) -> str:
        """The object of a pose, of a held pose or of a miss."""
        record: dict[str, object] = {"index": capture.index, "source": capture.source, "t_ns": capture.t_ns}
        told = outcome.miss if isinstance(outcome, Held) else outcome
        if isinstance(told, PoseEstimate):
            record |= {
                "status": "ok",
                "beacon": told.beacon,
                **_pose_record(told.camera_from_beacon),
                "covariance": told.covariance.tolist(),
                "beacon_covariance": _list_or_none(told.beacon_covariance),
                "calibration_covariance": _list_or_none(told.calibration_covariance),
                "rms_px": told.rms_px,
                "margin": told.margin if np.isfinite(told.margin) else None,
                "led_px": [[v if np.isfinite(v) else None for v in row] for row in told.led_px.tolist()],
            }
        else:
            record |= {
                "status": "held" if isinstance(outcome, Held) else "miss",
                "beacon": told.beacon,
                "stage": told.stage,
                "reason": told.reason,
                "detail": told.detail,
            }
        if isinstance(outcome, Held):
            last = outcome.last
            # Nested, so that no reader takes it for a pose of this capture.
            record["held"] = {
                **_pose_record(last.camera_from_beacon),
                "t_ns": last.t_ns,
                "age_s": s_from_ns(outcome.age_ns),
                "covariance": last.covariance.tolist(),
            }
        record |= {"flags": list(_flags(outcome, note)), "is_active": note.is_active}
        if note.switched:
            record["switched"] = note.switched
        record["exposure_s"] = capture.exposure_s
        if note.next_exposure_s is not None:
            record |= {"next_exposure_s": note.next_exposure_s, "exposure_reason": note.exposure_reason}
        record |= {"blob_count": told.blob_count, "stage_s": told.stage_s}
        return json.dumps(record, allow_nan=False) + "\n"


WRITERS: dict[str, Callable[..., PoseWriter]] = {".csv": CsvPoses, ".tum": TumPoses, ".jsonl": JsonLinesPoses}


def open_pose_writer(path: Path, *, force: bool = False, beacons: Sequence[str] = ()) -> PoseWriter:
    """Open the writer the file's ending asks for.

    Args:
        path: ``*.csv``, ``*.tum`` or ``*.jsonl``.
        force: Whether an existing file may be replaced.
        beacons: Names of the beacons; with more than one a TUM file becomes one file per beacon.

    Returns:
        The open writer.

    Raises:
        ConfigError: The ending is unknown, or the file exists and may not be replaced.
        UvgsError: The file cannot be written.
    """
    if path.suffix not in WRITERS:
        raise ConfigError(f"unknown ending '{path.suffix}', expected one of: {', '.join(WRITERS)}", str(path))
    if path.suffix == ".tum" and len(beacons) > 1:
        return TumPerBeacon(path, beacons, force=force)
    return WRITERS[path.suffix](path, force=force)


def read_poses(path: Path) -> list[PoseRecord]:
    """Read a pose file this program wrote, or any TUM file.

    Args:
        path: ``*.csv`` or ``*.tum``.

    Returns:
        One record per line.

    Raises:
        FormatError: It is missing, has another ending, other columns, or a broken line.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"cannot be read: {error}", str(path)) from None
    if path.suffix == ".csv":
        return _read_csv(text, path)
    if path.suffix == ".tum":
        return _read_tum(text, path)
    raise FormatError(f"unknown ending '{path.suffix}', expected .csv or .tum", str(path))


def _read_csv(text: str, path: Path) -> list[PoseRecord]:
    rows = csv.DictReader(io.StringIO(text))
    if tuple(rows.fieldnames or ()) not in (CSV_COLUMNS, _OLDER_COLUMNS):
        raise FormatError(f"expected the columns {','.join(CSV_COLUMNS)}", str(path), 1)
    out = []
    for number, row in enumerate(rows, start=2):
        try:
            pose = None
            if row["status"] in ("ok", "held"):
                q = [float(row[name]) for name in ("qx", "qy", "qz", "qw")]
                t = [float(row[name]) for name in ("x_m", "y_m", "z_m")]
                pose = Pose.from_quaternion(q, t, "camera", "beacon")
            elif row["status"] != "miss":
                raise ValueError(f"status is '{row['status']}', expected ok, miss or held")
            fresh, held = (pose, None) if row["status"] == "ok" else (None, pose)
            flags = tuple((row.get("flags") or "").split())
            head = int(row["index"]), row["source"], int(row["t_ns"]), row["reason"]
            out.append(PoseRecord(*head, fresh, row["beacon"], held, flags))
        except (ValueError, TypeError) as error:
            raise FormatError(str(error), str(path), number) from None
    return out


def _read_tum(text: str, path: Path) -> list[PoseRecord]:
    out: list[PoseRecord] = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        words = line.split()
        if len(words) != 8:
            raise FormatError(f"expected 8 numbers, got {len(words)}", str(path), number)
        try:
            values = [float(word) for word in words[1:]]
            pose = Pose.from_quaternion(values[3:], values[:3], "camera", "beacon")
            seconds, _, fraction = words[0].partition(".")
            t_ns = int(seconds) * NS_PER_S + int((fraction + "0" * 9)[:9])
        except ValueError as error:
            raise FormatError(str(error), str(path), number) from None
        out.append(PoseRecord(len(out), "", t_ns, "", pose))
    return out


def _digits(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> list[str]:
    """Shortest text that reads back to the same number."""
    return [repr(float(v)) for v in values]


def _flags(outcome: Outcome | Held, note: LineNote) -> tuple[str, ...]:
    own = ("held",) if isinstance(outcome, Held) else outcome.flags if isinstance(outcome, PoseEstimate) else ()
    return (*own, *note.flags)


def _pose_record(pose: Pose) -> dict[str, object]:
    return {"t_m": pose.t_m.tolist(), "q_xyzw": pose.quaternion_xyzw().tolist()}


def _list_or_none(values: FloatArray | None) -> object:
    return None if values is None else values.tolist()


def _tum(t_ns: int, pose: Pose) -> str:
    seconds, rest = divmod(t_ns, NS_PER_S)
    return " ".join([f"{seconds}.{rest:09d}", *_digits(pose.t_m), *_digits(pose.quaternion_xyzw())])


def _file_word(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name)


def _check_free(path: Path, force: bool) -> None:
    if path.exists() and not force:
        raise ConfigError("exists already; use --force to replace it", str(path))
