"""The pictures of ROS bags as a camera: ROS 1 bags, ROS 2 bags in SQLite or MCAP, one or several as one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uvgs_bench.devices.cameras.base import ClosingSource
from uvgs_bench.devices.clock import Clock
from uvgs_bench.errors import CaptureError, ConfigError, FormatError
from uvgs_bench.interop import bag_topics
from uvgs_bench.interop.bag_framing import shown
from uvgs_bench.interop.bags import open_bags
from uvgs_bench.interop.ros_messages import (
    ENCODINGS,
    MessageImage,
    calibration_from_message,
    image_from_compressed,
    image_from_message,
)
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.units import NS_PER_S, s_from_ns

if TYPE_CHECKING:
    from uvgs_bench.camera.calibration import Calibration
    from uvgs_bench.devices.cameras.spec import CameraSpec
    from uvgs_bench.interop.bag_file import BagMessage
    from uvgs_bench.interop.bags import Bags

# A recorder that is this late says so; less is transport.
_LATE_NS = NS_PER_S // 2
# Transport may exchange neighbours; a clock that is set jumps further.
_JUMP_NS = NS_PER_S
# More lines than this about single pictures help nobody.
_MOST_REMARKS = 5


class BagImages(ClosingSource):
    """Image messages of one topic in order, stamped as their headers say.

    Pictures that cannot be read, or come a little late, are left out and named in ``remarks``.

    Args:
        spec: The spec string, for messages.
        bags: The open bags.
        topic: The topic of the pictures.
        info_topic: The topic of the camera's ``CameraInfo``, or None.
        is_log_time: Whether the bags' own times are taken instead of the headers'.
    """

    def __init__(self, spec: str, bags: Bags, topic: str, info_topic: str | None, *, is_log_time: bool) -> None:
        super().__init__(spec, is_live=False, length=bags.counts[topic])
        self._bags: Bags | None = bags
        self._topic = topic
        self._info_topic = info_topic
        self._info: tuple[object, ...] | None = None
        self._messages: Iterator[BagMessage] | None = None
        self._is_log_time = is_log_time
        self._own_remarks: list[str] = []
        self._bag_remarks: tuple[str, ...] = ()
        self._next = self._seen = self._torn = self._late = 0
        self._last_ns = -1

    @classmethod
    def open(cls, spec: CameraSpec, _clock: Clock) -> BagImages:
        """Open ``bag:PATH`` or ``bag:PATH,PATH`` with the options ``topic``, ``info`` and ``stamps`` (header or log).

        Raises:
            CaptureError: A bag is missing, is none, or holds no images.
            ConfigError: An option is unknown, the topic is none of the bag's, or one must be chosen.
        """
        spec.check_options(("topic", "info", "stamps"))
        stamps = spec.options.get("stamps", "header")
        if stamps not in ("header", "log"):
            raise ConfigError(f"expected stamps=header or stamps=log, got '{stamps}'", spec.text)
        if not spec.target:
            raise ConfigError("name the bag, bag:FILE", spec.text)
        is_one = Path(spec.target).exists() or "," not in spec.target
        paths = [Path(name) for name in ([spec.target] if is_one else spec.target.split(",")) if name]
        wanted, info = spec.options.get("topic", ""), spec.options.get("info", "")
        return cls.of(paths, spec.text, topic=wanted, info_topic=info, is_log_time=stamps == "log")

    @classmethod
    def of(
        cls,
        paths: Sequence[Path],
        spec: str = "",
        *,
        topic: str = "",
        info_topic: str = "",
        is_log_time: bool = False,
    ) -> BagImages:
        """Open bags by their paths.

        Args:
            paths: Files or folders.
            spec: What the user wrote, for messages.
            topic: The topic of the pictures, its end or its namespace; empty when there is one.
            info_topic: The topic of the camera's ``CameraInfo``; empty for the one in the pictures' namespace.
            is_log_time: Whether the bags' own times are taken instead of the headers'.

        Returns:
            The open source.

        Raises:
            CaptureError: A bag is missing, is none, or holds no images.
            ConfigError: The topic is none of the bag's, or one must be chosen.
        """
        shown = ",".join(str(path) for path in paths)
        try:
            bags = open_bags(paths)
        except FormatError as error:
            raise CaptureError(str(error)) from None
        try:
            types, counts = bags.types, bags.counts
            found = bag_topics.choose_image_topic(types, counts, topic, spec or shown)
            info = info_topic or bag_topics.camera_info_topic(types, counts, found)
            if info is not None and types.get(info) != bag_topics.CAMERA_INFO:
                there = [name for name, kind in types.items() if kind == bag_topics.CAMERA_INFO]
                raise ConfigError(f"no CameraInfo '{info}', expected one of: {', '.join(there) or 'none'}", spec)
        except FormatError as error:
            bags.close()
            raise CaptureError(str(error).removeprefix(f"{spec or shown}: "), shown) from None
        except ConfigError:
            bags.close()
            raise
        return cls(spec or f"bag:{shown}", bags, found, info, is_log_time=is_log_time)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What was damaged, left out or looked wrong so far; grows while captures are read."""
        if self._bags is not None:
            self._bag_remarks = self._bags.remarks
        return (*self._bag_remarks, *self._own_remarks)

    def camera_info(self) -> Calibration | None:
        """The lens the camera's ``CameraInfo`` says; from then on a change of it is an error.

        Returns:
            The calibration without doubt; None when the bag has no ``CameraInfo`` in the pictures' namespace.

        Raises:
            CaptureError: The camera was never calibrated, or its numbers are none of a known lens.
        """
        if self._bags is None or self._info_topic is None:
            return None
        for message in self._bags.messages([self._info_topic]):
            try:
                fields = message.decode()
                is_rectified = bag_topics.is_rectified(self._topic)
                found = calibration_from_message(fields, self._info_topic, is_rectified=is_rectified)
                self._info = _info_key(fields)
                return found
            except FormatError as error:
                raise CaptureError(str(error)) from None
        return None

    def grab(self) -> Capture | None:
        """The next image, or None after the last.

        Raises:
            CaptureError: The encoding is unknown, the stamps jump back, the lens changes, or no image can be read.
        """
        if self._bags is None:
            return None
        if self._messages is None:
            watched = [self._topic] if self._info is None else [self._topic, self._info_topic or ""]
            self._messages = self._bags.messages(watched)
        for message in self._messages:
            if message.channel.topic != self._topic:
                self._check_info(message)
                continue
            name = f"{message.file.path.name}{self._topic}#{self._seen}"
            self._seen += 1
            try:
                fields = message.decode()
                image = self._image(fields, message, name)
                t_ns = self._stamp_ns(fields, message.log_ns)
            except (FormatError, AttributeError) as error:  # a definition of the bag's own may lack a field
                self._torn += 1
                self._say(str(error), self._torn)
                first_problem = self._own_remarks[0] if self._next == 0 else ""
                if self._seen == self.length and first_problem:
                    self.close()
                    raise CaptureError(f"no image can be read: {first_problem}") from None
                continue
            if t_ns < self._last_ns:
                back_ns = self._last_ns - t_ns
                said = f"header stamp is earlier than that of the image before, by {s_from_ns(back_ns):.3f} s"
                if back_ns >= _JUMP_NS:
                    raise CaptureError(f"its {said}; ?stamps=log takes the bag's own times", name)
                self._late += 1
                self._say(f"{name}: left out, its {said}", self._late)
                continue
            self._last_ns = t_ns
            capture = Capture(image.image, t_ns, name, self._next, bayer=image.bayer)
            self._next += 1
            return capture
        self.close()
        return None

    def close(self) -> None:
        """Release the files. Safe to call twice."""
        if self._bags is not None:
            self._bag_remarks = self._bags.remarks
            self._bags.close()
            self._bags = None

    def _image(self, fields: Any, message: BagMessage, name: str) -> MessageImage:
        if message.channel.msgtype == bag_topics.COMPRESSED:
            return image_from_compressed(str(fields.format), fields.data, name)
        if fields.encoding not in ENCODINGS:
            # No other picture of this topic will be better.
            raise CaptureError(f"has encoding {fields.encoding!r}, expected one of {', '.join(ENCODINGS)}", name)
        size = int(fields.width), int(fields.height), int(fields.step)
        return image_from_message(str(fields.encoding), *size, fields.is_bigendian, fields.data, name)

    def _stamp_ns(self, fields: Any, log_ns: int) -> int:
        stamp = fields.header.stamp
        t_ns = int(stamp.sec) * NS_PER_S + int(stamp.nanosec)
        if self._next == 0 and not self._is_log_time:
            if t_ns == 0:
                self._is_log_time = True
                self._own_remarks.append(f"{self._topic}: header stamps were never set, the bag's own times are taken")
            elif abs(log_ns - t_ns) > _LATE_NS:
                late_s = s_from_ns(log_ns - t_ns)
                word = "later" if late_s > 0.0 else "earlier"
                self._own_remarks.append(
                    f"{self._topic}: recorded {abs(late_s):.3f} s {word} than the header stamps, which the poses carry"
                )
        return log_ns if self._is_log_time else t_ns

    def _check_info(self, message: BagMessage) -> None:
        try:
            is_same = _info_key(message.decode()) == self._info
        except FormatError as error:
            raise CaptureError(str(error)) from None
        if not is_same:
            said = f"changes after {self._next} images; give the lens of each part with --camera"
            raise CaptureError(said, f"{message.file.path.name}{self._info_topic}")

    def _say(self, text: str, count: int) -> None:
        if count <= _MOST_REMARKS:
            self._own_remarks.append(shown(text))
        elif count == _MOST_REMARKS + 1:
            self._own_remarks.append(f"{self._topic}: and more of that kind")


def _info_key(fields: Any) -> tuple[object, ...]:
    """What makes the lens of a ``CameraInfo``."""
    said = [getattr(fields, name) if hasattr(fields, name) else getattr(fields, name.upper()) for name in "dkrp"]
    numbers = [tuple(float(value) for value in values) for values in said]
    roi = fields.roi
    window = (fields.binning_x, fields.binning_y, roi.x_offset, roi.y_offset, roi.width, roi.height)
    return (fields.width, fields.height, fields.distortion_model, *numbers, *window)
