"""A follower behind ROS: commands in ROS's body axes, poses in ours, silence and wrong topics said."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.devices import ros_link
from uvgs_bench.devices.follow_link import open_follow_link
from uvgs_bench.devices.ros_link import COMMAND_TOPIC, RosLink
from uvgs_bench.errors import ConfigError, GantryError, GantryTimeout
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.interop.pose_messages import MessageMaker, ros_store
from uvgs_bench.navigation.follower import FollowerConfig, rest_command
from uvgs_bench.units import ns_from_s

POSE = "geometry_msgs/msg/PoseStamped"
START = Pose(so3_exp(np.array([0.1, -0.2, 0.3])), np.array([0.5, 0.0, -0.5]), "world", "body")


class Robot:
    """A node whose commands move a robot by a tenth of a second each; x forward, y left, z up."""

    name = "/robot"
    is_alive = True
    is_ros1 = False

    def __init__(self, kind: str = POSE) -> None:
        self.kind = kind
        self.R, self.t_m = so3_exp(np.array([0.0, 0.0, 0.7])), np.array([3.0, -1.0, 0.2])
        self.store = ros_store(is_ros1=False)
        self.make = MessageMaker(self.store, is_ros1=False)
        self.take: Callable[[bytes], None] | None = None
        self.is_silent = False
        self.heard: list[tuple[np.ndarray, np.ndarray]] = []

    def now_ns(self) -> int:
        return 0

    def topics(self) -> dict[str, str]:
        return {"/robot/pose": self.kind}

    def subscribe(self, _topic: str, _kind: str, take: Callable[[bytes], None]) -> Callable[[], None]:
        self.take = take
        return lambda: None

    def publish(self, topic: str, kind: str, payload: bytes, _definition: str) -> None:
        assert topic == COMMAND_TOPIC
        twist = self.store.deserialize_cdr(payload, kind).twist
        velocity = np.array([twist.linear.x, twist.linear.y, twist.linear.z])
        rate = np.array([twist.angular.x, twist.angular.y, twist.angular.z])
        self.heard.append((velocity, rate))
        self.t_m = self.t_m + 0.1 * self.R @ velocity
        self.R = self.R @ so3_exp(0.1 * rate)
        if self.is_silent or self.take is None:
            return
        types = self.store.types
        x, y, z, w = Pose(self.R, self.t_m, "body", "body").quaternion_xyzw()
        point = types["geometry_msgs/msg/Point"](*self.t_m.tolist())
        turn = types["geometry_msgs/msg/Quaternion"](x, y, z, w)
        message = types[POSE](self.make.header(0, "odom"), types["geometry_msgs/msg/Pose"](point, turn))
        self.take(bytes(self.store.serialize_cdr(message, POSE)))

    def close(self) -> None:
        pass


def command(t_ns: int, velocity_mps: list[float], rate_radps: list[float]):
    rest = rest_command(t_ns, FollowerConfig())
    return replace(rest, velocity_mps=np.array(velocity_mps), rate_radps=np.array(rate_radps))


def test_forward_is_forward_on_both_sides() -> None:
    robot = Robot()
    link = RosLink("ros2:/robot/pose", START, robot)  # type: ignore[arg-type]
    first = link.state_at(0)
    # The session says where it begins, whatever the robot calls the place.
    assert first.world_from_body.is_close(START, 1e-12, 1e-12)
    # Ours: z forward, x right, y down.
    link.send(command(0, [0.0, 0.0, 0.2], [0.0, 0.3, 0.0]))
    assert np.allclose(robot.heard[-1][0], [0.2, 0.0, 0.0])
    assert np.allclose(robot.heard[-1][1], [0.0, 0.0, -0.3])
    place = robot.t_m.copy()
    turn = robot.R.copy()
    state = link.state_at(ns_from_s(0.1))
    # Asked again, it lives on: two steps of a tenth of a second in all, the second from the turned attitude.
    moved = START.R.T @ (state.world_from_body.t_m - START.t_m)
    assert np.linalg.norm(moved) == pytest.approx(0.04, rel=1e-3)
    assert moved[2] == pytest.approx(0.04, abs=1e-3)
    assert not np.allclose(place, robot.t_m)
    assert not np.allclose(turn, robot.R)
    link.close()
    link.close()
    assert np.allclose(robot.heard[-1][0], 0.0)


def test_silence_and_other_topics_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros_link, "_SILENT_S", 0.05)
    monkeypatch.setattr(ros_link, "_WAIT_S", 0.05)
    robot = Robot()
    link = RosLink("ros2:/robot/pose", START, robot)  # type: ignore[arg-type]
    robot.is_silent = True
    with pytest.raises(GantryTimeout, match=r"ros2:/robot/pose: no pose within"):
        link.state_at(0)
    with pytest.raises(GantryError, match="carries sensor_msgs/msg/Image, expected one of"):
        RosLink("ros2:/robot/pose", START, Robot("sensor_msgs/msg/Image"))  # type: ignore[arg-type]
    with pytest.raises(GantryError, match="nobody publishes it"):
        RosLink("ros2:/other", START, Robot())  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="ros1:POSE_TOPIC"):
        open_follow_link("rso1:/x", START)
