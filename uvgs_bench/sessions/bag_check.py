"""Is a bag healthy: stamps, gaps, drops, clocks, pictures, lenses, landmarks for Astrobee; each finding in a line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from uvgs_bench.errors import FormatError
from uvgs_bench.interop import astrobee
from uvgs_bench.interop.bag_topics import (
    CAMERA_INFO,
    COMPRESSED,
    camera_info_topic,
    choose_image_topic,
    image_topics,
    is_rectified,
)
from uvgs_bench.interop.bags import open_bags
from uvgs_bench.sessions.bag_stamps import Finding, StampSummary, StampWatch
from uvgs_bench.sessions.bag_watch import LandmarkWatch, LensWatch, PictureSummary, PictureWatch
from uvgs_bench.sessions.events import EventSink, StageAdvanced, StageFinished, StageStarted
from uvgs_bench.sessions.interruption import check_interruption

if TYPE_CHECKING:
    from uvgs_bench.camera.calibration import Calibration
    from uvgs_bench.interop.bag_file import BagMessage
    from uvgs_bench.interop.bags import Bags

STAGE = "check"
_TELL_EVERY = 50


@dataclass(frozen=True, slots=True)
class BagHealth:
    """What a check found.

    Args:
        messages: Messages read.
        stamps: How the stamps of each topic with headers run.
        pictures: What the pictures of each topic are.
        landmarks: Landmark messages Astrobee would drop, by topic and reason; an empty mapping where it uses all.
        findings: What is not as it should be, problems first.
    """

    messages: int
    stamps: dict[str, StampSummary]
    pictures: dict[str, PictureSummary]
    landmarks: dict[str, dict[str, int]]
    findings: tuple[Finding, ...]

    @property
    def verdict(self) -> Literal["healthy", "not_healthy", "inconclusive"]:
        """Whether there is a problem; warnings may be there. Inconclusive when no message carries a stamp."""
        if any(finding.level == "problem" for finding in self.findings):
            return "not_healthy"
        return "healthy" if self.stamps else "inconclusive"


def check_bags(
    paths: Sequence[Path | str],
    sink: EventSink,
    *,
    topic: str = "",
    calibration: Calibration | None = None,
    settings: astrobee.LocalizerSettings | None = None,
) -> BagHealth:
    """Read bags from end to end and judge them.

    Args:
        paths: Files or folders.
        sink: Told about progress.
        topic: Pictures to look at; all when empty.
        calibration: What the pictures' size and the landmarks are compared with, or None.
        settings: Of Astrobee's localizer, as shipped when None.

    Returns:
        What was found.

    Raises:
        FormatError: A bag is missing, is none, or has nothing that can be read.
        ConfigError: The topic is none of pictures.
    """
    with open_bags(paths) as bags:
        shown = ", ".join(str(path) for path in paths)
        pictures = image_topics(bags.types, bags.counts)
        if topic:
            pictures = (choose_image_topic(bags.types, bags.counts, topic, shown),)
        watch = _Watches(bags, pictures, calibration, settings or astrobee.LocalizerSettings())
        total = sum(bags.counts.values())
        sink(StageStarted(STAGE, total))
        count = 0
        for message in bags.messages():
            check_interruption()
            watch.see(message)
            count += 1
            if count % _TELL_EVERY == 0:
                sink(StageAdvanced(STAGE, count, message.channel.topic))
        found = watch.findings()
        found = [Finding("problem", "", text) for text in bags.remarks] + found
    found.sort(key=lambda finding: finding.level != "problem")
    sink(StageFinished(STAGE, f"{count} messages read"))
    return BagHealth(
        count,
        {name: stamps.summary() for name, stamps in watch.stamps.items() if stamps.summary().messages},
        {name: looked.summary() for name, looked in watch.pictures.items()},
        {name: marks.dropped for name, marks in watch.landmarks.items() if marks.count},
        tuple(found),
    )


class _Watches:
    """One watch per topic and kind."""

    def __init__(
        self,
        bags: Bags,
        pictures: tuple[str, ...],
        calibration: Calibration | None,
        settings: astrobee.LocalizerSettings,
    ) -> None:
        types, counts = bags.types, bags.counts
        self.stamps = {topic: StampWatch(topic) for topic in counts}
        self.pictures = {
            topic: PictureWatch(topic, counts[topic], is_compressed=types[topic] == COMPRESSED, calibration=calibration)
            for topic in pictures
        }
        self.lenses = {topic: LensWatch(topic) for topic in counts if types[topic] == CAMERA_INFO and counts[topic]}
        self.landmarks = {
            topic: LandmarkWatch(topic, settings, calibration) for topic in counts if types[topic] == astrobee.LANDMARKS
        }
        self._infos = {topic: camera_info_topic(types, counts, topic) for topic in pictures}
        # The CameraInfo of rectified pictures means its projection matrix.
        self._rectified = {info for topic, info in self._infos.items() if info is not None and is_rectified(topic)}
        self._torn: Counter[str] = Counter()
        self._first_torn: dict[str, str] = {}

    def see(self, message: BagMessage) -> None:
        """Hand a message to those it concerns."""
        topic = message.channel.topic
        try:
            self._look(message, topic)
        except (FormatError, AttributeError) as error:  # a definition of the bag's own may lack a field
            self._torn[topic] += 1
            self._first_torn.setdefault(topic, str(error))

    def _look(self, message: BagMessage, topic: str) -> None:
        fields = message.decode()
        self.stamps[topic].see(fields, message.log_ns)
        if topic in self.pictures:
            self.pictures[topic].see(fields)
        elif topic in self.lenses:
            self.lenses[topic].see(fields, is_rectified=topic in self._rectified)
        elif topic in self.landmarks:
            self.landmarks[topic].see(fields)
        elif message.channel.msgtype == astrobee.REGISTRATION:
            for landmarks in self.landmarks.values():
                landmarks.register(fields)

    def findings(self) -> list[Finding]:
        """All of them."""
        found = [
            Finding("problem", topic, f"{count} messages cannot be read: {self._first_torn[topic]}")
            for topic, count in self._torn.items()
        ]
        for stamps in self.stamps.values():
            found += stamps.findings()
        for topic, looked in self.pictures.items():
            info = self._infos[topic]
            found += looked.findings(self.lenses[info].calibration if info in self.lenses else None)
        for lens in self.lenses.values():
            found += lens.findings()
        for marks in self.landmarks.values():
            found += marks.findings()
        return found
