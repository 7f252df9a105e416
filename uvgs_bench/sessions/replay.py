"""Solve a record again: the same pictures, setup, rules, flags, commands and exposures give the same poses."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from uvgs_bench.errors import CaptureError, FormatError
from uvgs_bench.interop.bag_writer import IMAGE_TOPIC
from uvgs_bench.interop.bags import Bags, open_bags
from uvgs_bench.interop.ros_messages import image_from_message
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sessions.record_setup import RecordedCamera, RecordSetup, setup_from_text
from uvgs_bench.sessions.recording import ANSWER_TOPIC, CAPTURE_TOPIC, SETUP_TOPIC
from uvgs_bench.units import NS_PER_S


class Recording:
    """A record that is read again.

    Args:
        path: The record.
        bags: It, open.

    Raises:
        FormatError: Its setup cannot be read.
    """

    def __init__(self, path: Path, bags: Bags) -> None:
        self.path = path
        self._bags = bags
        first = next(iter(bags.messages((SETUP_TOPIC,))), None)
        if first is None:
            raise FormatError(f"holds no message of {SETUP_TOPIC}, expected a file of --record", str(path))
        self.setup: RecordSetup = setup_from_text(first.decode().data, str(path))
        self._flags: dict[int, tuple[str, ...]] = {}
        self._commands: deque[str | None] = deque()
        self._exposures_s: deque[float] = deque()

    @property
    def total(self) -> int:
        """Number of pictures."""
        return self._bags.counts.get(IMAGE_TOPIC, 0)

    @property
    def answered(self) -> int | None:
        """How many captures were answered: one more may have been taken before the end. None when nothing says so."""
        return self._bags.counts.get(ANSWER_TOPIC) or None

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is wrong with the file, as far as it was read."""
        return self._bags.remarks

    def captures(self) -> Iterator[Capture]:
        """The pictures with everything that was known of them.

        Yields:
            Captures; what came from outside while one was solved is known when it is handed out.

        Raises:
            CaptureError: A picture is broken, or nothing is said about it.
        """
        waiting: Capture | None = None
        said: dict[str, Any] | None = None
        for message in self._bags.messages((CAPTURE_TOPIC, IMAGE_TOPIC, ANSWER_TOPIC)):
            topic, content = message.channel.topic, message.decode()
            if topic == CAPTURE_TOPIC:
                said = json.loads(content.data)
            elif topic == ANSWER_TOPIC:
                self._hear(json.loads(content.data))
            else:
                if said is None:
                    raise CaptureError("a picture without a word about it", str(self.path))
                # Handed out one later, so that what was heard meanwhile has been read.
                if waiting is not None:
                    yield waiting
                waiting, said = _capture(content, said, str(self.path)), None
        if waiting is not None:
            yield waiting

    def flags_of(self, capture: Capture) -> tuple[str, ...]:
        """What the source said about a capture."""
        return self._flags.pop(capture.index, ())

    def command(self) -> str | None:
        """The command that came before this capture was answered."""
        return self._commands.popleft() if self._commands else None

    def exposure(self, camera: RecordedCamera) -> RecordedExposure:
        """A camera that answers as the recorded one did."""
        return RecordedExposure(camera, self._exposures_s)

    def close(self) -> None:
        """Release the file. Safe to call twice."""
        self._bags.close()

    def _hear(self, heard: dict[str, Any]) -> None:
        if heard.get("flags"):
            self._flags[heard["index"]] = tuple(heard["flags"])
        self._commands.append(heard.get("command"))
        self._exposures_s.extend(heard.get("exposures_s", ()))


class RecordedExposure:
    """An exposure control that says what the recorded camera said.

    Args:
        camera: What it said of itself.
        answers_s: Its answers to come, s.
    """

    def __init__(self, camera: RecordedCamera, answers_s: deque[float]) -> None:
        self._camera = camera
        self._answers_s = answers_s
        self._exposure_s = camera.exposure_s
        self._is_begun = False

    @property
    def exposure_s(self) -> float:
        """The exposure, s."""
        return self._exposure_s

    @property
    def exposure_limits_s(self) -> tuple[float, float]:
        """Shortest and longest exposure, s."""
        return self._camera.exposure_limits_s

    @property
    def full_scale_dn(self) -> float:
        """Largest value of a pixel, DN."""
        return self._camera.full_scale_dn

    @property
    def settling_captures(self) -> int:
        """Captures that may still have the old exposure."""
        return self._camera.settling_captures

    def set_exposure_s(self, exposure_s: float) -> float:
        """The recorded answer; the first call is the one by which the loop takes the camera over."""
        if self._is_begun:
            self._exposure_s = self._answers_s.popleft() if self._answers_s else exposure_s
        self._is_begun = True
        return self._exposure_s


def find_recording(path: Path) -> Recording | None:
    """Open a record if a file is one.

    Args:
        path: Any path.

    Returns:
        The record, to be closed; None for a file that is something else or cannot be read at all.

    Raises:
        FormatError: It is a record whose setup cannot be read.
    """
    if path.suffix != ".mcap" or not path.is_file():
        return None
    try:
        bags = open_bags([path])
    except FormatError:
        return None
    try:
        found = Recording(path, bags) if SETUP_TOPIC in bags.counts else None
    except BaseException:
        bags.close()
        raise
    if found is None:
        bags.close()
    return found


def _capture(message: Any, said: dict[str, Any], path: str) -> Capture:
    stamp = message.header.stamp
    try:
        found = image_from_message(
            message.encoding, message.width, message.height, message.step, message.is_bigendian, message.data, path
        )
        return Capture(
            found.image,
            int(stamp.sec) * NS_PER_S + int(stamp.nanosec),
            said["source"],
            said["index"],
            said["exposure_s"],
            said["bayer"],
            said["full_scale_dn"],
        )
    except (FormatError, KeyError, ValueError) as error:
        raise CaptureError(f"a picture of the record cannot be read: {error}", path) from None
