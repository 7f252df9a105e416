"""Keep everything of a stream in one MCAP file: pictures without loss, what they were solved with, and the answers.

| topic | what |
|---|---|
| ``/uvgs/setup`` | once, first: calibration, beacons, parameters, rules, versions (``record_setup``), JSON |
| ``/uvgs/image_raw`` | every picture the source gave, every bit of it |
| ``/uvgs/record/capture`` | before each picture: its number, source, exposure, mosaic and full scale, JSON |
| ``/uvgs/record/answer`` | after each answer: what came from outside meanwhile (flags, commands, exposures), JSON |
| the topics of ``interop.bag_writer`` | poses, transforms, diagnostics, camera_info |

``sessions.replay`` reads it back. The file is written in a thread. When it falls behind, what comes is no longer
compressed; a disk that is slower than the camera even so holds up the stream, so that a live source drops its oldest
captures and counts them, and no picture that was solved is missing.
"""

from __future__ import annotations

import json
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Literal

from uvgs_bench.devices.cameras.source import ExposureControl
from uvgs_bench.errors import UvgsError
from uvgs_bench.interop.bag_writer import IMAGE_TOPIC, BagContents, BagPoses, NewBag
from uvgs_bench.interop.ros_messages import message_fields_from_image
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sessions.record_setup import RecordSetup, setup_text
from uvgs_bench.sessions.stream import Answered

SETUP_TOPIC = "/uvgs/setup"
CAPTURE_TOPIC = "/uvgs/record/capture"
ANSWER_TOPIC = "/uvgs/record/answer"
# So much may wait for the disk: some seconds of a fast camera.
_WAITING_BYTES = 128 << 20
_HURRY_BYTES = _WAITING_BYTES // 8


class Recorder:
    """A record that is being written; an outlet that also listens to what goes into the stream.

    Call ``captures``, ``command``, ``flags`` and ``exposure`` around what the stream is given, then ``begin`` once.

    Args:
        path: ``*.mcap``.
        compression: Of the file.
        force: Whether an existing file may be replaced.

    Raises:
        ConfigError: The ending is another, or the file exists and may not be replaced.
        UvgsError: It cannot be written.
    """

    def __init__(self, path: Path, *, compression: Literal["none", "zstd"] = "zstd", force: bool = False) -> None:
        self.path = path
        self._bag = NewBag(path, compression=compression, force=force, endings=(".mcap",))
        self._poses: BagPoses | None = None
        self._setup = ""
        self._waiting: deque[tuple[Callable[[], None], int]] = deque()
        self._waiting_bytes = 0
        self._changed = threading.Condition()
        self._failure: UvgsError | None = None
        self._is_closing = False
        self._last_ns = 0
        self._heard: dict[str, object] = {}
        self._exposures_s: list[float] = []
        self._thread = threading.Thread(target=self._write, name="record", daemon=True)

    @property
    def paths(self) -> tuple[Path, ...]:
        """The record."""
        return (self.path,)

    def begin(self, setup: RecordSetup) -> None:
        """Say what the stream is solved with; before its first capture."""
        self._setup = setup_text(setup)
        self._exposures_s.clear()
        lens = setup.calibration.lens
        self._poses = BagPoses(self._bag, BagContents(lens, {beacon.name: beacon for beacon in setup.beacons}))
        self._thread.start()

    def captures(self, source: Iterable[Capture]) -> Iterator[Capture]:
        """The same captures, each kept before it is handed on."""
        for capture in source:
            self._enqueue(partial(self._write_capture, capture), capture.image.nbytes)
            yield capture

    def command(self, command: Callable[[], str | None]) -> Callable[[], str | None]:
        """The same commands, kept."""

        def listened() -> str | None:
            name = command()
            self._heard["command"] = name
            return name

        return listened

    def flags(self, flags_of: Callable[[Capture], tuple[str, ...]]) -> Callable[[Capture], tuple[str, ...]]:
        """The same flags, kept."""

        def listened(capture: Capture) -> tuple[str, ...]:
            flags = flags_of(capture)
            self._heard["flags"] = list(flags)
            return flags

        return listened

    def exposure(self, control: ExposureControl) -> ExposureControl:
        """The same control, its answers kept."""
        return _ListenedExposure(control, self._exposures_s)

    def put(self, answered: Answered) -> None:
        """Keep an answer.

        Raises:
            UvgsError: The disk is full; the record ends before.
        """
        if self._failure is not None:
            raise self._failure
        heard, self._heard = dict(self._heard), {}
        heard["exposures_s"], self._exposures_s[:] = list(self._exposures_s), []
        self._enqueue(partial(self._write_answer, answered, heard), 0)

    def close(self) -> None:
        """Write what waits and end the file. Safe to call twice. Raises UvgsError when the disk is full."""
        with self._changed:
            self._is_closing = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join()
        failure, self._failure = self._failure, None
        self._bag.close()
        if failure is not None:
            raise failure

    def _enqueue(self, work: Callable[[], None], size: int) -> None:
        with self._changed:
            while self._waiting_bytes > _WAITING_BYTES and self._thread.is_alive() and self._failure is None:
                self._changed.wait(0.2)
            if self._failure is None and not self._is_closing:
                self._waiting.append((work, size))
                self._waiting_bytes += size
                self._changed.notify_all()

    def _write(self) -> None:
        while True:
            with self._changed:
                while not self._waiting and not self._is_closing:
                    self._changed.wait()
                if not self._waiting:
                    return
                work, size = self._waiting.popleft()
                is_hurried = self._waiting_bytes > _HURRY_BYTES
            try:
                self._bag.hurry(is_hurried)
                work()
            except UvgsError as error:
                self._failure = error
            except Exception as error:
                # Said in the stream's thread; an exception here would end the record without a word.
                self._failure = UvgsError(f"{self.path}: cannot be written: {type(error).__name__}: {error}")
            with self._changed:
                self._waiting_bytes -= size
                if self._failure is not None:
                    self._waiting.clear()
                    self._changed.notify_all()
                    return
                self._changed.notify_all()

    def _write_capture(self, capture: Capture) -> None:
        bag, t_ns = self._bag, capture.t_ns
        # Readers sort by this; a clock that was set back must not change the order.
        at_ns = self._last_ns = max(self._last_ns, t_ns)
        if self._setup:
            bag.write(SETUP_TOPIC, at_ns, bag.make.text(self._setup))
            # In a chunk of its own, so that a damaged picture does not take it along.
            bag.flush()
            self._setup = ""
        said = {
            "index": capture.index,
            "source": capture.source,
            "exposure_s": capture.exposure_s,
            "bayer": capture.bayer,
            "full_scale_dn": capture.full_scale_dn,
        }
        bag.write(CAPTURE_TOPIC, at_ns, bag.make.text(json.dumps(said)))
        bag.write(IMAGE_TOPIC, at_ns, bag.make.image(t_ns, message_fields_from_image(capture.image)))

    def _write_answer(self, answered: Answered, heard: dict[str, object]) -> None:
        assert self._poses is not None
        bag, capture = self._bag, answered.capture
        said = {"index": capture.index, **heard}
        bag.write(ANSWER_TOPIC, self._last_ns, bag.make.text(json.dumps(said)))
        for outcome, note in answered.lines.values():
            self._poses.write(capture, outcome, note)


class _ListenedExposure:
    """An exposure control whose answers are written down."""

    def __init__(self, control: ExposureControl, answers_s: list[float]) -> None:
        self._control = control
        self._answers_s = answers_s

    @property
    def exposure_s(self) -> float:
        return self._control.exposure_s

    @property
    def exposure_limits_s(self) -> tuple[float, float]:
        return self._control.exposure_limits_s

    @property
    def full_scale_dn(self) -> float:
        return self._control.full_scale_dn

    @property
    def settling_captures(self) -> int:
        return self._control.settling_captures

    def set_exposure_s(self, exposure_s: float) -> float:
        taken_s = self._control.set_exposure_s(exposure_s)
        self._answers_s.append(taken_s)
        return taken_s
