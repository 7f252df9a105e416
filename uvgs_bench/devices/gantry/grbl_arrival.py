"""Knowing that a move has arrived, and noticing that it is another move than the one that was meant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from uvgs_bench.devices.clock import Clock
from uvgs_bench.devices.gantry import grbl_protocol as protocol
from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.devices.gantry.gantry import GantryState
from uvgs_bench.devices.gantry.grbl_link import GrblLink
from uvgs_bench.errors import GantryError, GantryTimeout
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.units import ns_from_s, s_from_ns

WATCH_S = 0.25
"""How often a move is looked at on its way."""

LATE_S = 5.0
_POLL_S = 0.1
_STOP_S = 10.0
_REPLY_GRACE_S = 0.2
_MARGIN_S = 0.001
_SETTLED_ELSEWHERE_S = 0.5
# Beside the path by this much, mm or deg, something is wrong; less is seen at the end anyway.
_ASTRAY = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """A straight way.

    Args:
        axes: The axes.
        steps: Steps per mm or deg, shape (A,).
        start: Where it begins, shape (A,), m or rad.
        target: Where it ends, shape (A,), m or rad.
        port: For messages.
    """

    axes: tuple[Axis, ...]
    steps: FloatArray
    start: FloatArray
    target: FloatArray
    port: str

    def is_at_end(self, position: FloatArray) -> bool:
        """Whether a position is the target, as closely as steps and the digits of a report allow."""
        off = np.abs(protocol.controller_from_si(self.axes, read_only(position - self.target)))
        return bool(np.all(off <= 0.5 / self.steps + 1.5 * protocol.REPORT_STEP))

    def is_astray(self, position: FloatArray) -> bool:
        """Whether a position is beside the straight way, by more than steps and rounding explain."""
        p, q = (protocol.controller_from_si(self.axes, read_only(x - self.start)) for x in (position, self.target))
        share = min(1.0, max(0.0, float(p @ q) / float(q @ q)))
        return bool(np.any(np.abs(p - share * q) > 2.0 / self.steps + _ASTRAY))

    def described(self, position: FloatArray) -> str:
        """A position for people."""
        return " ".join(f"{axis.name} {axis.described(float(v))}" for axis, v in zip(self.axes, position, strict=True))


def await_arrival(
    way: Way,
    link: GrblLink,
    clock: Clock,
    ask_state: Callable[[], GantryState],
    brake: Callable[[], None],
    begun_ns: int,
    duration_s: float,
    every_s: float = WATCH_S,
) -> GantryState:
    """Watch until Idle at the target. One Idle is not enough: the controller may not have begun to move.

    A line may have no checksum, so a damaged one may be another move: who leaves the path is stopped. One report off
    the path may itself be damaged, or torn; two in a row are believed.

    Args:
        way: What was ordered.
        link: The conversation.
        clock: Bench time.
        ask_state: Asks the controller where it is.
        brake: Tells the motion to stop, without waiting.
        begun_ns: When it was ordered, bench time, ns.
        duration_s: How long it should take, s.
        every_s: How often to look on the way, s.

    Returns:
        The state at rest at the target.

    Raises:
        GantryError: It left the path, or came to rest elsewhere.
        GantryTimeout: Not arrived in time.
        GantryAlarm: An alarm came.
        GantryLost: The port vanished or the controller restarted.
    """
    expected_ns = begun_ns + ns_from_s(duration_s + _MARGIN_S)
    deadline_ns = expected_ns + ns_from_s(0.5 * duration_s + LATE_S)
    idle_since_ns: int | None = None
    strays = 0
    while True:
        early_s = s_from_ns(expected_ns - clock.now_ns())
        if strays == 0:
            # Watch seldom on the way, closely just after the expected time, then as often as the controller likes.
            link.listen(min(every_s, early_s) if early_s > 0.0 else min(_POLL_S, _MARGIN_S - early_s))
        state = ask_state()
        strays = strays + 1 if way.is_astray(state.position) else 0
        if strays == 2:
            brake()
            raise GantryError(
                f"left its path from {way.described(way.start)} to {way.described(way.target)}: it was seen at "
                f"{way.described(state.position)} and told to stop",
                way.port,
            )
        if state.activity == "Idle":
            if way.is_at_end(state.position):
                return state
            idle_since_ns = state.t_ns if idle_since_ns is None else idle_since_ns
            if state.t_ns - idle_since_ns > ns_from_s(_SETTLED_ELSEWHERE_S):
                raise GantryError(
                    f"came to rest at {way.described(state.position)} instead of {way.described(way.target)}", way.port
                )
        elif state.activity in ("Jog", "Run"):
            idle_since_ns = None
        else:
            raise GantryError(f"the move was broken off: the controller is in state {state.activity}", way.port)
        if state.t_ns > deadline_ns:
            raise GantryTimeout(f"not arrived {LATE_S:g} s after the expected time", way.port)


def come_to_rest(link: GrblLink, clock: Clock, ask_state: Callable[[], GantryState]) -> GantryState:
    """Tell whatever moves to stop, until it stands.

    Args:
        link: The conversation.
        clock: Bench time.
        ask_state: Asks the controller where it is.

    Returns:
        The state at rest.

    Raises:
        GantryTimeout: It does not come to rest.
        GantryAlarm: An alarm came.
        GantryLost: The port vanished or the controller restarted.
    """
    deadline_ns = clock.now_ns() + ns_from_s(_STOP_S)
    while True:
        state = ask_state()
        if state.activity == "Jog":
            link.wire.send_byte(protocol.JOG_CANCEL)
        elif state.activity == "Run":
            link.wire.send_byte(protocol.HOLD)
        elif not (state.activity == "Hold" and state.details.get("substate") == "1"):
            # At rest; a line still under way may yet begin to move, so its reply is waited for.
            if not link.line_under_way:
                return state
            link.listen(_REPLY_GRACE_S)
            again = ask_state()
            if again.activity not in ("Jog", "Run"):
                return again
        if clock.now_ns() > deadline_ns:
            raise GantryTimeout(f"not at rest {_STOP_S:g} s after the stop", link.port)
        link.listen(0.5 * _POLL_S)
