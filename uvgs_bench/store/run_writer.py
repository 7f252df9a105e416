"""Writing a run so that it can be read at any instant and closes properly even on a full disk."""

from __future__ import annotations

import errno
import heapq
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from io import FileIO
from pathlib import Path
from typing import Literal, Self, cast, get_args

from uvgs_bench.errors import RunError, UvgsError
from uvgs_bench.sensor.capture import ImageArray
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.store.documents import write_atomically
from uvgs_bench.store.run_format import line_from_sample, table_from_end, table_from_seam, tables_from_manifest
from uvgs_bench.store.run_types import Ending, Run, RunManifest, Sample, Seam
from uvgs_bench.store.toml_text import toml_text
from uvgs_bench.units import NS_PER_S, ns_from_s

MANIFEST, JOURNAL, WIRE_LOG, CAPTURES, SETUP = "run.toml", "samples.jsonl", "gantry.log", "captures", "setup"
SETUP_CALIBRATION, SETUP_BEACON, SETUP_BENCH = "calibration.yaml", "beacon.toml", "bench.toml"
SETUP_PROCEDURE, SETUP_SENSOR, SETUP_GANTRY = "procedure.toml", "sensor.toml", "gantry.toml"
Keep = Literal["all", "worst", "none"]
KEEPS: tuple[str, ...] = get_args(Keep)

# Freed before the run is closed, so that how it ended can still be written when the disk is full.
_RESERVE, _RESERVE_BYTES = ".reserve", 65536
_WORST_COUNT = 20
_MOST_FLUSHES = 8


def utc_now() -> str:
    """Wall-clock time, ISO 8601, UTC, to the millisecond."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


class RunWriter:
    """The one writer of a run folder. Made by ``create`` or ``reopen``.

    Every failure to write is a ``RunError``; the wire log never raises, since it is called in the middle of a motion:
    its failure is raised by the next ``check`` or ``append``.
    """

    def __init__(self, path: Path, manifest: RunManifest, seams: tuple[Seam, ...], keep: Keep) -> None:
        self.path = path
        self.manifest = manifest
        self.keep = keep
        self.sample_count = 0
        self.clock_offset_ns = 0
        self._seams = seams
        self._attempt: dict[int, int] = {}
        self._worst: list[tuple[float, int, str]] = []
        self._failure: RunError | None = None
        self._is_closed = False
        self._journal: FileIO = self._opened(JOURNAL)
        self._wire: FileIO = self._opened(WIRE_LOG)

    @classmethod
    def create(cls, path: Path, manifest: RunManifest, setup: Mapping[str, bytes]) -> Self:
        """Begin a run in a new folder.

        Args:
            path: The run folder; must not exist.
            manifest: Everything known before the first move.
            setup: Content of each file of ``setup/`` by its name.

        Returns:
            The open writer.

        Raises:
            RunError: The folder exists, or cannot be written.
        """
        keep = _checked_keep(manifest.keep, path)
        try:
            path.mkdir(parents=True)
            (path / CAPTURES).mkdir()
            for name, content in setup.items():
                write_atomically(path / SETUP / name, content)
            (path / _RESERVE).write_bytes(b"\0" * _RESERVE_BYTES)
        except FileExistsError:
            raise RunError("exists already, a run is never overwritten", str(path)) from None
        except OSError as error:
            raise RunError(f"cannot be written: {error.strerror or error}", str(path)) from None
        except UvgsError as error:
            raise RunError(str(error)) from None
        writer = cls(path, manifest, (), keep)
        writer._write_manifest(None)
        return writer

    @classmethod
    def reopen(cls, run: Run, bench_now_ns: int) -> Self:
        """Take up a run that ended early; a torn last line is cut off, its end is struck out.

        Args:
            run: The run as read.
            bench_now_ns: Bench time now, ns. A new bench clock may begin anew; run time goes on by the wall clock and
                never backwards, and ``clock_offset_ns`` says how far they are apart.

        Returns:
            The open writer; samples of a half-done station that are appended now supersede the earlier ones.

        Raises:
            RunError: The run is complete, or cannot be written.
        """
        if run.is_complete:
            raise RunError("is complete, there is nothing to resume", str(run.path))
        _cut_torn_line(run.path / JOURNAL)
        writer = cls(run.path, run.manifest, run.seams, _checked_keep(run.manifest.keep, run.path))
        writer.clock_offset_ns = _run_time_now_ns(run) - bench_now_ns
        committed = run.committed_stations()
        for sample in run.samples:
            writer._attempt[sample.station] = sample.attempt + (sample.station not in committed)
            writer.sample_count = max(writer.sample_count, sample.index + 1)
            if sample.capture_file:
                writer._rank(sample)
        try:
            (run.path / CAPTURES).mkdir(exist_ok=True)
            (run.path / _RESERVE).write_bytes(b"\0" * _RESERVE_BYTES)
        except OSError as error:
            raise writer._failed(error) from None
        return writer

    def begin_again(self, seam: Seam) -> None:
        """Record where the run is taken up; from now on its end is open again.

        Args:
            seam: The seam.

        Raises:
            RunError: It cannot be written.
        """
        self._seams = (*self._seams, seam)
        self._write_manifest(None)

    def keep_changed(self, files: Mapping[str, bytes]) -> None:
        """Keep set-up files that changed, beside the first ones: ``setup/after_seam_N/``.

        Args:
            files: Content of each by its name.

        Raises:
            RunError: They cannot be written.
        """
        folder = self.path / SETUP / f"after_seam_{len(self._seams) + 1}"
        try:
            for name, content in files.items():
                write_atomically(folder / name, content, force=True)
        except UvgsError as error:
            raise RunError(str(error)) from None

    def attempt_of(self, station: int) -> int:
        """Number of the current try at a station."""
        return self._attempt.get(station, 0)

    def append(self, sample: Sample, image: ImageArray | None = None) -> Sample:
        """Put one sample on disk, as ``append_station`` does."""
        return self.append_station([(sample, image)])[0]

    def append_station(self, taken: Sequence[tuple[Sample, ImageArray | None]]) -> list[Sample]:
        """Put the samples of a station on disk: first the pictures that are kept, then all lines with one flush.

        A line that is on disk names a picture that is on disk, also after a power failure; a station counts when all
        its lines are there.

        Args:
            taken: Samples with their pictures, or None; each ``capture_file`` is set here.

        Returns:
            The samples as written.

        Raises:
            RunError: The disk is full or the folder cannot be written.
        """
        self.check()
        written = [sample for sample, _ in taken]
        try:
            with ExitStack() as stack:
                pictures = []
                for i, (sample, image) in enumerate(taken):
                    if image is not None and self.keep != "none":
                        stream, name = self._picture(sample, image)
                        pictures.append(stack.enter_context(stream))
                        written[i] = replace(sample, capture_file=name)
                _flush_together(pictures)
            lines = "".join(line_from_sample(sample) + "\n" for sample in written)
            _write_whole(self._journal, lines.encode("utf-8"))
            os.fsync(self._journal.fileno())
        except OSError as error:
            raise self._failed(error) from None
        for sample in written:
            self.sample_count = max(self.sample_count, sample.index + 1)
            if sample.capture_file and self.keep == "worst":
                self._rank(sample)
        return written

    def wire(self, t_ns: int, direction: str, text: str) -> None:
        """Log one line of the gantry's wire; never raises.

        Args:
            t_ns: Bench time, ns.
            direction: Line out, byte out, line in, or remark.
            text: The line; control characters are written as escapes.
        """
        if self._failure is not None or self._is_closed:
            return
        shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
        try:
            line = f"{t_ns + self.clock_offset_ns} {direction} {shown}\n"
            _write_whole(self._wire, line.encode("utf-8", "replace"))
        except OSError as error:
            self._failed(error)

    def check(self) -> None:
        """Raise what went wrong while writing, if anything did.

        Raises:
            RunError: An earlier write failed.
        """
        if self._failure is not None:
            raise self._failure

    def close(self, ended: Ending, reason: str = "") -> None:
        """End the run: say how in ``run.toml`` and close the files. Safe to call twice; the first call counts.

        Args:
            ended: How it ended.
            reason: Why, in one line.

        Raises:
            RunError: Even the reserved space did not suffice; the run then reads as one that was never closed.
        """
        if self._is_closed:
            return
        self._is_closed = True
        (self.path / _RESERVE).unlink(missing_ok=True)
        for stream in (self._journal, self._wire):
            try:
                stream.close()
            except OSError as error:
                self._failed(error)
        self._write_manifest(table_from_end(ended, reason, utc_now(), self.sample_count))

    def _opened(self, name: str) -> FileIO:
        try:
            # Unbuffered: nothing is left in this program that a crash could lose or a later flush could fail on.
            return FileIO(self.path / name, "ab")
        except OSError as error:
            raise RunError(f"cannot be written: {error.strerror or error}", str(self.path / name)) from None

    def _failed(self, error: OSError) -> RunError:
        what = "the disk is full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "cannot be written"
        if self._failure is None:
            self._failure = RunError(f"{what}: {error.strerror or error}", str(self.path))
        return self._failure

    def _write_manifest(self, end: dict[str, object] | None) -> None:
        tables = tables_from_manifest(self.manifest)
        if self._seams:
            tables["seams"] = [table_from_seam(seam) for seam in self._seams]
        if end is not None:
            tables["end"] = end
        try:
            write_atomically(self.path / MANIFEST, toml_text(tables))
        except UvgsError as error:
            raise RunError(str(error)) from None

    def _picture(self, sample: Sample, image: ImageArray) -> tuple[FileIO, str]:
        """A written picture that is not flushed yet, and its name."""
        import cv2

        # Dark pictures with noise have no repeats and no slopes: plain Huffman codes make the smallest file, soonest.
        settings = [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY]
        if hasattr(cv2, "IMWRITE_PNG_FILTER"):
            settings += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]
        ok, encoded = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1, *settings])
        assert ok
        name = f"{CAPTURES}/{sample.index:06d}.png"
        stream = FileIO(self.path / name, "wb")
        try:
            _write_whole(stream, encoded.tobytes())
        except BaseException:
            stream.close()
            raise
        return stream, name

    def _rank(self, sample: Sample) -> None:
        """Keep the pictures of all misses and of the worst poses only."""
        if self.keep != "worst" or not isinstance(sample.outcome, PoseEstimate):
            return
        heapq.heappush(self._worst, (sample.outcome.rms_px, -sample.index, sample.capture_file))
        if len(self._worst) > _WORST_COUNT:
            _, _, name = heapq.heappop(self._worst)
            (self.path / name).unlink(missing_ok=True)


def _flush_together(streams: Sequence[FileIO]) -> None:
    """Flush files to disk; together they share the disk's commits."""
    if len(streams) < 2:
        for stream in streams:
            os.fsync(stream.fileno())
        return
    with ThreadPoolExecutor(max_workers=min(len(streams), _MOST_FLUSHES)) as pool:
        for done in [pool.submit(os.fsync, stream.fileno()) for stream in streams]:
            done.result()


def _write_whole(stream: FileIO, content: bytes) -> None:
    """Write everything; a nearly full disk takes a part without complaint and complains about the rest."""
    view = memoryview(content)
    while view:
        view = view[stream.write(view) :]


def _checked_keep(keep: str, path: Path) -> Keep:
    if keep not in KEEPS:
        raise RunError(f"keep is {keep!r}, expected one of {', '.join(KEEPS)}", str(path))
    return cast(Keep, keep)


def _cut_torn_line(journal: Path) -> None:
    try:
        content = journal.read_bytes()
        whole = content.rfind(b"\n") + 1
        if whole < len(content):
            os.truncate(journal, whole)
    except FileNotFoundError:
        return
    except OSError as error:
        raise RunError(f"cannot be written: {error.strerror or error}", str(journal)) from None


def _run_time_now_ns(run: Run) -> int:
    begun, started_ns = datetime.fromisoformat(run.manifest.created_utc), run.manifest.started_t_ns
    elapsed_s = (datetime.now(UTC) - begun).total_seconds()
    last_ns = max((sample.t_ns for sample in run.samples), default=started_ns)
    return max(started_ns + ns_from_s(elapsed_s), last_ns + NS_PER_S)
