"""ROS 2 through rclpy: an installed and sourced ROS."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any

from uvgs_bench.devices.ros.door import ParameterValue
from uvgs_bench.errors import CaptureError


class RclpyDoor:
    """A node of ROS 2, spun in a thread. Its signals are left alone: who runs it, ends it.

    Args:
        name: Name of the node.
        arguments: What follows ``--ros-args``.

    Raises:
        CaptureError: There is no rclpy.
    """

    def __init__(self, name: str, arguments: Sequence[str]) -> None:
        self._rclpy: Any = _imported("rclpy")
        self._qos: Any = _imported("rclpy.qos")
        # None of ROS's own handlers: Ctrl-C ends the stream, and the stream the node.
        no_signals = _imported("rclpy.signals").SignalHandlerOptions.NO
        args = ["--ros-args", *arguments] if arguments else []
        self._rclpy.init(args=args, signal_handler_options=no_signals)
        self._node: Any = self._rclpy.create_node(name)
        self._executor: Any = _imported("rclpy.executors").SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._publishers: dict[str, Any] = {}
        self._lacking: set[str] = set()
        self._is_closed = False
        self._thread = threading.Thread(target=self._spin, name="ros", daemon=True)
        self._thread.start()

    @property
    def name(self) -> str:
        """The node's full name."""
        return str(self._node.get_fully_qualified_name())

    @property
    def is_ros1(self) -> bool:
        """ROS 2."""
        return False

    @property
    def is_alive(self) -> bool:
        """Whether the node was not shut down."""
        return not self._is_closed and bool(self._rclpy.ok())

    def now_ns(self) -> int:
        """ROS time, ns."""
        return int(self._node.get_clock().now().nanoseconds)

    def topics(self) -> dict[str, str]:
        """Topics that are published, and their types."""
        found = {}
        for topic, kinds in self._node.get_topic_names_and_types():
            if self._node.count_publishers(topic):
                found[topic] = kinds[0]
        return found

    def subscribe(self, topic: str, msgtype: str, take: Callable[[bytes], None]) -> Callable[[], None]:
        """Hand the newest messages of a topic to ``take``, whether their publisher is reliable or not."""
        kind = _message_class(msgtype)
        subscription = self._node.create_subscription(kind, topic, take, self._qos.qos_profile_sensor_data, raw=True)

        def end() -> None:
            if self.is_alive:
                self._node.destroy_subscription(subscription)

        return end

    def publish(self, topic: str, msgtype: str, payload: bytes, _definition: str) -> None:
        """Publish a serialised message; a type whose package is not installed is said once and left out."""
        publisher = self._publishers.get(topic)
        if publisher is None:
            if msgtype in self._lacking:
                return
            try:
                kind = _message_class(msgtype)
            except CaptureError as error:
                self._lacking.add(msgtype)
                self.warn(f"{topic} is not published: {error}")
                return
            publisher = self._publishers[topic] = self._node.create_publisher(kind, topic, 10)
        publisher.publish(payload)

    def offer_parameters(
        self, values: Mapping[str, ParameterValue], check: Callable[[dict[str, ParameterValue]], str | None]
    ) -> None:
        """Declare parameters; what a launch file says of them counts as a change."""
        messages: Any = import_module("rcl_interfaces.msg")
        # A whole number for a threshold is as good as 3.0; what is possible, the check says.
        loose = messages.ParameterDescriptor(dynamic_typing=True)
        own = {name: _plain(self._node.declare_parameter(name, value, loose).value) for name, value in values.items()}
        changed = {name: value for name, value in own.items() if value != values[name]}
        refusal = check(changed) if changed else None
        if refusal is not None:
            raise CaptureError(f"parameters: {refusal}", self.name)

        def changing(parameters: list[Any]) -> Any:
            refusal = check({p.name: _plain(p.value) for p in parameters if p.name in values})
            return messages.SetParametersResult(successful=refusal is None, reason=refusal or "")

        self._node.add_on_set_parameters_callback(changing)

    def warn(self, text: str) -> None:
        """Say something in ROS's log."""
        self._node.get_logger().warning(text)

    def close(self) -> None:
        """Leave. Safe to call twice."""
        if self._is_closed:
            return
        self._is_closed = True
        self._executor.shutdown()
        self._node.destroy_node()
        self._rclpy.try_shutdown()
        self._thread.join(timeout=2.0)

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except Exception:
            # Shutting down while spinning raises one of several errors, by version.
            if not self._is_closed:
                raise


def _plain(value: Any) -> ParameterValue:
    """An array or list as a list, the rest as it is."""
    if isinstance(value, bool | int | float | str):
        return value
    return [float(number) for number in value or ()]


def _message_class(msgtype: str) -> Any:
    package, _, name = msgtype.partition("/msg/")
    return getattr(_imported(f"{package}.msg"), name)


def _imported(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise CaptureError(f"needs ROS 2: source its setup.bash ({error})", "ros2") from None
