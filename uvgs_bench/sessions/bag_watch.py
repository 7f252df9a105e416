"""Watchers of one topic of a bag each: of its pictures, lens or landmarks; what they find is a line each."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from uvgs_bench.errors import FormatError
from uvgs_bench.interop import astrobee
from uvgs_bench.interop.ros_messages import (
    calibration_from_message,
    image_from_compressed,
    image_from_message,
)
from uvgs_bench.sessions.bag_stamps import Finding
from uvgs_bench.sessions.stream_health import is_black, is_overexposed
from uvgs_bench.units import NS_PER_S

if TYPE_CHECKING:
    from uvgs_bench.camera.calibration import Calibration

# Pictures that are looked at closely, evenly over the topic.
_MOST_LOOKED = 1000
# Decoding compressed pictures costs ten times as much.
_MOST_DECODED = 200
# A share of useless pictures that is more than the ends of a recording.
_USELESS_SHARE = 0.2


@dataclass(frozen=True, slots=True)
class PictureSummary:
    """What the pictures of a topic are.

    Args:
        encodings: Messages by encoding or format.
        sizes: Messages by size, ``WxH``; of compressed pictures those that were decoded.
        looked: How many were looked at closely, evenly over the topic.
        torn: How many of these cannot be read.
        black: How many of these are black.
        overexposed: How many of these are overexposed.
    """

    encodings: dict[str, int]
    sizes: dict[str, int]
    looked: int
    torn: int
    black: int
    overexposed: int


class PictureWatch:
    """Looks at the pictures of a topic.

    Args:
        topic: Its name.
        count: Messages of it.
        is_compressed: Whether they are compressed.
        calibration: What their size is compared with, or None.
    """

    def __init__(self, topic: str, count: int, *, is_compressed: bool, calibration: Calibration | None) -> None:
        self._topic = topic
        self._is_compressed = is_compressed
        self._calibration = calibration
        self._every = max(1, count // (_MOST_DECODED if is_compressed else _MOST_LOOKED))
        self._encodings: Counter[str] = Counter()
        self._sizes: Counter[str] = Counter()
        self._count = self._looked = self._torn = self._black = self._bright = 0
        self._first_torn = ""

    def see(self, fields: Any) -> None:
        """Take a message."""
        self._encodings[str(fields.format if self._is_compressed else fields.encoding)] += 1
        is_looked_at = self._count % self._every == 0
        self._count += 1
        if not self._is_compressed:
            self._sizes[f"{fields.width}x{fields.height}"] += 1
        if not is_looked_at:
            return
        self._looked += 1
        name = f"{self._topic}#{self._count - 1}"
        try:
            if self._is_compressed:
                image = image_from_compressed(str(fields.format), fields.data, name).image
                self._sizes[f"{image.shape[1]}x{image.shape[0]}"] += 1
            else:
                size = int(fields.width), int(fields.height), int(fields.step)
                image = image_from_message(str(fields.encoding), *size, fields.is_bigendian, fields.data, name).image
        except FormatError as error:
            self._torn += 1
            self._first_torn = self._first_torn or str(error)
            return
        full_dn = float(np.iinfo(image.dtype).max)
        self._black += is_black(image, full_dn)
        self._bright += is_overexposed(image, full_dn)

    def summary(self) -> PictureSummary:
        """The figures."""
        return PictureSummary(
            dict(self._encodings), dict(self._sizes), self._looked, self._torn, self._black, self._bright
        )

    def findings(self, carried: Calibration | None) -> list[Finding]:
        """What is wrong with them, given the lens the bag carries for them, or None."""
        found: list[Finding] = []

        def add(level: Literal["problem", "warning"], text: str) -> None:
            found.append(Finding(level, self._topic, text))

        for what, seen in (("encodings", self._encodings), ("sizes", self._sizes)):
            if len(seen) > 1:
                named = ", ".join(f"{count} of {name}" for name, count in seen.most_common(4))
                add("problem" if what == "sizes" else "warning", f"several {what}: {named}")
        if self._torn:
            add("problem", f"{self._torn} of {self._looked} pictures looked at cannot be read: {self._first_torn}")
        for lens, name in ((self._calibration, "the calibration given"), (carried, "its CameraInfo")):
            size = "" if lens is None else f"{lens.lens.width_px}x{lens.lens.height_px}"
            if size and self._sizes and size not in self._sizes:
                add("problem", f"pictures of {self._sizes.most_common(1)[0][0]} px, but {name} is for {size} px")
        readable = self._looked - self._torn
        for count, word in ((self._black, "black"), (self._bright, "overexposed")):
            if count:
                share = count / readable
                level: Literal["problem", "warning"] = "problem" if share > _USELESS_SHARE else "warning"
                add(level, f"{count} of {readable} pictures looked at are {word} ({100.0 * share:.0f} %)")
        return found


class LensWatch:
    """Looks whether a ``CameraInfo`` is a lens, and stays one.

    Args:
        topic: Its name.
    """

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._first: Calibration | None = None
        self._count = self._changed_at = 0
        self._complaint = ""

    def see(self, fields: Any, *, is_rectified: bool) -> None:
        """Take a message."""
        self._count += 1
        try:
            found = calibration_from_message(fields, self._topic, is_rectified=is_rectified)
        except FormatError as error:
            self._complaint = self._complaint or str(error).removeprefix(f"{self._topic}: ")
            return
        if self._first is None:
            self._first = found
        elif not self._changed_at and not _same_lens(self._first, found):
            self._changed_at = self._count

    @property
    def calibration(self) -> Calibration | None:
        """The first lens it says; None when it says none."""
        return self._first

    def findings(self) -> list[Finding]:
        """What is wrong with it."""
        found = []
        if self._complaint:
            found.append(Finding("problem", self._topic, self._complaint))
        if self._changed_at:
            found.append(Finding("problem", self._topic, f"the lens changes at message {self._changed_at - 1}"))
        return found


def _same_lens(a: Calibration, b: Calibration) -> bool:
    sizes = (a.lens.width_px, a.lens.height_px) == (b.lens.width_px, b.lens.height_px)
    return sizes and a.lens.model == b.lens.model and np.array_equal(a.lens.parameters, b.lens.parameters)


class LandmarkWatch:
    """Asks of every landmark message for Astrobee whether its localizer would use it.

    Args:
        topic: Its name.
        settings: The localizer's.
        calibration: The camera's, to put the landmarks where the message's pose puts them; or None.
    """

    def __init__(self, topic: str, settings: astrobee.LocalizerSettings, calibration: Calibration | None) -> None:
        self._topic = topic
        self._settings = settings
        self._calibration = calibration
        self._reasons: Counter[str] = Counter()
        self._frames: Counter[str] = Counter()
        self._registered_ns: set[int] = set()
        self._count = self._unregistered = self._far = self._strange_camera = 0

    def register(self, fields: Any) -> None:
        """Take a message of registration."""
        self._registered_ns.add(int(fields.header.stamp.sec) * NS_PER_S + int(fields.header.stamp.nanosec))

    def see(self, fields: Any) -> None:
        """Take a message of landmarks."""
        message = astrobee.landmarks_from_message(fields)
        self._count += 1
        self._frames[message.frame_id] += 1
        self._strange_camera += message.camera_id != 0
        self._unregistered += message.t_ns not in self._registered_ns
        reason = astrobee.why_dropped(message, self._settings)
        if reason is not None:
            self._reasons[reason] += 1
        if self._calibration is not None:
            lens = self._calibration.lens
            errors_px = astrobee.landmark_errors_px(message, lens.fx_px, lens.fy_px)
            self._far += bool((errors_px > self._settings.max_error_px).any())

    @property
    def count(self) -> int:
        """Messages seen."""
        return self._count

    @property
    def dropped(self) -> dict[str, int]:
        """Messages that would be dropped, by reason."""
        return dict(self._reasons.most_common())

    def findings(self) -> list[Finding]:
        """What is wrong with them."""
        found = [
            Finding("problem", self._topic, f"Astrobee drops {count} of {self._count} messages: {reason}")
            for reason, count in self._reasons.most_common()
        ]
        if self._unregistered:
            text = f"{self._unregistered} messages without a registration of the same stamp before them"
            found.append(Finding("warning", self._topic, text))
        for frame, count in self._frames.items():
            if frame != astrobee.FRAME_ID:
                text = f"{count} messages in frame '{frame}', Astrobee's own have '{astrobee.FRAME_ID}'"
                found.append(Finding("warning", self._topic, text))
        if self._strange_camera:
            found.append(
                Finding("warning", self._topic, f"{self._strange_camera} messages of a camera_id other than 0")
            )
        if self._far:
            text = (
                f"{self._far} messages with landmarks more than {self._settings.max_error_px:g} px from where their "
                "own pose puts them: raw pixels, a pose not inverted, or another camera"
            )
            found.append(Finding("problem", self._topic, text))
        return found
