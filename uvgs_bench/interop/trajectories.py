"""Pose files: CSV with every capture, TUM with poses only, JSON lines with covariance. The file's ending chooses.

To add a format: write a class with ``write`` and ``close``, and one line in ``WRITERS``.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self, TextIO

import numpy as np

from uvgs_bench.errors import ConfigError, FormatError, UvgsError
from uvgs_bench.geometry import Pose
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.outcome import Outcome, PoseEstimate
from uvgs_bench.units import NS_PER_S

CSV_COLUMNS = (
    "index", "source", "t_ns", "status", "reason", "beacon", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw",
    "sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_rx_rad", "sigma_ry_rad", "sigma_rz_rad", "rms_px", "margin",
    "blob_count",
)  # fmt: skip
_TUM_HEADER = "# timestamp_s tx_m ty_m tz_m qx qy qz qw (camera_from_beacon; captures without a pose are left out)\n"


@dataclass(frozen=True, slots=True, eq=False)
class PoseRecord:
    """One line of a pose file.

    Args:
        index: Number of the capture, or of the line in a TUM file.
        source: Where the capture came from; empty in a TUM file.
        t_ns: Instant, ns.
        reason: ``stage/reason`` of a miss; empty for a pose.
        pose: camera_from_beacon, or None for a miss.
    """

    index: int
    source: str
    t_ns: int
    reason: str
    pose: Pose | None


class PoseWriter:
    """Writes one line per capture, each handed to the operating system at once: a stopped run keeps its lines.

    Args:
        path: The file.
        force: Whether an existing file may be replaced.

    Raises:
        ConfigError: It exists and may not be replaced.
        UvgsError: It cannot be written.
    """

    header = ""

    def __init__(self, path: Path, *, force: bool = False) -> None:
        if path.exists() and not force:
            raise ConfigError("exists already; use --force to replace it", str(path))
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream: TextIO = path.open("w", encoding="utf-8", newline="")
        except OSError as error:
            raise UvgsError(f"{path}: cannot be written: {error.strerror or error}") from None
        self._put(self.header)

    def write(self, capture: Capture, outcome: Outcome) -> None:
        """Append a capture's outcome. Raises UvgsError when the disk is full."""
        self._put(self.line(capture, outcome))

    def line(self, capture: Capture, outcome: Outcome) -> str:
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
    """One line per capture, misses included."""

    header = ",".join(CSV_COLUMNS) + "\r\n"

    def line(self, capture: Capture, outcome: Outcome) -> str:
        """A row with the columns ``CSV_COLUMNS``; the pose columns of a miss are empty."""
        head = [capture.index, capture.source, capture.t_ns]
        if isinstance(outcome, PoseEstimate):
            pose = outcome.camera_from_beacon
            row = [
                *head, "ok", "", outcome.beacon,
                *_digits(pose.t_m), *_digits(pose.quaternion_xyzw()),
                *_digits(outcome.position_sigma_m), *_digits(outcome.rotation_sigma_rad),
                repr(outcome.rms_px), repr(outcome.margin), outcome.blob_count,
            ]  # fmt: skip
        else:
            row = [*head, "miss", f"{outcome.stage}/{outcome.reason}", outcome.beacon, *[""] * 15, outcome.blob_count]
        text = io.StringIO()
        csv.writer(text).writerow(row)
        return text.getvalue()


class TumPoses(PoseWriter):
    """Poses only: stamp in seconds, translation, quaternion with the scalar last."""

    header = _TUM_HEADER

    def line(self, capture: Capture, outcome: Outcome) -> str:
        """A line for a pose, nothing for a miss."""
        if not isinstance(outcome, PoseEstimate):
            return ""
        pose = outcome.camera_from_beacon
        seconds, rest = divmod(capture.t_ns, NS_PER_S)
        return " ".join([f"{seconds}.{rest:09d}", *_digits(pose.t_m), *_digits(pose.quaternion_xyzw())]) + "\n"


class JsonLinesPoses(PoseWriter):
    """One JSON object per capture, with covariance and stage times."""

    def line(self, capture: Capture, outcome: Outcome) -> str:
        """The object of a pose or of a miss."""
        record: dict[str, object] = {"index": capture.index, "source": capture.source, "t_ns": capture.t_ns}
        if isinstance(outcome, PoseEstimate):
            pose = outcome.camera_from_beacon
            record |= {
                "status": "ok",
                "beacon": outcome.beacon,
                "t_m": pose.t_m.tolist(),
                "q_xyzw": pose.quaternion_xyzw().tolist(),
                "covariance": outcome.covariance.tolist(),
                "rms_px": outcome.rms_px,
                "margin": outcome.margin if np.isfinite(outcome.margin) else None,
                "led_px": [[v if np.isfinite(v) else None for v in row] for row in outcome.led_px.tolist()],
            }
        else:
            record |= {
                "status": "miss",
                "beacon": outcome.beacon,
                "stage": outcome.stage,
                "reason": outcome.reason,
                "detail": outcome.detail,
            }
        record |= {"blob_count": outcome.blob_count, "stage_s": outcome.stage_s}
        return json.dumps(record, allow_nan=False) + "\n"


WRITERS: dict[str, Callable[..., PoseWriter]] = {".csv": CsvPoses, ".tum": TumPoses, ".jsonl": JsonLinesPoses}


def open_pose_writer(path: Path, *, force: bool = False) -> PoseWriter:
    """Open the writer the file's ending asks for.

    Args:
        path: ``*.csv``, ``*.tum`` or ``*.jsonl``.
        force: Whether an existing file may be replaced.

    Returns:
        The open writer.

    Raises:
        ConfigError: The ending is unknown, or the file exists and may not be replaced.
        UvgsError: The file cannot be written.
    """
    if path.suffix not in WRITERS:
        raise ConfigError(f"unknown ending '{path.suffix}', expected one of: {', '.join(WRITERS)}", str(path))
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
    if tuple(rows.fieldnames or ()) != CSV_COLUMNS:
        raise FormatError(f"expected the columns {','.join(CSV_COLUMNS)}", str(path), 1)
    out = []
    for number, row in enumerate(rows, start=2):
        try:
            pose = None
            if row["status"] == "ok":
                q = [float(row[name]) for name in ("qx", "qy", "qz", "qw")]
                t = [float(row[name]) for name in ("x_m", "y_m", "z_m")]
                pose = Pose.from_quaternion(q, t, "camera", "beacon")
            elif row["status"] != "miss":
                raise ValueError(f"status is '{row['status']}', expected ok or miss")
            out.append(PoseRecord(int(row["index"]), row["source"], int(row["t_ns"]), row["reason"], pose))
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
