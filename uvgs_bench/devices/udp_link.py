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
from contextlib import suppress

import numpy as np

from uvgs_bench.devices.follow_link import BodyState
from uvgs_bench.errors import GantryError, GantryTimeout
from uvgs_bench.geometry import Pose, read_only
from uvgs_bench.geometry.se3 import so3_exp, so3_log
from uvgs_bench.navigation.follower import FollowCommand, FollowerConfig, rest_command
from uvgs_bench.units import s_from_ns

_REPLY_S = 0.5
_TRIES = 3
_LONGEST_DATAGRAM = 4096
_KEPT_STATES = 256


class UdpLink:
    """A follower that is asked for its pose and told its motion by datagrams.

    Args:
        host: Its name or address.
        port: Its port.
        start: Where the session takes it to be at its first answer: ``world_from_body``.

    Raises:
        GantryError: The address cannot be used.
    """

    has_own_time = True

    def __init__(self, host: str, port: int, start: Pose) -> None:
        self._name = f"udp:{host}:{port}"
        self._start = start
        self._command = rest_command(0, FollowerConfig())
        self._world_from_theirs: Pose | None = None
        self._states: list[BodyState] = []
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.connect((host, port))
        except OSError as error:
            self._socket.close()
            raise GantryError(f"cannot be reached: {error.strerror or error}", self._name) from None
        self._socket.settimeout(_REPLY_S)

    def send(self, command: FollowCommand) -> None:
        """Obey this from ``command.t_ns`` on. Raises GantryError."""
        self._command = command
        self._tell(command.t_ns)

    def state_at(self, t_ns: int) -> BodyState:
        """Where it is at an instant. Raises GantryTimeout, GantryError."""
        if not self._states or t_ns > self._states[-1].t_ns:
            self._states = [*self._states, self._ask(t_ns)][-_KEPT_STATES:]
        after = next(i for i, state in enumerate(self._states) if state.t_ns >= t_ns)
        if after == 0:
            return self._states[0]
        return _between(self._states[after - 1], self._states[after], t_ns)

    def close(self) -> None:
        """Tell it to stand still and let go of it. Safe to call twice."""
        if self._socket.fileno() < 0:
            return
        with suppress(GantryError):  # nobody may be there to be told
            self.send(rest_command(self._command.t_ns, FollowerConfig()))
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

    def _ask(self, t_ns: int) -> BodyState:
        """The pose at an instant; a lost datagram is asked for again, one that says nothing usable is passed over."""
        for _ in range(_TRIES):
            self._tell(t_ns)
            try:
                while True:
                    pose = _read_reply(self._socket.recv(_LONGEST_DATAGRAM), t_ns)
                    if pose is not None:
                        return self._state(t_ns, pose)
            except TimeoutError:
                continue
            except OSError as error:
                raise GantryError(f"nobody listens there: {error.strerror or error}", self._name) from None
        raise GantryTimeout(f"no pose within {_TRIES * _REPLY_S:g} s", self._name)

    def _state(self, t_ns: int, theirs: Pose) -> BodyState:
        if self._world_from_theirs is None:
            self._world_from_theirs = self._start @ theirs.inverse()
        pose = self._world_from_theirs @ theirs
        zero = np.zeros(3)
        if not self._states:
            return BodyState(t_ns, pose, zero, zero)
        before = self._states[-1]
        dt_s = s_from_ns(t_ns - before.t_ns)
        velocity = (pose.t_m - before.world_from_body.t_m) / dt_s
        rate = so3_log(before.world_from_body.R.T @ pose.R) / dt_s
        return BodyState(t_ns, pose, read_only(velocity), read_only(rate))


def _read_reply(datagram: bytes, t_ns: int) -> Pose | None:
    """The pose of a reply to what was asked; None for anything else."""
    try:
        reply = json.loads(datagram)
        if int(reply["t_ns"]) != t_ns:
            return None
        return Pose.from_quaternion(reply["quaternion_xyzw"], reply["position_m"], "body", "body")
    except (ValueError, TypeError, KeyError, OverflowError):
        return None


def _between(a: BodyState, b: BodyState, t_ns: int) -> BodyState:
    """A state on the straight way from one to the next."""
    share = (t_ns - a.t_ns) / (b.t_ns - a.t_ns)
    p, q = a.world_from_body, b.world_from_body
    R = p.R @ so3_exp(share * so3_log(p.R.T @ q.R))
    return BodyState(t_ns, Pose(R, p.t_m + share * (q.t_m - p.t_m), "world", "body"), b.velocity_mps, b.rate_radps)
