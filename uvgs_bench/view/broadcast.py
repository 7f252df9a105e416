"""The newest capture for everyone who looks. Made once, only while someone looks, in a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from time import monotonic

from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.view.live_state import LiveState
from uvgs_bench.view.packet import Packet, make_packet, past_rows

MOST_HZ = 25.0
_LOOK_S = 0.2


class Broadcast:
    """Makes packets of the newest captures; a slow listener gets the newest one when it is ready again.

    Args:
        state: What the stream shows.
        sensors: One sensor per beacon, by the beacon's name; may be replaced in place.
        most_hz: Most packets a second.
    """

    def __init__(self, state: LiveState, sensors: Mapping[str, Uvgs], most_hz: float = MOST_HZ) -> None:
        self._state = state
        self._period_s = 1.0 / most_hz
        self.sensors = sensors
        """One sensor per beacon."""
        self._changed = threading.Condition()
        self._newest: Packet | None = None
        self._listeners = 0
        self._is_closed = False
        self._thread = threading.Thread(target=self._work, name="view", daemon=True)
        self._thread.start()

    @property
    def is_over(self) -> bool:
        """Whether nothing more comes."""
        return self._is_closed or self._state.is_over

    def newest(self) -> Packet | None:
        """The newest packet, or None before the first."""
        with self._changed:
            return self._newest

    def past_points(self, until: int) -> list[list[float | None]]:
        """Rows of curves up to the capture of a number, for someone who has just come."""
        return past_rows([point for point in self._state.past() if point.number <= until])

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Packets are made as long as someone is within this."""
        with self._changed:
            self._listeners += 1
            self._changed.notify_all()
        try:
            yield
        finally:
            with self._changed:
                self._listeners -= 1

    def wait_newer(self, number: int, timeout_s: float) -> Packet | None:
        """The newest packet as soon as it is newer than a number; None when there was none in time, or at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_closed or self._number > number, timeout_s)
            return self._newest if self._number > number else None

    def close(self) -> None:
        """End it. Safe to call twice."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self._thread.join()

    @property
    def _number(self) -> int:
        return 0 if self._newest is None else self._newest.number

    def _work(self) -> None:
        due_s = 0.0
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_closed or self._listeners > 0)
                if self._is_closed:
                    return
                self._changed.wait_for(lambda: self._is_closed, max(due_s - monotonic(), 0.0))
            shown = self._state.wait_newer(self._number, _LOOK_S)
            if shown is None:
                if self._state.is_over:
                    with self._changed:
                        self._changed.wait_for(lambda: self._is_closed, _LOOK_S)
                continue
            due_s = monotonic() + self._period_s
            ask = self._state.gantry
            gantry = None if ask is None else ask()
            packet = make_packet(shown, self._state.past(self._number), self.sensors, gantry)
            with self._changed:
                self._newest = packet
                self._changed.notify_all()
