"""What followers outside this program share: their poses become states in the session's world."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import suppress

import numpy as np

from uvgs_bench.devices.follow_link import BodyState
from uvgs_bench.errors import GantryError
from uvgs_bench.geometry import Pose, read_only
from uvgs_bench.geometry.se3 import so3_exp, so3_log
from uvgs_bench.navigation.follower import FollowCommand, FollowerConfig, rest_command
from uvgs_bench.units import s_from_ns

_KEPT_STATES = 256


class OutsideLink(ABC):
    """A follower in real time that says its pose in any fixed frame of its own.

    Args:
        start: Where the session takes it to be at its first answer: ``world_from_body``.
    """

    has_own_time = True

    def __init__(self, start: Pose) -> None:
        self._start = start
        self._command = rest_command(0, FollowerConfig())
        self._world_from_theirs: Pose | None = None
        self._states: list[BodyState] = []
        self._is_closed = False

    @abstractmethod
    def _tell(self, until_ns: int) -> None:
        """Send ``self._command``, to be lived up to an instant. Raises GantryError."""

    @abstractmethod
    def _ask(self, t_ns: int) -> Pose:
        """Its pose at an instant, theirs_from_body. Raises GantryTimeout, GantryError."""

    @abstractmethod
    def _let_go(self) -> None:
        """Release what was opened."""

    def send(self, command: FollowCommand) -> None:
        """Obey this from ``command.t_ns`` on. Raises GantryError."""
        self._command = command
        self._tell(command.t_ns)

    def state_at(self, t_ns: int) -> BodyState:
        """Where it is at an instant. Raises GantryTimeout, GantryError."""
        if not self._states or t_ns > self._states[-1].t_ns:
            self._states = [*self._states, self._state(t_ns, self._ask(t_ns))][-_KEPT_STATES:]
        after = next(i for i, state in enumerate(self._states) if state.t_ns >= t_ns)
        if after == 0:
            return self._states[0]
        return _between(self._states[after - 1], self._states[after], t_ns)

    def close(self) -> None:
        """Tell it to stand still and let go of it. Safe to call twice."""
        if self._is_closed:
            return
        self._is_closed = True
        with suppress(GantryError):  # nobody may be there to be told
            self.send(rest_command(self._command.t_ns, FollowerConfig()))
        self._let_go()

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


def _between(a: BodyState, b: BodyState, t_ns: int) -> BodyState:
    """A state on the straight way from one to the next."""
    share = (t_ns - a.t_ns) / (b.t_ns - a.t_ns)
    p, q = a.world_from_body, b.world_from_body
    R = p.R @ so3_exp(share * so3_log(p.R.T @ q.R))
    return BodyState(t_ns, Pose(R, p.t_m + share * (q.t_m - p.t_m), "world", "body"), b.velocity_mps, b.rate_radps)
