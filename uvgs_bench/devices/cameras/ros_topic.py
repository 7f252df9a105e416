"""The pictures of a topic of a running ROS as a live camera."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal, cast

from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.devices.cameras.base import ClosingSource
from uvgs_bench.devices.clock import Clock
from uvgs_bench.devices.ros import RosDoor, RosMessages, open_ros
from uvgs_bench.errors import CaptureError, ConfigError, FormatError
from uvgs_bench.interop import bag_topics
from uvgs_bench.interop.ros_messages import calibration_from_message, image_from_compressed, image_from_message
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.units import NS_PER_S

if TYPE_CHECKING:
    from uvgs_bench.devices.cameras.spec import CameraSpec

WAIT_S = 10.0
"""How long to wait for a topic to appear."""

_LOOK_S = 0.2
# The reader takes a picture out within milliseconds; an old one is of no use.
_DEPTH = 2


class RosTopic(ClosingSource):
    """Pictures of a topic, stamped as their headers say.

    Args:
        spec: The spec string, for messages.
        door: The node.
        topic: The topic.
        msgtype: Its type: raw or compressed images.
    """

    def __init__(self, spec: str, door: RosDoor, topic: str, msgtype: str) -> None:
        super().__init__(spec, is_live=True, length=None)
        self._door, self._topic, self._msgtype = door, topic, msgtype
        self._messages = RosMessages(door)
        self._waiting: deque[bytes] = deque(maxlen=_DEPTH)
        self._arrived = threading.Condition()
        self._next = 0
        self._is_closed = False
        self._end: Callable[[], None] = door.subscribe(topic, msgtype, self._take)

    @classmethod
    def open(cls, spec: CameraSpec, _clock: Clock) -> RosTopic:
        """Open ``ros1:/camera/image_raw`` or ``ros2:/camera/image_raw``, with the option ``wait_s`` for its publisher.

        Without a topic, the only one with images is taken.

        Raises:
            CaptureError: This ROS is not there, nobody publishes the topic in time, or it carries no images.
            ConfigError: An option is unknown or no number.
        """
        spec.check_options(("wait_s",))
        wait_s = spec.numbers().get("wait_s", WAIT_S)
        door = open_ros(cast("Literal['ros1', 'ros2']", spec.scheme))
        until_s = time.monotonic() + wait_s
        while True:
            there = door.topics()
            try:
                topic = bag_topics.choose_image_topic(there, dict.fromkeys(there, 1), spec.target, spec.text)
                return cls(spec.text, door, topic, there[topic])
            except FormatError as error:
                if time.monotonic() >= until_s or not door.is_alive:
                    raise CaptureError(str(error)) from None
            except ConfigError:
                # A topic that is not there may still come; several to choose from will not become one.
                if not spec.target or time.monotonic() >= until_s:
                    raise
            time.sleep(_LOOK_S)

    def grab(self) -> Capture:
        """The next picture stamped after the call.

        Raises:
            CaptureError: ROS is gone, or a picture cannot be read.
        """
        called_ns = self._door.now_ns()
        while (capture := self.next_capture()).t_ns < called_ns:
            pass
        return capture

    def next_capture(self) -> Capture:
        """The next picture of the topic.

        Raises:
            CaptureError: ROS is gone.
            FormatError: A picture cannot be read.
        """
        with self._arrived:
            while not self._waiting:
                if self._is_closed or not self._door.is_alive:
                    raise CaptureError("ROS is gone" if not self._is_closed else "the topic is closed", self.spec)
                self._arrived.wait(_LOOK_S)
            payload = self._waiting.popleft()
        message = self._messages.read(self._msgtype, payload)
        if self._msgtype == bag_topics.RAW:
            found = image_from_message(
                message.encoding, message.width, message.height, message.step, message.is_bigendian, message.data,
                self._topic,
            )  # fmt: skip
        else:
            found = image_from_compressed(message.format, message.data, self._topic)
        stamp = message.header.stamp
        t_ns = int(stamp.sec) * NS_PER_S + int(stamp.nanosec)
        capture = Capture(found.image, t_ns, self._topic, self._next, bayer=found.bayer)
        self._next += 1
        return capture

    def camera_info(self) -> Calibration | None:
        """The lens the camera's ``CameraInfo`` says.

        Returns:
            The calibration without doubt; None when none is published beside the pictures.

        Raises:
            CaptureError: It is announced and does not come, or it is of no calibrated camera or no known lens.
        """
        there = self._door.topics()
        topic = bag_topics.camera_info_topic(there, dict.fromkeys(there, 1), self._topic)
        if topic is None:
            return None
        came, found = threading.Event(), []

        def take(payload: bytes) -> None:
            found.append(payload)
            came.set()

        end = self._door.subscribe(topic, bag_topics.CAMERA_INFO, take)
        is_there = came.wait(WAIT_S)
        end()
        if not is_there:
            raise CaptureError(f"no CameraInfo within {WAIT_S:g} s; give --camera", topic)
        message = self._messages.read(bag_topics.CAMERA_INFO, found[0])
        try:
            return calibration_from_message(message, topic, is_rectified=bag_topics.is_rectified(self._topic))
        except FormatError as error:
            raise CaptureError(str(error)) from None

    def now_ns(self) -> int:
        """The clock of the stamps, ns."""
        return self._door.now_ns()

    def close(self) -> None:
        """Unsubscribe. Safe to call twice; the node stays."""
        if not self._is_closed:
            self._is_closed = True
            self._end()

    def _take(self, payload: bytes) -> None:
        with self._arrived:
            self._waiting.append(payload)
            self._arrived.notify_all()
