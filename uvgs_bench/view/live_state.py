"""What a running stream shows: the newest answer and a short past, safe to read from any thread."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import nan
from time import monotonic

import numpy as np

from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import euler_zyx_from_rotation
from uvgs_bench.interop.trajectories import LineNote
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.handover import Held
from uvgs_bench.sensor.outcome import Outcome, PoseEstimate
from uvgs_bench.units import s_from_ns

_PAST = 600
_RATE_OVER_S = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class BeaconLine:
    """One beacon in one capture, as it is shown.

    Args:
        name: Its name.
        status: ``ok``, ``held`` or ``miss``.
        reason: ``stage/reason`` of a miss, else empty.
        detail: The miss in words, else empty.
        is_active: Whether it is the one believed.
        flags: What a user should know.
        pose: camera_from_beacon, fresh or held; None for a miss.
        runner_up: The second best pose, or None.
        position_sigma_m: Standard deviations of x, y, z, m; None unless the pose is fresh.
        rotation_sigma_rad: Standard deviations of the rotation about x, y, z, rad; None unless fresh.
        led_px: Centres of its LEDs, shape (n, 2), px; NaN where unseen; None when none were named.
        rms_px: Residual, px; NaN unless fresh.
        margin: Ratio to the runner-up; NaN unless fresh.
        blob_count: Number of candidate blobs.
        held_age_s: Age of a held pose, s; NaN unless held.
    """

    name: str
    status: str
    reason: str
    detail: str
    is_active: bool
    flags: tuple[str, ...]
    pose: Pose | None
    runner_up: Pose | None
    position_sigma_m: FloatArray | None
    rotation_sigma_rad: FloatArray | None
    led_px: FloatArray | None
    rms_px: float
    margin: float
    blob_count: int
    held_age_s: float

    @property
    def euler_zyx_rad(self) -> tuple[float, float, float] | None:
        """Yaw, pitch, roll, intrinsic Z-Y-X, rad."""
        return None if self.pose is None else euler_zyx_from_rotation(self.pose.R)


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """One capture, as it is shown.

    Args:
        capture: The capture.
        lines: Its beacons.
        captures: How many there were so far.
        poses: How many of them had a pose.
        dropped: How many the sensor came too late for.
        rate_hz: Captures per second over the last seconds; 0 at first.
        latency_s: How long after its instant it was answered, s; None for a recording.
        work_s: What the sensor took for it, s.
        total: Number of captures if known.
        shown_s: When it was answered, by the machine's monotonic clock, s.
    """

    capture: Capture
    lines: tuple[BeaconLine, ...]
    captures: int
    poses: int
    dropped: int
    rate_hz: float
    latency_s: float | None
    work_s: float
    total: int | None
    shown_s: float

    @property
    def active(self) -> BeaconLine | None:
        """The line of the beacon that is believed, or the first; None without beacons."""
        return next((line for line in self.lines if line.is_active), self.lines[0] if self.lines else None)


@dataclass(frozen=True, slots=True)
class GantryShown:
    """The gantry, as it is shown.

    Args:
        activity: Its word for what it is doing.
        is_homed: Whether its position means something.
        positions: Each axis with its position in words, ``("X", "-12.000 mm")``.
        said: What came of the last order.
    """

    activity: str
    is_homed: bool
    positions: tuple[tuple[str, str], ...]
    said: str = ""


@dataclass(frozen=True, slots=True)
class PastPoint:
    """What is kept of an older capture, for curves.

    Args:
        number: Number of the capture.
        t_ns: Its instant, ns.
        beacon: The active beacon.
        t_m: Position of the beacon, m; NaN for a miss.
        euler_zyx_rad: Yaw, pitch, roll, rad; NaN for a miss.
    """

    number: int
    t_ns: int
    beacon: str
    t_m: tuple[float, float, float]
    euler_zyx_rad: tuple[float, float, float]


class LiveState:
    """Takes answers from the stream's thread; others look."""

    def __init__(self) -> None:
        self.total: int | None = None
        """Number of captures if known."""
        self.gantry: Callable[[], GantryShown] | None = None
        """Asks for the gantry; None without one."""
        self._changed = threading.Condition()
        self._shown: Shown | None = None
        self._past: deque[PastPoint] = deque(maxlen=_PAST)
        self._arrivals: deque[float] = deque()
        self._captures = self._poses = 0
        self._is_over = False

    @property
    def is_over(self) -> bool:
        """Whether the stream ended."""
        return self._is_over

    def put(
        self,
        capture: Capture,
        lines: Mapping[str, tuple[Outcome | Held, LineNote]],
        *,
        latency_s: float | None = None,
        dropped: int = 0,
    ) -> None:
        """Show a capture.

        Args:
            capture: The capture.
            lines: Outcome and note of each beacon.
            latency_s: How long after its instant it was answered, s.
            dropped: How many captures were dropped so far.
        """
        shown = tuple(_line(name, outcome, note) for name, (outcome, note) in lines.items())
        work_s = sum(sum(_told(outcome).stage_s.values()) for outcome, _ in lines.values())
        now_s = monotonic()
        with self._changed:
            self._captures += 1
            self._poses += any(line.status == "ok" for line in shown)
            self._arrivals.append(now_s)
            while self._arrivals[0] < now_s - _RATE_OVER_S:
                self._arrivals.popleft()
            span_s = now_s - self._arrivals[0]
            rate_hz = (len(self._arrivals) - 1) / span_s if span_s > 0.0 else 0.0
            self._shown = Shown(
                capture, shown, self._captures, self._poses, dropped, rate_hz, latency_s, work_s, self.total, now_s
            )
            if (active := self._shown.active) is not None:
                self._past.append(_past(self._captures, capture.t_ns, active))
            self._changed.notify_all()

    def end(self) -> None:
        """No more captures come."""
        with self._changed:
            self._is_over = True
            self._changed.notify_all()

    def latest(self) -> Shown | None:
        """The newest capture, or None before the first."""
        with self._changed:
            return self._shown

    def wait_newer(self, captures: int, timeout_s: float) -> Shown | None:
        """The newest capture as soon as there were more than so many; None when there was none in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_over or self._captures > captures, timeout_s)
            return self._shown if self._captures > captures else None

    def past(self, after: int = 0) -> tuple[PastPoint, ...]:
        """What is kept of captures with a higher number, oldest first."""
        with self._changed:
            return tuple(point for point in self._past if point.number > after)


def _told(outcome: Outcome | Held) -> Outcome:
    return outcome.miss if isinstance(outcome, Held) else outcome


def _line(name: str, outcome: Outcome | Held, note: LineNote) -> BeaconLine:
    told = _told(outcome)
    if isinstance(told, PoseEstimate):
        return BeaconLine(
            name, "ok", "", "", note.is_active, (*told.flags, *note.flags), told.camera_from_beacon, told.runner_up,
            told.position_sigma_m, told.rotation_sigma_rad, told.led_px, told.rms_px, told.margin, told.blob_count, nan,
        )  # fmt: skip
    held = outcome if isinstance(outcome, Held) else None
    return BeaconLine(
        name, "miss" if held is None else "held", f"{told.stage}/{told.reason}", told.detail, note.is_active,
        note.flags, None if held is None else held.last.camera_from_beacon, None, None, None, told.led_px, nan, nan,
        told.blob_count, nan if held is None else s_from_ns(held.age_ns),
    )  # fmt: skip


def _past(number: int, t_ns: int, line: BeaconLine) -> PastPoint:
    if line.status != "ok" or line.pose is None:
        return PastPoint(number, t_ns, line.name, (nan, nan, nan), (nan, nan, nan))
    x, y, z = np.asarray(line.pose.t_m, dtype=float).tolist()
    euler = line.euler_zyx_rad
    assert euler is not None
    return PastPoint(number, t_ns, line.name, (x, y, z), euler)
