"""What can follow: anything that takes commands and says where it is.

To plug a robot or simulator in: 1. write a class with the methods of ``FollowLink``; 2. say its spec in
``open_follow_link``. A link never invents a pose: one that hears nothing raises.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.navigation.follower import FollowCommand

UDP = "udp:"


@dataclass(frozen=True, slots=True, eq=False)
class BodyState:
    """The follower at one instant.

    Args:
        t_ns: The instant, bench time, ns.
        world_from_body: Its pose.
        velocity_mps: Velocity, world axes, shape (3,), m/s.
        rate_radps: Angular velocity, body axes, shape (3,), rad/s.
    """

    t_ns: int
    world_from_body: Pose
    velocity_mps: FloatArray
    rate_radps: FloatArray


class FollowLink(Protocol):
    """A follower that is open."""

    @property
    def has_own_time(self) -> bool:
        """Whether it lives in real time, so that a session must keep pace; otherwise it lives when it is asked."""
        ...

    def send(self, command: FollowCommand) -> None:
        """Obey this from ``command.t_ns`` on, until the next.

        Raises:
            GantryError: The follower cannot be reached.
        """
        ...

    def state_at(self, t_ns: int) -> BodyState:
        """Where it is at an instant; it lives on until then under the last command.

        Args:
            t_ns: The instant, not more than a second before the newest one asked for, ns.

        Returns:
            The state.

        Raises:
            GantryTimeout: The follower is silent.
        """
        ...

    def close(self) -> None:
        """Let it come to rest and let go of it. Safe to call twice."""
        ...


def open_follow_link(spec: str, start: Pose) -> FollowLink:
    """Open a follower outside this program.

    Args:
        spec: ``udp:HOST:PORT``, ``ros1:POSE_TOPIC`` or ``ros2:POSE_TOPIC``.
        start: Where the session takes it to be at its first answer: ``world_from_body``.

    Returns:
        The link.

    Raises:
        ConfigError: The spec means nothing.
        GantryError: The address cannot be used.
    """
    if spec.startswith(("ros1:", "ros2:")):
        from uvgs_bench.devices.ros_link import RosLink

        return RosLink(spec, start)
    host, _, port = spec.removeprefix(UDP).rpartition(":")
    if not spec.startswith(UDP) or not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise ConfigError(
            f"unknown follower '{spec}', expected flyer, gantry, udp:HOST:PORT, ros1:POSE_TOPIC or ros2:POSE_TOPIC",
            key="--plant",
        )
    from uvgs_bench.devices.udp_link import UdpLink

    return UdpLink(host, int(port), start)
