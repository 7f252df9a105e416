"""A live camera read in a thread of its own, so that a slow sensor gets new captures instead of old ones."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Literal, Self

from uvgs_bench.devices.cameras.source import CameraSource, ExposureControl, FreeRunning, OwnClock
from uvgs_bench.devices.clock import Clock, RealClock
from uvgs_bench.errors import CameraLost, CaptureError
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.units import ns_from_s, s_from_ns

AFTER_GAP = "after_gap"
"""Flag of the first capture after the camera was lost."""

# A consumer that is late once in a while loses nothing; one that is late always is at most so many captures behind.
_DEPTH = 2
# Between two attempts to open a lost camera, and how often a waiting consumer looks for a signal.
_RETRY_S = 0.5
_LOOK_S = 0.2
# A driver that hangs in a read must not hang the end of the program.
_JOIN_S = 3.0


@dataclass(frozen=True, slots=True)
class CameraNews:
    """What happened to a live camera.

    Args:
        kind: ``lost``, or ``returned``.
        text: One line for people.
        gap_s: How long nothing came, s; 0 while it is lost.
    """

    kind: Literal["lost", "returned"]
    text: str
    gap_s: float = 0.0


class LiveQueue:
    """The captures of a live camera in order; when the consumer is late the oldest waiting one is dropped and counted.

    Indices run over everything the camera delivered, so that dropped captures are gaps in them. A camera that stops
    delivering is opened again until it comes back or the patience is at its end.

    Args:
        source: The open camera.
        reopen: Opens it again after a loss; raises CaptureError while it is away.
        tell: Called in the consumer's thread when the camera is lost and when it is back.
        warm_up: First captures to throw away: exposure and gain of many cameras settle over some frames.
        patience_s: How long to wait for a lost camera, s; 0 makes the first loss an error.
        clock: The clock of the captures' instants.
    """

    def __init__(
        self,
        source: CameraSource,
        reopen: Callable[[], CameraSource],
        tell: Callable[[CameraNews], None],
        *,
        warm_up: int = 0,
        patience_s: float = 60.0,
        clock: Clock | None = None,
    ) -> None:
        self.dropped = 0
        self.gaps_s: list[float] = []
        self.asked_exposure_s: float | None = None
        self._source = source
        self._reopen = reopen
        self._tell = tell
        self._warm_up = warm_up
        self._patience_s = patience_s
        self._clock = clock or RealClock()
        self._waiting: deque[Capture] = deque()
        self._news: deque[CameraNews] = deque()
        self._changed = threading.Condition()
        self._failure: Exception | None = None
        self._is_ended = False
        self._stop = threading.Event()
        self._after_gap = -1
        self._count = 0
        self._last_ns = -1
        self._thread = threading.Thread(target=self._read, name="camera", daemon=True)

    @property
    def exposure(self) -> ExposureControl | None:
        """The exposure of the camera that is open now, or None when it cannot be set."""
        return _QueueExposure(self) if isinstance(self._source, ExposureControl) else None

    def age_s(self, capture: Capture) -> float:
        """How long ago a capture was taken, s, by the clock that stamped it."""
        clock = self._source if isinstance(self._source, OwnClock) else self._clock
        return s_from_ns(clock.now_ns() - capture.t_ns)

    def flags_of(self, capture: Capture) -> tuple[str, ...]:
        """Flags of a capture that came from here."""
        return (AFTER_GAP,) if capture.index == self._after_gap else ()

    def __iter__(self) -> Iterator[Capture]:
        """Captures until the camera ends.

        Raises:
            CameraLost: The camera is lost and did not come back in time.
        """
        if not self._thread.is_alive() and not self._is_ended:
            self._thread.start()
        while True:
            with self._changed:
                while not (self._waiting or self._news or self._is_ended):
                    self._changed.wait(_LOOK_S)
                news = self._news.popleft() if self._news else None
                capture = self._waiting.popleft() if self._waiting and news is None else None
            if news is not None:
                self._tell(news)
            elif capture is not None:
                yield capture
            elif self._failure is not None:
                raise self._failure
            else:
                return

    def close(self) -> None:
        """Stop reading and release the camera. Safe to call twice."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(_JOIN_S)
        self._source.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _read(self) -> None:
        try:
            for _ in range(self._warm_up):
                if self._stop.is_set() or self._next() is None:
                    break
            while not self._stop.is_set():
                capture = self._next()
                if capture is None:
                    break
                self._put(capture)
        except Exception as error:
            # Whatever it is, it is raised where the captures are consumed.
            self._failure = error
        with self._changed:
            self._is_ended = True
            self._changed.notify_all()

    def _next(self) -> Capture | None:
        while True:
            try:
                source = self._source
                return source.next_capture() if isinstance(source, FreeRunning) else source.grab()
            except CaptureError as error:
                if self._stop.is_set():
                    return None
                if self._patience_s <= 0.0:
                    raise CameraLost(str(error)) from None
                self._wait_for_return(error)

    def _wait_for_return(self, loss: CaptureError) -> None:
        since_ns = self._clock.now_ns() if self._last_ns < 0 else self._last_ns
        self._say(CameraNews("lost", f"{loss}; waiting {self._patience_s:g} s for it to come back"))
        with suppress(CaptureError):
            self._source.close()
        until_ns = self._clock.now_ns() + ns_from_s(self._patience_s)
        while not self._stop.wait(_RETRY_S):
            try:
                self._source = self._reopen()
                if self.asked_exposure_s is not None and isinstance(self._source, ExposureControl):
                    self._source.set_exposure_s(self.asked_exposure_s)
            except CaptureError as error:
                if self._clock.now_ns() > until_ns:
                    raise CameraLost(
                        f"lost, and not back within {self._patience_s:g} s: {error}", self._source.spec
                    ) from None
                continue
            gap_s = s_from_ns(self._clock.now_ns() - since_ns)
            self.gaps_s.append(gap_s)
            with self._changed:
                self._after_gap = self._count
            self._say(CameraNews("returned", f"{self._source.spec}: back after a gap of {gap_s:.1f} s", gap_s))
            return
        raise CameraLost(str(loss))

    def _put(self, capture: Capture) -> None:
        with self._changed:
            capture = replace(capture, index=self._count)
            self._count += 1
            self._last_ns = capture.t_ns
            if len(self._waiting) >= _DEPTH:
                gone = self._waiting.popleft()
                self.dropped += 1
                if gone.index == self._after_gap:
                    self._after_gap += 1
            self._waiting.append(capture)
            self._changed.notify_all()

    def _say(self, news: CameraNews) -> None:
        with self._changed:
            self._news.append(news)
            self._changed.notify_all()


class _QueueExposure:
    """The exposure of whichever camera a queue has open; a lost camera takes it when it is back."""

    def __init__(self, queue: LiveQueue) -> None:
        self._queue = queue
        self._last_s = self._control.exposure_s

    @property
    def _control(self) -> ExposureControl:
        source: object = self._queue._source
        assert isinstance(source, ExposureControl)
        return source

    @property
    def exposure_s(self) -> float:
        return self._control.exposure_s

    @property
    def exposure_limits_s(self) -> tuple[float, float]:
        return self._control.exposure_limits_s

    @property
    def full_scale_dn(self) -> float:
        return self._control.full_scale_dn

    @property
    def settling_captures(self) -> int:
        # Those that wait were taken before.
        return self._control.settling_captures + _DEPTH

    def set_exposure_s(self, exposure_s: float) -> float:
        self._queue.asked_exposure_s = exposure_s
        with suppress(CaptureError):
            self._last_s = self._control.set_exposure_s(exposure_s)
        return self._last_s
