"""Which topics of a bag are pictures, which one is meant, and which ``CameraInfo`` belongs to it."""

from __future__ import annotations

import difflib
from collections.abc import Mapping

from uvgs_bench.errors import ConfigError, FormatError

RAW, COMPRESSED, CAMERA_INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
_TRANSPORTS = ("/compressed", "/compressedDepth")


def image_topics(types: Mapping[str, str], counts: Mapping[str, int]) -> tuple[str, ...]:
    """Topics of pictures, in alphabetical order; depth images and topics without a message are none.

    Args:
        types: Type by topic.
        counts: Messages by topic.

    Returns:
        The topics.
    """
    return tuple(
        topic
        for topic in sorted(types)
        if types[topic] in (RAW, COMPRESSED) and counts.get(topic, 0) and not topic.endswith("/compressedDepth")
    )


def base_topic(topic: str) -> str:
    """The topic of the pictures themselves, whatever transport they come by."""
    for ending in _TRANSPORTS:
        topic = topic.removesuffix(ending)
    return topic


def choose_image_topic(types: Mapping[str, str], counts: Mapping[str, int], wanted: str, bag: str) -> str:
    """The topic that is meant.

    Args:
        types: Type by topic.
        counts: Messages by topic.
        wanted: What the user said: a topic, its end, or the namespace of the camera; empty when nothing.
        bag: Name of the bag, for errors.

    Returns:
        The topic; of one camera's pictures raw and compressed, the raw ones.

    Raises:
        FormatError: There are no pictures.
        ConfigError: It is none of them, or one must be chosen.
    """
    topics = image_topics(types, counts)
    if not topics:
        kinds = sorted({types[topic] for topic in types if counts.get(topic, 0)})
        raise FormatError(f"holds no images, only {', '.join(kinds) or 'nothing'}", bag)
    if wanted in topics:
        return wanted
    name = wanted.strip("/")
    near = (
        [topic for topic in topics if topic.endswith(f"/{name}") or topic.startswith(f"/{name}/")] if name else topics
    )
    if not near:
        close = difflib.get_close_matches(wanted, topics, n=1)
        hint = f"did you mean '{close[0]}'?" if close else f"expected one of: {', '.join(topics)}"
        raise ConfigError(f"no topic '{wanted}' of images, {hint}", bag)
    if len({base_topic(topic) for topic in near}) > 1:
        raise ConfigError(f"several topics of images, choose one: {', '.join(near)} (bag:FILE?topic=)", bag)
    return next((topic for topic in near if types[topic] == RAW), near[0])


def camera_info_topic(types: Mapping[str, str], counts: Mapping[str, int], image_topic: str) -> str | None:
    """The ``CameraInfo`` that belongs to a topic of pictures.

    Args:
        types: Type by topic.
        counts: Messages by topic.
        image_topic: The topic of the pictures.

    Returns:
        The topic in the same namespace, as image_transport and Astrobee name it; None when there is none.
    """
    base = base_topic(image_topic)
    names = (f"{base.rpartition('/')[0]}/camera_info", f"{base}/camera_info", f"{base}_info")
    return next((name for name in names if types.get(name) == CAMERA_INFO and counts.get(name, 0)), None)


def is_rectified(image_topic: str) -> bool:
    """Whether pictures of a topic are rectified ones, by ROS's naming."""
    return base_topic(image_topic).rpartition("/")[2].startswith("image_rect")
