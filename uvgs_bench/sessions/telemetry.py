"""Answers told while the stream runs, at a rate of their own, to whoever listens: nothing here holds up the stream."""

from __future__ import annotations

import re
import socket
from collections.abc import Callable
from pathlib import Path
from time import monotonic

from uvgs_bench.errors import ConfigError
from uvgs_bench.interop.udp import datagram
from uvgs_bench.sessions.events import EventSink, Remark
from uvgs_bench.sessions.outlets import Outlet
from uvgs_bench.sessions.stream import Answered

_ADDRESS = re.compile(r"(?:\[(?P<six>[^\]]+)\]|(?P<host>[^:]+)):(?P<port>\d{1,5})")


class RateLimit:
    """Says which captures are told when not all of them are.

    Args:
        rate_hz: Most captures a second; None tells all.
        now_s: A clock, s.
    """

    def __init__(self, rate_hz: float | None, now_s: Callable[[], float] = monotonic) -> None:
        self._period_s = 0.0 if rate_hz is None else 1.0 / rate_hz
        self._now_s = now_s
        self._due_s: float | None = None
        self.skipped = 0
        """Captures left out since the last one that was told."""

    def is_due(self) -> bool:
        """Whether the capture that came now is to be told; counts it when not."""
        now_s = self._now_s()
        if self._due_s is not None and now_s < self._due_s:
            self.skipped += 1
            return False
        # Along a raster, so that a camera a little faster than the limit does not lose every second capture.
        due_s = now_s if self._due_s is None else self._due_s
        following_s = due_s + self._period_s
        self._due_s = following_s if following_s > now_s else now_s + self._period_s
        return True

    def told(self) -> int:
        """How many captures were left out before the one that is told now; counts anew."""
        skipped, self.skipped = self.skipped, 0
        return skipped


class RateLimited:
    """An outlet that gets no more than so many answers a second.

    Args:
        outlet: The outlet.
        rate_hz: Most answers a second.
    """

    def __init__(self, outlet: Outlet, rate_hz: float) -> None:
        self._outlet = outlet
        self._limit = RateLimit(rate_hz)

    @property
    def paths(self) -> tuple[Path, ...]:
        """Those of the outlet."""
        return self._outlet.paths

    def put(self, answered: Answered) -> None:
        """Hand on or leave out."""
        if self._limit.is_due():
            self._limit.told()
            self._outlet.put(answered)

    def close(self) -> None:
        """Close the outlet."""
        self._outlet.close()


class UdpTelemetry:
    """One JSON datagram per capture (``interop.udp``). What cannot be sent at once is lost and counted.

    Args:
        address: ``HOST:PORT``, an IPv6 host in brackets.
        sink: Where losses are told.
        rate_hz: Most datagrams a second; None sends one per capture.

    Raises:
        ConfigError: It is no such address, or the host is unknown.
    """

    def __init__(self, address: str, sink: EventSink, rate_hz: float | None = None) -> None:
        self._address = address
        self._sink = sink
        self._limit = RateLimit(rate_hz)
        self._sequence = self._lost = 0
        family, self._to = _resolved(address)
        self._socket: socket.socket | None = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    @property
    def paths(self) -> tuple[Path, ...]:
        """No files."""
        return ()

    def put(self, answered: Answered) -> None:
        """Send, unless the rate limit leaves it out."""
        if self._socket is None or not self._limit.is_due():
            return
        payload = datagram(answered.capture, answered.lines, answered.active, self._sequence, self._limit.told())
        self._sequence += 1
        try:
            self._socket.sendto(payload, self._to)
        except OSError as error:
            if not self._lost:
                text = f"udp {self._address}: a datagram could not be sent: {error.strerror or error}"
                self._sink(Remark("warning", text))
            self._lost += 1

    def close(self) -> None:
        """Close the socket and say what was lost. Safe to call twice."""
        if self._socket is None:
            return
        self._socket.close()
        self._socket = None
        if self._lost:
            text = f"udp {self._address}: {self._lost} of {self._sequence} datagrams could not be sent"
            self._sink(Remark("warning", text))


def _resolved(address: str) -> tuple[int, tuple[object, ...]]:
    match = _ADDRESS.fullmatch(address)
    if match is None or not 0 < int(match["port"]) < 1 << 16:
        raise ConfigError(f"expected HOST:PORT, got '{address}'", "--udp")
    try:
        # Once: a name server that does not answer must not hold up a capture.
        found = socket.getaddrinfo(match["six"] or match["host"], int(match["port"]), type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise ConfigError(f"the host of '{address}' is unknown: {getattr(error, 'strerror', error)}", "--udp") from None
    # A name may mean both internets; listeners that do not care listen to the older one.
    best = min(found, key=lambda entry: entry[0] != socket.AF_INET)
    return best[0], best[4]
