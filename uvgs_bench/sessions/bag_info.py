"""What is in bags: topics, types, counts, rates, spans, compression, pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uvgs_bench.errors import FormatError
from uvgs_bench.interop.bag_topics import CAMERA_INFO, COMPRESSED, RAW, camera_info_topic, image_topics
from uvgs_bench.interop.bags import Bags, open_bags
from uvgs_bench.interop.ros_messages import calibration_from_message, image_from_compressed
from uvgs_bench.units import s_from_ns


@dataclass(frozen=True, slots=True)
class FileInfo:
    """One file of a bag.

    Args:
        path: The file.
        kind: Its format.
        compression: Of chunks, messages or the file.
        size_bytes: Its size.
        messages: Messages in it.
        start_ns: Its first time, ns; None without messages.
        end_ns: Its last time, ns; None without messages.
    """

    path: str
    kind: str
    compression: str
    size_bytes: int
    messages: int
    start_ns: int | None
    end_ns: int | None


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """One topic.

    Args:
        topic: Its name.
        msgtype: Its type.
        messages: Messages of it.
        mean_rate_hz: Messages over the span of all bags; None for one message or no span.
        detail: Of pictures encoding and size, of ``CameraInfo`` the lens; else empty.
        camera_info: The ``CameraInfo`` topic of pictures, or None.
    """

    topic: str
    msgtype: str
    messages: int
    mean_rate_hz: float | None
    detail: str
    camera_info: str | None


@dataclass(frozen=True, slots=True)
class BagInfo:
    """What is in bags.

    Args:
        files: Their files.
        topics: Their topics in alphabetical order.
        start_ns: First time of all, ns; None without messages.
        end_ns: Last time of all, ns; None without messages.
        remarks: What is wrong, a line each.
    """

    files: tuple[FileInfo, ...]
    topics: tuple[TopicInfo, ...]
    start_ns: int | None
    end_ns: int | None
    remarks: tuple[str, ...]

    @property
    def duration_s(self) -> float:
        """From first to last message, s."""
        return 0.0 if self.start_ns is None or self.end_ns is None else s_from_ns(self.end_ns - self.start_ns)


def describe_bags(paths: Sequence[Path | str]) -> BagInfo:
    """Look at bags without reading more than the first message of each topic of pictures.

    Args:
        paths: Files or folders.

    Returns:
        What is in them.

    Raises:
        FormatError: One is missing, is no bag, or has nothing that can be read.
    """
    with open_bags(paths) as bags:
        files = tuple(
            FileInfo(
                str(file.path),
                file.kind,
                file.compression,
                file.path.stat().st_size,
                sum(file.counts.values()),
                None if file.span_ns is None else file.span_ns[0],
                None if file.span_ns is None else file.span_ns[1],
            )
            for file in bags.files
        )
        spans = [file.span_ns for file in bags.files if file.span_ns is not None]
        start_ns = min((span[0] for span in spans), default=None)
        end_ns = max((span[1] for span in spans), default=None)
        span_s = 0.0 if start_ns is None or end_ns is None else s_from_ns(end_ns - start_ns)
        pictures = image_topics(bags.types, bags.counts)
        topics = tuple(
            TopicInfo(
                topic,
                bags.types[topic],
                count,
                (count - 1) / span_s if count > 1 and span_s > 0.0 else None,
                _detail(bags, topic) if count else "",
                camera_info_topic(bags.types, bags.counts, topic) if topic in pictures else None,
            )
            for topic, count in bags.counts.items()
        )
        return BagInfo(files, topics, start_ns, end_ns, bags.remarks)


def _detail(bags: Bags, topic: str) -> str:
    if bags.types[topic] not in (RAW, COMPRESSED, CAMERA_INFO):
        return ""
    try:
        fields: Any = next(bags.messages([topic])).decode()
        if bags.types[topic] == RAW:
            return f"{fields.encoding} {fields.width}x{fields.height} px"
        if bags.types[topic] == COMPRESSED:
            image = image_from_compressed(str(fields.format), fields.data).image
            return f"{fields.format or 'no format said'} {image.shape[1]}x{image.shape[0]} px"
        lens = calibration_from_message(fields, topic).lens
        return f"{lens.model} {lens.width_px}x{lens.height_px} px"
    except StopIteration:
        return ""
    except (FormatError, AttributeError) as error:  # a definition of the bag's own may lack a field
        return str(error).removeprefix(f"{topic}: ")
