"""The error-state filter: readings of an inertial unit carried through time, corrected by measured poses.

Measurements may come late: the filter keeps a window of its past, goes back to the instant a measurement holds for,
corrects there, and carries everything that came since forward again. The answer is the same as if it had come in time.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.navigation.filter_kernels import (
    ERROR_SIZE,
    STATE_SIZE,
    correct,
    innovation_covariance,
    pose_residual,
    propagate,
)
from uvgs_bench.navigation.gate import CHI2_99_6, InnovationGate
from uvgs_bench.navigation.imu import STANDARD_GRAVITY_MPS2, ImuNoise
from uvgs_bench.navigation.states import NavigationState, PoseMeasurement
from uvgs_bench.units import s_from_ns

POSE_ROWS = np.array([6, 7, 8, 0, 1, 2])
"""Which errors a measured pose sees: rotation, then position."""
_VELOCITY_ROWS = np.array([3, 4, 5])
_EMPTY = np.zeros((ERROR_SIZE, ERROR_SIZE))

START_SIGMAS = (0.1, 0.1, 0.01)
"""Deviations of velocity (m/s), accelerometer bias (m/s^2) and gyroscope bias (rad/s) of which nothing is known."""

Status = Literal["fused", "refused", "reopened", "too_old"]


@dataclass(frozen=True, slots=True)
class FilterConfig:
    """Parameters of the filter.

    Args:
        noise: Noise of the inertial unit.
        gravity_mps2: Gravity in world axes, m/s^2; zeros in free fall.
        gate_chi2: Largest squared Mahalanobis distance of a pose (6 degrees of freedom) that is believed; the default
            is 99 %.
        reopen_after: After so many refused poses in a row that agree with one another, the next that agrees is
            believed after all.
        buffer_steps: How many steps of the past are kept for late measurements.
        max_gap_s: A pause of the unit longer than this is a gap: what happened in it is not known, s.
        gap_acceleration_mps2: Deviation of the unknown mean acceleration in a gap, per axis, m/s^2.
        gap_rate_radps: Deviation of the unknown mean rate in a gap, per axis, rad/s.

    Raises:
        ValueError: A parameter that cannot be meant.
    """

    noise: ImuNoise = field(default_factory=ImuNoise)
    gravity_mps2: tuple[float, float, float] = (0.0, 0.0, -STANDARD_GRAVITY_MPS2)
    gate_chi2: float = CHI2_99_6
    reopen_after: int = 2
    buffer_steps: int = 400
    max_gap_s: float = 0.1
    gap_acceleration_mps2: float = 0.5
    gap_rate_radps: float = 0.5

    def __post_init__(self) -> None:
        if len(self.gravity_mps2) != 3 or not np.isfinite(self.gravity_mps2).all():
            raise ValueError("gravity_mps2 must be three numbers")
        if self.reopen_after < 1:
            raise ValueError(f"reopen_after must be at least 1, got {self.reopen_after}")
        if self.buffer_steps < 2:
            raise ValueError(f"buffer_steps must be at least 2, got {self.buffer_steps}")
        for name in ("gate_chi2", "max_gap_s", "gap_acceleration_mps2", "gap_rate_radps"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, eq=False)
class UpdateRecord:
    """What became of one measurement.

    Args:
        t_ns: The instant it holds for, ns.
        source: Who measured.
        status: ``fused``; ``refused`` by the gate; ``reopened``: believed because it agrees with those refused
            before; ``too_old``: from before the window of the past.
        nis: Squared Mahalanobis distance of the innovation, 6 degrees of freedom; NaN when too old.
        delay_s: How long before the newest reading it held, s.
        innovation: Measured minus expected: rotation (rad), position (m), shape (6,).
    """

    t_ns: int
    source: str
    status: Status
    nis: float
    delay_s: float
    innovation: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Believed:
    t_ns: int
    rows: NDArray[np.int64]
    noise: FloatArray
    R: FloatArray
    place: FloatArray
    opens: bool


def start_state(
    measurement: PoseMeasurement,
    *,
    velocity_sigma_mps: float = START_SIGMAS[0],
    acceleration_bias_sigma_mps2: float = START_SIGMAS[1],
    rate_bias_sigma_radps: float = START_SIGMAS[2],
    acceleration_bias_mps2: FloatArray | None = None,
    rate_bias_radps: FloatArray | None = None,
) -> NavigationState:
    """A first state: at a measured pose, at rest and without biases as far as known.

    Args:
        measurement: The first pose.
        velocity_sigma_mps: Deviation of each component of the velocity, m/s.
        acceleration_bias_sigma_mps2: Deviation of each accelerometer's bias, m/s^2.
        rate_bias_sigma_radps: Deviation of each gyroscope's bias, rad/s.
        acceleration_bias_mps2: Bias of the accelerometers as measured at rest, shape (3,), or None.
        rate_bias_radps: Bias of the gyroscopes as measured at rest, shape (3,), or None.

    Returns:
        The state.
    """
    P = np.zeros((ERROR_SIZE, ERROR_SIZE))
    P[np.ix_(POSE_ROWS, POSE_ROWS)] = measurement.covariance
    sigmas = (velocity_sigma_mps, acceleration_bias_sigma_mps2, rate_bias_sigma_radps)
    for begin, sigma in zip((3, 9, 12), sigmas, strict=True):
        P[range(begin, begin + 3), range(begin, begin + 3)] = sigma**2
    zero = np.zeros(3)
    return NavigationState(
        measurement.t_ns,
        measurement.world_from_body,
        read_only(zero),
        read_only(zero if acceleration_bias_mps2 is None else acceleration_bias_mps2),
        read_only(zero if rate_bias_radps is None else rate_bias_radps),
        read_only(P),
    )


class ErrorStateFilter:
    """A filter of 15 errors over one inertial unit and any number of sources of poses.

    Args:
        start: Where it begins.
        config: Parameters.
    """

    def __init__(self, start: NavigationState, config: FilterConfig | None = None) -> None:
        self.config = FilterConfig() if config is None else config
        self.gaps_s: list[tuple[int, float]] = []
        self._size = self.config.buffer_steps + 1
        self._noise = self.config.noise.vector()
        self._gravity = read_only(self.config.gravity_mps2)
        self._gate = InnovationGate(self.config.gate_chi2, self.config.reopen_after)
        self._t = np.zeros(self._size, dtype=np.int64)
        self._readings = np.zeros((self._size, 6))
        self._states = np.zeros((self._size, STATE_SIZE))
        self._P = np.zeros((self._size, ERROR_SIZE, ERROR_SIZE))
        self._head = 0
        self._believed: list[_Believed] = []
        self._is_gap = np.zeros(self._size, dtype=bool)
        self._reading: FloatArray | None = None
        self._reading_ns = start.t_ns
        self._fused_ns: dict[str, int] = {}
        self._t[0] = start.t_ns
        self._states[0] = packed(start)
        self._P[0] = start.covariance

    @property
    def t_ns(self) -> int:
        """The instant of the newest state, ns."""
        return int(self._t[self._head % self._size])

    @property
    def state(self) -> NavigationState:
        """The newest state."""
        k = self._head % self._size
        return unpacked(int(self._t[k]), self._states[k], self._P[k])

    def add_imu(self, t_ns: int, acceleration_mps2: FloatArray, rate_radps: FloatArray) -> None:
        """Carry the state to the instant of a reading; those from before the state only prepare the first step.

        Args:
            t_ns: Instant of the reading, ns, later than the last one.
            acceleration_mps2: Specific force in body axes, shape (3,), m/s^2.
            rate_radps: Rate in body axes, shape (3,), rad/s.
        """
        reading = np.concatenate((acceleration_mps2, rate_radps))
        last, self._reading = self._reading, reading
        before_ns, self._reading_ns = self._reading_ns, t_ns
        if t_ns <= self.t_ns:
            return
        gap_s = s_from_ns(t_ns - before_ns)
        if gap_s > self.config.max_gap_s:
            self.gaps_s.append((before_ns, gap_s))
        self._append(t_ns, reading if last is None else 0.5 * (last + reading), gap_s)

    def add_pose(self, measurement: PoseMeasurement) -> UpdateRecord:
        """Correct the state by a measured pose, at the instant it holds for.

        Args:
            measurement: The pose. One from after the newest reading carries the state there with that reading.

        Returns:
            What became of it.
        """
        delay_s = s_from_ns(self.t_ns - measurement.t_ns)
        believed = _Believed(
            measurement.t_ns,
            POSE_ROWS,
            measurement.covariance,
            measurement.world_from_body.R,
            measurement.world_from_body.t_m,
            False,
        )
        base = self._base_of(measurement.t_ns)
        if base is None:
            return UpdateRecord(measurement.t_ns, measurement.source, "too_old", np.nan, delay_s, np.full(6, np.nan))
        state, P = self._state_at(base, measurement.t_ns)
        residual = _residual(state, believed)
        L, distance = innovation_covariance(P, believed.noise, POSE_ROWS, residual)
        source, t_ns = measurement.source, measurement.t_ns
        status = self._gate.judge(source, t_ns, distance, residual, believed.noise, P)
        record = UpdateRecord(t_ns, source, status, distance, delay_s, read_only(residual))
        if status == "refused":
            return record
        if status == "reopened":
            believed = _Believed(t_ns, POSE_ROWS, believed.noise, believed.R, believed.place, True)
        self._believe(base, believed, state, P, L if status == "fused" else None, residual)
        self._fused_ns[source] = max(t_ns, self._fused_ns.get(source, t_ns))
        return record

    def add_zero_velocity(self, t_ns: int, sigma_mps: float) -> bool:
        """Say that the body stood still at an instant.

        Args:
            t_ns: The instant, ns.
            sigma_mps: Deviation of each component of its velocity, m/s.

        Returns:
            Whether it lay within the window of the past.
        """
        base = self._base_of(t_ns)
        if base is None:
            return False
        state, P = self._state_at(base, t_ns)
        zero = read_only(np.zeros(3))
        still = _Believed(t_ns, _VELOCITY_ROWS, read_only(sigma_mps**2 * np.eye(3)), read_only(np.eye(3)), zero, False)
        self._believe(base, still, state, P, None, _residual(state, still))
        return True

    def seconds_since(self, source: str) -> float:
        """How long ago the last pose of a source was believed, s; inf when none was."""
        t_ns = self._fused_ns.get(source)
        return np.inf if t_ns is None else s_from_ns(self.t_ns - t_ns)

    def _append(self, t_ns: int, reading: FloatArray, unread_s: float) -> None:
        """A step to an instant, so long after the last reading."""
        before, self._head = self._head % self._size, self._head + 1
        k = self._head % self._size
        self._t[k], self._readings[k], self._is_gap[k] = t_ns, reading, unread_s > self.config.max_gap_s
        self._states[k], self._P[k] = self._states[before], self._P[before]
        self._carry(self._states[k], self._P[k], k, int(self._t[before]), t_ns)
        oldest_ns = int(self._t[self._oldest() % self._size])
        while self._believed and self._believed[0].t_ns < oldest_ns:
            self._believed.pop(0)

    def _oldest(self) -> int:
        return max(0, self._head - self._size + 1)

    def _carry(self, state: FloatArray, P: FloatArray, k: int, start_ns: int, end_ns: int) -> None:
        """Carry a state on within the step that ends at place k of the window."""
        dt_s = s_from_ns(end_ns - start_ns)
        noise = self._noise
        if self._is_gap[k]:
            # A density that makes the mean over the gap as unsure as was said.
            noise = noise.copy()
            root_s = np.sqrt(max(dt_s, self.config.max_gap_s))
            noise[0] = np.hypot(noise[0], self.config.gap_acceleration_mps2 * root_s)
            noise[1] = np.hypot(noise[1], self.config.gap_rate_radps * root_s)
        propagate(state, P, _EMPTY, self._readings[k], dt_s, noise, self._gravity, False)

    def _base_of(self, t_ns: int) -> int | None:
        """The step at or before an instant; a new step when the instant is yet to come."""
        if t_ns > self.t_ns:
            reading = self._reading if self._reading is not None else self._at_rest()
            self._append(t_ns, reading, s_from_ns(t_ns - self._reading_ns))
            return self._head
        k, oldest = self._head, self._oldest()
        while k >= oldest and self._t[k % self._size] > t_ns:
            k -= 1
        return k if k >= oldest else None

    def _at_rest(self) -> FloatArray:
        """The reading a body at rest would give, for want of any."""
        s = self._states[self._head % self._size]
        return np.concatenate((s[15:18] - self._gravity @ s[6:15].reshape(3, 3), s[18:21]))

    def _state_at(self, base: int, t_ns: int) -> tuple[FloatArray, FloatArray]:
        """State and covariance at an instant within the step after ``base``, with all that was believed until then."""
        k = base % self._size
        state, P, now_ns = self._states[k].copy(), self._P[k].copy(), int(self._t[k])
        if t_ns > now_ns:
            k = (base + 1) % self._size
            for held in self._between(now_ns, t_ns):
                self._carry_and_correct(state, P, k, now_ns, held)
                now_ns = held.t_ns
            self._carry(state, P, k, now_ns, t_ns)
        return state, P

    def _between(self, after_ns: int, until_ns: int) -> list[_Believed]:
        i = bisect_right(self._believed, after_ns, key=lambda held: held.t_ns)
        j = bisect_right(self._believed, until_ns, key=lambda held: held.t_ns)
        return self._believed[i:j]

    def _carry_and_correct(self, state: FloatArray, P: FloatArray, k: int, now_ns: int, held: _Believed) -> None:
        if held.t_ns > now_ns:
            self._carry(state, P, k, now_ns, held.t_ns)
        self._apply(state, P, held, None, _residual(state, held))

    def _believe(
        self, base: int, held: _Believed, state: FloatArray, P: FloatArray, L: FloatArray | None, residual: FloatArray
    ) -> None:
        """Correct at the measurement's instant, remember it, and carry the result to the newest step."""
        self._apply(state, P, held, L, residual)
        place = bisect_right(self._believed, held.t_ns, key=lambda other: other.t_ns)
        self._believed.insert(place, held)
        is_last = place == len(self._believed) - 1
        k = base % self._size
        if held.t_ns == self._t[k]:
            self._states[k], self._P[k] = state, P
        now_ns = held.t_ns
        for number in range(base + 1, self._head + 1):
            k = number % self._size
            end_ns = int(self._t[k])
            for later in () if is_last else self._between(now_ns, end_ns):
                if later is not held:
                    self._carry_and_correct(state, P, k, now_ns, later)
                    now_ns = later.t_ns
            if end_ns > now_ns:
                self._carry(state, P, k, now_ns, end_ns)
            self._states[k], self._P[k] = state, P
            now_ns = end_ns

    def _apply(
        self, state: FloatArray, P: FloatArray, held: _Believed, L: FloatArray | None, residual: FloatArray
    ) -> None:
        if held.opens:
            widen(P, residual)
        if L is None:
            L, _ = innovation_covariance(P, held.noise, held.rows, residual)
        correct(state, P, L, held.noise, held.rows, residual)


def widen(P: FloatArray, residual: FloatArray) -> None:
    """Admit in place that the state was off by a residual: pose, velocity by as much per second, biases as at first.

    Their correlations are those of a state that was wrong, and are given up.
    """
    variances = np.diag(P).copy()
    variances[POSE_ROWS] += residual**2
    variances[_VELOCITY_ROWS] += residual[3:] ** 2
    variances[9:12] += START_SIGMAS[1] ** 2
    variances[12:] += START_SIGMAS[2] ** 2
    P[:, :] = np.diag(variances)


def _residual(state: FloatArray, held: _Believed) -> FloatArray:
    if len(held.rows) == 3:
        return held.place - state[3:6]
    return pose_residual(state, held.R, held.place)


def packed(state: NavigationState) -> FloatArray:
    """A state as the kernels take it, shape (21,)."""
    pose = state.world_from_body
    return np.concatenate(
        (pose.t_m, state.velocity_mps, pose.R.reshape(9), state.acceleration_bias_mps2, state.rate_bias_radps)
    )


def unpacked(t_ns: int, state: FloatArray, P: FloatArray) -> NavigationState:
    """A state of the kernels as a value."""
    return NavigationState(
        t_ns,
        Pose(state[6:15].reshape(3, 3), state[:3], "world", "body"),
        read_only(state[3:6]),
        read_only(state[15:18]),
        read_only(state[18:21]),
        read_only(P),
    )
