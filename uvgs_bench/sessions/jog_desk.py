"""A gantry moved by hand while a stream runs: orders from any thread, one motion at a time, in a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING

import numpy as np

from uvgs_bench.devices.clock import Clock
from uvgs_bench.errors import EnvelopeError, UvgsError

if TYPE_CHECKING:
    from uvgs_bench.devices.gantry import Axis, Gantry, GantryState

MOST_M, MOST_RAD = 0.05, 0.2
"""Longest jog of a linear and of a rotary axis."""
FASTEST_MPS, FASTEST_RAD_S = 0.02, 0.2
"""Greatest speed of a jog: slow enough to be watched."""
_LOOK_S = 0.5

_Order = Callable[["Gantry"], object]


class _StopAsked(BaseException):
    """Unwinds a motion from within its waiting, as Ctrl-C would: no driver may catch it."""


class StoppableClock:
    """A clock whose readers are interrupted when a stop is wanted, as Ctrl-C would interrupt them.

    Args:
        clock: The clock.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._wanted = threading.Event()
        self._is_armed = False

    def now_ns(self) -> int:
        """Bench time, ns."""
        self._check()
        return self._clock.now_ns()

    def sleep(self, duration_s: float) -> None:
        """Wait, s."""
        self._check()
        self._clock.sleep(duration_s)
        self._check()

    def ask(self) -> None:
        """Interrupt the motion that runs within ``armed``, or that begins next."""
        self._wanted.set()

    @contextmanager
    def armed(self) -> Generator[None]:
        """Only within this, and only in its thread, a stop interrupts."""
        self._is_armed = True
        try:
            yield
        finally:
            self._is_armed = False

    def forget(self) -> None:
        """Take back what was asked."""
        self._wanted.clear()

    def _check(self) -> None:
        if self._is_armed and self._wanted.is_set():
            raise _StopAsked


class JogDesk:
    """Takes orders and has the driver carry them out: its checks of envelope and homing hold for every move.

    Args:
        opening: Opens the gantry with the clock it is given; entered and left in the desk's own thread.
        clock: The clock of the bench.

    Raises:
        UvgsError: The gantry cannot be opened.
    """

    def __init__(self, opening: Callable[[Clock], AbstractContextManager[Gantry]], clock: Clock) -> None:
        self._opening = opening
        self._clock = StoppableClock(clock)
        self._changed = threading.Condition()
        self._order: tuple[str, _Order] | None = None
        self._is_moving = self._is_closed = self._is_lost = False
        self._said = "home before the first move"
        self._axes: tuple[Axis, ...] = ()
        self._state: GantryState | None = None
        self._errors: list[UvgsError] = []
        self._opened = threading.Event()
        self._thread = threading.Thread(target=self._work, name="gantry", daemon=True)
        self._thread.start()
        self._opened.wait()
        if self._errors:
            self._thread.join()
            raise self._errors[0]

    @property
    def axes(self) -> tuple[tuple[str, str], ...]:
        """Name and unit (``m`` or ``rad``) of each axis."""
        return tuple((axis.name, "m" if axis.kind == "linear" else "rad") for axis in self._axes)

    @property
    def state(self) -> GantryState | None:
        """What the controller said last; None before it said anything."""
        return self._state

    @property
    def positions(self) -> tuple[tuple[str, str], ...]:
        """Each axis with its position in words."""
        state = self._state
        if state is None:
            return ()
        named = zip(self._axes, state.position, strict=True)
        return tuple((axis.name, axis.described(float(value))) for axis, value in named)

    @property
    def said(self) -> str:
        """What came of the last order."""
        return self._said

    @property
    def is_moving(self) -> bool:
        """Whether an order is being carried out."""
        return self._is_moving

    def home(self) -> str | None:
        """Home all axes. Answers why not, or None."""
        return self._take("homing", lambda gantry: gantry.home())

    def jog(self, axis: str, offset: float) -> str | None:
        """Move an axis by an offset, m or rad. Answers why not, or None."""
        index = next((i for i, item in enumerate(self._axes) if item.name == axis), None)
        if index is None:
            return f"there is no axis {axis}"
        state = self._state
        if state is None or not state.is_homed:
            return "home first: the position is unknown"
        chosen = self._axes[index]
        is_linear = chosen.kind == "linear"
        most, fastest = (MOST_M, FASTEST_MPS) if is_linear else (MOST_RAD, FASTEST_RAD_S)
        if not 0.0 < abs(offset) <= most:
            return f"a jog is at most {chosen.described(most)} long"
        step = np.zeros(len(self._axes))
        step[index] = offset
        speed = min(chosen.max_speed, fastest)
        return self._take(f"jogging {axis} by {chosen.described(offset)}", lambda gantry: gantry.jog(step, speed))

    def stop(self) -> str | None:
        """Stop what moves. Answers None: stopping is never refused."""
        with self._changed:
            self._order = None
            if self._is_moving:
                self._clock.ask()
        return None

    def close(self) -> None:
        """Stop what moves, then leave the gantry. Safe to call twice."""
        with self._changed:
            self._is_closed = True
            self._order = None
            if self._is_moving:
                self._clock.ask()
            self._changed.notify_all()
        self._thread.join()

    def _take(self, words: str, order: _Order) -> str | None:
        with self._changed:
            if self._is_closed or self._is_lost:
                return self._said if self._is_lost else "the gantry was left"
            if self._is_moving or self._order is not None:
                return "the gantry is still moving"
            self._order = words, order
            self._changed.notify_all()
        return None

    def _work(self) -> None:
        try:
            with self._opening(self._clock) as gantry:
                self._axes = gantry.axes
                self._state = gantry.state()
                self._opened.set()
                self._serve(gantry)
        except UvgsError as error:
            self._errors.append(error)
            with self._changed:
                self._said, self._is_lost, self._is_moving = str(error), True, False
        finally:
            self._opened.set()

    def _serve(self, gantry: Gantry) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_closed or self._order is not None, _LOOK_S)
                if self._is_closed:
                    return
                order, self._order = self._order, None
                if order is not None:
                    self._clock.forget()
                    self._is_moving = True
                    self._said = order[0]
            if order is not None:
                said = self._carried_out(gantry, *order)
                # First where it is, then that it rests: nobody may take the old position for the new one.
                self._state = gantry.state()
                with self._changed:
                    self._is_moving, self._said = False, said
            else:
                self._state = gantry.state()

    def _carried_out(self, gantry: Gantry, words: str, order: _Order) -> str:
        """Do it, or stop it; what came of it in one line. Raises UvgsError when the gantry does not stop or is lost."""
        try:
            with self._clock.armed():
                order(gantry)
        except _StopAsked:
            gantry.stop()
            return f"{words}: stopped"
        except EnvelopeError as error:
            return f"refused: {error}"
        except UvgsError as error:
            return f"{words}: {error}"
        return f"{words}: done"
