"""A follower behind UDP: commands go out and poses come back as JSON, one datagram each.

We send ``{"schema": 1, "t_ns", "until_ns", "velocity_mps", "acceleration_mps2", "rate_radps",
"angular_acceleration_radps2", "valid_s", "mode"}``, all vectors in body axes (x right, y down, z forward): the command
that holds from ``t_ns`` on, and up to when the other side shall live. It answers ``{"t_ns", "position_m",
"quaternion_xyzw"}``: its pose in any fixed frame of its own at that instant. A robot in real time answers its newest
pose with the ``until_ns`` it was asked for.
"""

from __future__ import annotations

import json
import socket

from uvgs_bench.devices.outside_link import OutsideLink
from uvgs_bench.errors import GantryError, GantryTimeout
from uvgs_bench.geometry import Pose

_REPLY_S = 0.5
_TRIES = 3
_LONGEST_DATAGRAM = 4096


class UdpLink(OutsideLink):
    """A follower that is asked for its pose and told its motion by datagrams.

    Args:
        host: Its name or address.
        port: Its port.
        start: Where the session takes it to be at its first answer: ``world_from_body``.

    Raises:
        GantryError: The address cannot be used.
    """

    def __init__(self, host: str, port: int, start: Pose) -> None:
        super().__init__(start)
        self._name = f"udp:{host}:{port}"
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.connect((host, port))
        except OSError as error:
            self._socket.close()
            raise GantryError(f"cannot be reached: {error.strerror or error}", self._name) from None
        self._socket.settimeout(_REPLY_S)

    def _let_go(self) -> None:
        self._socket.close()

    def _tell(self, until_ns: int) -> None:
        c = self._command
        message = {
            "schema": 1,
            "t_ns": c.t_ns,
            "until_ns": until_ns,
            "velocity_mps": c.velocity_mps.tolist(),
            "acceleration_mps2": c.acceleration_mps2.tolist(),
            "rate_radps": c.rate_radps.tolist(),
            "angular_acceleration_radps2": c.angular_acceleration_radps2.tolist(),
            "valid_s": c.valid_s,
            "mode": c.mode,
        }
        try:
            self._socket.send(json.dumps(message).encode())
        except OSError as error:
            raise GantryError(f"cannot be reached: {error.strerror or error}", self._name) from None

    def _ask(self, t_ns: int) -> Pose:
        """The pose at an instant; a lost datagram is asked for again, one that says nothing usable is passed over."""
        for _ in range(_TRIES):
            self._tell(t_ns)
            try:
                while True:
                    pose = _read_reply(self._socket.recv(_LONGEST_DATAGRAM), t_ns)
                    if pose is not None:
                        return pose
            except TimeoutError:
                continue
            except OSError as error:
                raise GantryError(f"nobody listens there: {error.strerror or error}", self._name) from None
        raise GantryTimeout(f"no pose within {_TRIES * _REPLY_S:g} s", self._name)


def _read_reply(datagram: bytes, t_ns: int) -> Pose | None:
    """The pose of a reply to what was asked; None for anything else."""
    try:
        reply = json.loads(datagram)
        if int(reply["t_ns"]) != t_ns:
            return None
        return Pose.from_quaternion(reply["quaternion_xyzw"], reply["position_m"], "body", "body")
    except (ValueError, TypeError, KeyError, OverflowError):
        return None
