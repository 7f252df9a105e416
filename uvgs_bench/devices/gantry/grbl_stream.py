"""A motion told to the controller in short pieces, each while those before are still under way.

Every piece is checked against the envelope before a byte is sent; only a few pieces are ahead, so that little is moved
after a fault; a carriage that leaves the told path is stopped; whatever ends the stream early stops the motion first.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from uvgs_bench.devices.clock import Clock
from uvgs_bench.devices.gantry import grbl_protocol as protocol
from uvgs_bench.devices.gantry.axes import Axis, Envelope
from uvgs_bench.devices.gantry.gantry import GantryState, StampedPosition
from uvgs_bench.devices.gantry.grbl_link import GrblLink
from uvgs_bench.devices.gantry.grbl_settings import ControllerSettings
from uvgs_bench.errors import GantryError, GantryTimeout
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.units import ns_from_s

# Beside the told path by this much, mm or deg, something is wrong.
_ASTRAY = 0.1
_KEPT_PIECES = 64
_BITS_PER_BYTE, _BAUD = 10, 115200
_REPLY_S = 5.0
_LATE_S = 5.0
_SETTLED_ELSEWHERE_S = 0.5
_POLL_S = 0.02
# A piece shorter than a step of a report is not told.
_NO_PIECE = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class StreamDoor:
    """What a stream needs of its gantry.

    Args:
        settings: The controller's settings.
        envelope: What may be reached.
        link: The conversation.
        clock: Bench time.
        order: Sends a move and takes its reply.
        ask_state: Asks where the controller is.
        brake: Tells the motion to stop, without waiting.
    """

    settings: ControllerSettings
    envelope: Envelope
    link: GrblLink
    clock: Clock
    order: Callable[[str], None]
    ask_state: Callable[[], GantryState]
    brake: Callable[[], None]

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The axes as the bench file declares them."""
        return self.envelope.axes

    @property
    def resolution(self) -> FloatArray:
        """What a step and the digits of a report explain, shape (A,), mm or deg."""
        return 0.5 / self.settings.steps + 1.5 * protocol.REPORT_STEP


class GrblStream:
    """A stream under way; made by ``GrblGantry.streaming``.

    Args:
        door: The gantry.
        start: Where it stands, shape (A,), m or rad.
    """

    def __init__(self, door: StreamDoor, start: FloatArray) -> None:
        self._door = door
        self._told: deque[FloatArray] = deque([start], maxlen=_KEPT_PIECES)
        self._strays = 0
        self._idle_since_ns: int | None = None

    @property
    def end(self) -> FloatArray:
        """Where the motion that was told ends, shape (A,), m or rad."""
        return self._told[-1]

    def order(self, position: FloatArray, speed: float) -> None:
        """Tell one more straight piece, from the end of what was told.

        Args:
            position: Machine axis positions at its end, shape (A,), m or rad.
            speed: Speed along it, m/s (rad/s for a purely rotary piece); lowered where an axis would be too fast.

        Raises:
            EnvelopeError: Its end or the way there is outside; nothing was sent.
            GantryError: The speed is not positive, or the controller refused, fell silent or raised an alarm.
        """
        door = self._door
        if not (np.isfinite(speed) and speed > 0.0):
            raise GantryError(f"a speed must be positive, got {speed}", door.link.port)
        door.envelope.check_point(position)
        lower, upper = [axis.lower for axis in door.axes], [axis.upper for axis in door.axes]
        target = read_only(np.clip(np.asarray(position, dtype=np.float64), lower, upper))
        door.envelope.check_path(self.end, target)
        step = target - self.end
        if float(np.abs(step).max()) <= _NO_PIECE:
            return
        feed = protocol.plan_path(door.settings.axes, step, speed).feed_per_min
        style = "jog" if door.link.dialect.has_jog else "line"
        try:
            line = protocol.write_move(door.axes, target, feed, style=style)  # type: ignore[arg-type]
        except ValueError as error:
            raise GantryError(str(error), door.link.port) from None
        door.order(line)
        self._told.append(target)

    def observe(self) -> tuple[StampedPosition, GantryState]:
        """Ask where the carriage is, and make sure that it is on the told path.

        Returns:
            The position with its instant, and the state as a whole.

        Raises:
            GantryError: It left the path (the motion was told to stop), or the controller is in a state without motion
                of its own accord.
        """
        door = self._door
        asked_ns = door.clock.now_ns()
        state = door.ask_state()
        # The answer was written when the question came, and took its time on the wire.
        wire_ns = ns_from_s(_wire_bytes(state) * _BITS_PER_BYTE / _BAUD)
        stamp = StampedPosition.between(asked_ns, max(asked_ns, state.t_ns - wire_ns), state.position)
        if state.activity not in ("Idle", "Jog", "Run"):
            door.brake()
            raise GantryError(f"the motion was broken off: the controller is in state {state.activity}", door.link.port)
        self._strays = self._strays + 1 if self._is_astray(state.position) else 0
        if self._strays >= 2:
            door.brake()
            at = " ".join(
                f"{axis.name} {axis.described(float(v))}" for axis, v in zip(door.axes, state.position, strict=True)
            )
            raise GantryError(f"left its path: it was seen at {at} and told to stop", door.link.port)
        return stamp, state

    def finish(self) -> GantryState:
        """Wait until the carriage rests at the end of what was told.

        Returns:
            The state at rest.

        Raises:
            GantryTimeout: It does not arrive; the motion was told to stop.
            GantryError: It came to rest elsewhere, or as ``observe``.
        """
        door = self._door
        remaining = float(np.abs(self.end - door.ask_state().position).max())
        slowest = min(axis.max_speed for axis in door.settings.axes)
        deadline_ns = door.clock.now_ns() + ns_from_s(_LATE_S + 10.0 * remaining / slowest)
        while True:
            _, state = self.observe()
            if state.activity == "Idle":
                off = np.abs(protocol.controller_from_si(door.axes, read_only(state.position - self.end)))
                if bool(np.all(off <= door.resolution)):
                    return state
                if self._idle_since_ns is None:
                    self._idle_since_ns = state.t_ns
                if state.t_ns - self._idle_since_ns > ns_from_s(_SETTLED_ELSEWHERE_S):
                    raise GantryError("came to rest before the end of its path", door.link.port)
            else:
                self._idle_since_ns = None
            if state.t_ns > deadline_ns:
                door.brake()
                raise GantryTimeout("did not come to the end of its path in time", door.link.port)
            door.link.listen(_POLL_S)

    def _is_astray(self, position: FloatArray) -> bool:
        """Whether a position is beside all the pieces told of late."""
        path = np.array([protocol.controller_from_si(self._door.axes, place) for place in self._told])
        p = protocol.controller_from_si(self._door.axes, read_only(position))
        slack = _ASTRAY + self._door.resolution
        if bool(np.any(np.all(np.abs(path - p) <= slack, axis=1))):
            return False
        start, step = path[:-1], np.diff(path, axis=0)
        square = np.maximum((step * step).sum(axis=1), 1e-12)
        share = np.clip(((p - start) * step).sum(axis=1) / square, 0.0, 1.0)
        off = np.abs(p - start - share[:, None] * step)
        return not bool(np.any(np.all(off <= slack, axis=1)))


def _wire_bytes(state: GantryState) -> int:
    """About how many bytes the report was: the state, the positions and the fields."""
    fields = sum(len(name) + len(value) + 2 for name, value in state.details.items())
    return len(state.activity) + 10 + 9 * len(state.position) + fields
