"""ROS 1 through rospy: an installed and sourced ROS, or Debian's packages."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from uvgs_bench.devices.ros.door import ParameterValue
from uvgs_bench.devices.system_packages import SYSTEM_PACKAGES
from uvgs_bench.errors import CameraLost, CaptureError
from uvgs_bench.interop.bag_framing import full_msgtype

# A picture of 12 Mpx of 16 bit in one read; rospy's default makes it late by many pictures.
_BUFFER_BYTES = 1 << 25
_POLL_S = 0.5
# A master that is just busy answers within this.
_SILENT_S = 4.0
# Without a master rospy waits long for leave to go.
_LEAVE_S = 3.0


class RospyDoor:
    """A node of ROS 1. Its signals are left alone: who runs it, ends it.

    Args:
        name: Name of the node; one more of the same name is told apart.
        arguments: Remappings as ``roslaunch`` passes them.

    Raises:
        CaptureError: There is no rospy, or no master.
    """

    def __init__(self, name: str, arguments: Sequence[str]) -> None:
        self._rospy: Any = _imported("rospy")
        self._dynamic: Any = _imported("genpy.dynamic")
        self._master: Any = _imported("rosgraph").Master("/uvgs")
        if not self._master.is_online():
            raise CaptureError("no ROS master answers: start roscore, or set ROS_MASTER_URI", self._master.master_uri)
        # rospy sends the whole program's log into its own files and hushes it.
        handlers, level = list(logging.root.handlers), logging.root.level
        self._rospy.init_node(name, argv=["uvgs", *arguments], anonymous=False, disable_signals=True)
        logging.root.handlers[:], logging.root.level = handlers, level
        self._publishers: dict[str, Any] = {}
        self._classes: dict[str, Any] = {}
        self._values: dict[str, ParameterValue] = {}
        self._check: Callable[[dict[str, ParameterValue]], str | None] | None = None
        self._answered_s = time.monotonic()
        self._stop = threading.Event()
        threading.Thread(target=self._watch, name="ros", daemon=True).start()

    @property
    def name(self) -> str:
        """The node's full name."""
        return str(self._rospy.get_name())

    @property
    def is_ros1(self) -> bool:
        """ROS 1."""
        return True

    @property
    def is_alive(self) -> bool:
        """Whether the node was not shut down and the master answers."""
        return not self._rospy.is_shutdown() and time.monotonic() - self._answered_s < _SILENT_S

    def now_ns(self) -> int:
        """ROS time, ns."""
        return int(self._rospy.get_rostime().to_nsec())

    def topics(self) -> dict[str, str]:
        """Published topics and their types."""
        return {topic: full_msgtype(kind) for topic, kind in self._rospy.get_published_topics()}

    def subscribe(self, topic: str, _msgtype: str, take: Callable[[bytes], None]) -> Callable[[], None]:
        """Hand the newest messages of a topic to ``take``."""
        subscriber = self._registered(
            lambda: self._rospy.Subscriber(
                topic, self._rospy.AnyMsg, lambda message: take(message._buff), queue_size=1, buff_size=_BUFFER_BYTES
            )
        )

        def end() -> None:
            threading.Thread(target=subscriber.unregister, daemon=True).start()

        return end

    def publish(self, topic: str, msgtype: str, payload: bytes, definition: str) -> None:
        """Publish a serialised message; its class is made from its definition, so that no package is needed."""
        name = msgtype.replace("/msg/", "/")
        made = self._classes.get(name)
        if made is None:
            made = self._classes[name] = self._dynamic.generate_dynamic(name, definition)[name]
        publisher = self._publishers.get(topic)
        if publisher is None:
            publisher = self._publishers[topic] = self._registered(
                lambda: self._rospy.Publisher(topic, made, queue_size=10)
            )
        publisher.publish(made().deserialize(payload))

    def offer_parameters(
        self, values: Mapping[str, ParameterValue], check: Callable[[dict[str, ParameterValue]], str | None]
    ) -> None:
        """Keep parameters as private ones of this node; what a launch file set already counts as a change."""
        own = {name: self._rospy.get_param(f"~{name}", value) for name, value in values.items()}
        changed = {name: value for name, value in own.items() if value != values[name]}
        refusal = check(changed) if changed else None
        if refusal is not None:
            raise CaptureError(f"parameters: {refusal}", self._rospy.get_name())
        for name, value in own.items():
            self._rospy.set_param(f"~{name}", value)
        self._values, self._check = own, check

    def warn(self, text: str) -> None:
        """Say something in ROS's log."""
        self._rospy.logwarn("%s", text)

    def close(self) -> None:
        """Leave. Safe to call twice."""
        if not self._stop.is_set():
            self._stop.set()
            leaving = threading.Thread(target=self._rospy.signal_shutdown, args=("done",), daemon=True)
            leaving.start()
            leaving.join(_LEAVE_S)

    def _registered(self, register: Callable[[], Any]) -> Any:
        """What is registered with the master; rospy tries for ever when there is none."""
        made: list[Any] = []
        trying = threading.Thread(target=lambda: made.append(register()), daemon=True)
        trying.start()
        trying.join(_SILENT_S)
        if not made:
            raise CameraLost("the ROS master does not answer", self._master.master_uri)
        return made[0]

    def _watch(self) -> None:
        """Look for changed parameters and for the master: ROS 1 tells of neither."""
        while not self._stop.wait(_POLL_S):
            try:
                kept = self._rospy.get_param("~", {})
            except Exception:  # noqa: S112  (whatever the network raises, the master did not answer)
                continue
            self._answered_s = time.monotonic()
            changed = {k: kept[k] for k, value in self._values.items() if k in kept and kept[k] != value}
            if not changed or self._check is None:
                continue
            refusal = self._check(changed)
            if refusal is None:
                self._values |= changed
                continue
            self.warn(f"parameters are kept: {refusal}")
            for name in changed:
                self._rospy.set_param(f"~{name}", self._values[name])


def _imported(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        if Path(SYSTEM_PACKAGES, "rospy").is_dir() and SYSTEM_PACKAGES not in sys.path:
            # Behind everything else: our own numpy and OpenCV must win.
            sys.path.append(SYSTEM_PACKAGES)
            return _imported(name)
        raise CaptureError(
            "needs ROS 1: source its setup.bash, or apt install python3-rospy, "
            f"with the Python they were built for ({error})",
            "ros1",
        ) from None
