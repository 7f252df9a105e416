"""How much latency the follower's loop bears, from the loop itself: sampled, held, smoothed and late.

The position loop near its station is linear: a double integrator, sampled once a period; the line through the last
samples; two gains; a delay of any length; a hold between commands. All of it is one matrix, exact for a delay of any
fraction of a period; the loop is stable while its eigenvalues lie inside the unit circle.

Source: K. J. Astrom, B. Wittenmark, Computer-Controlled Systems, section 2.3 (sampling with a delay).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, pi

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.navigation.pose_filter import line_weights

# How finely the first loss of stability is looked for before it is bisected: in periods, or in parts of the loop's own
# time where that is longer; and how far, s.
_SCAN_PERIODS, _SCAN_RAD = 0.25, 0.02
_LONGEST_S = 20.0
_DELAY_TOLERANCE_S = 1e-6
_FREQUENCIES = 4000


@dataclass(frozen=True, slots=True)
class Loop:
    """One axis of the follower near its station.

    Args:
        frequency_radps: Natural frequency of the law, rad/s.
        damping: Its damping ratio.
        period_s: Time between captures and so between commands, s.
        window: Poses the line goes through.

    Raises:
        ValueError: A value that is not positive, or fewer than two poses.
    """

    frequency_radps: float
    damping: float
    period_s: float
    window: int

    def __post_init__(self) -> None:
        if not (self.frequency_radps > 0.0 and self.damping > 0.0 and self.period_s > 0.0):
            raise ValueError("frequency, damping and period must be positive")
        if self.window < 2:
            raise ValueError(f"window must be at least 2, got {self.window}")

    def weights(self) -> FloatArray:
        """Acceleration per position error of the newest, second newest, ... sample, shape (window,), 1/s^2."""
        at, rate = line_weights(-self.period_s * np.arange(self.window, dtype=np.float64))
        kp, kd = self.frequency_radps**2, 2.0 * self.damping * self.frequency_radps
        result: FloatArray = -(kp * at + kd * rate)
        return result


@dataclass(frozen=True, slots=True)
class Margins:
    """How far a loop is from losing its stability.

    Args:
        latency_s: The latency it has, from mid-exposure to the command, s.
        largest_latency_s: The least latency at which it is no longer stable, s; inf when there is none within 20 s.
        phase_margin_rad: Phase left at the crossover, rad; negative when unstable.
        crossover_radps: Frequency at which the open loop has gain one, rad/s.
        gain_margin: Factor the gain may grow by; inf without bound.
        spectral_radius: Largest modulus of the eigenvalues from sample to sample; stable below 1.
    """

    latency_s: float
    largest_latency_s: float
    phase_margin_rad: float
    crossover_radps: float
    gain_margin: float
    spectral_radius: float

    @property
    def is_stable(self) -> bool:
        """Whether the loop is stable at the latency it has."""
        return self.spectral_radius < 1.0

    @property
    def delay_margin_s(self) -> float:
        """Latency that may be added, s; negative when there is too much already."""
        return self.largest_latency_s - self.latency_s


def find_margins(loop: Loop, latency_s: float) -> Margins:
    """Margins of a loop at the latency it has.

    Args:
        loop: The loop.
        latency_s: From the instant of a capture to when the command made from it takes hold, s.

    Returns:
        The margins.

    Raises:
        ValueError: The latency is negative or not finite.
    """
    radius = spectral_radius(loop, latency_s)
    phase_rad, crossover_radps, gain = _frequency_margins(loop, latency_s)
    return Margins(latency_s, largest_latency(loop), phase_rad, crossover_radps, gain, radius)


def largest_latency(loop: Loop) -> float:
    """The least latency at which the loop loses its stability, s; 0 when it has none without latency, inf beyond 20 s.

    Args:
        loop: The loop.

    Returns:
        The latency, s.
    """
    step = max(_SCAN_PERIODS * loop.period_s, _SCAN_RAD / loop.frequency_radps)
    low = 0.0
    if spectral_radius(loop, low) >= 1.0:
        return 0.0
    while spectral_radius(loop, low + step) < 1.0:
        low += step
        if low > _LONGEST_S:
            return np.inf
    high = low + step
    while high - low > _DELAY_TOLERANCE_S:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if spectral_radius(loop, middle) < 1.0 else (low, middle)
    return low


def spectral_radius(loop: Loop, latency_s: float) -> float:
    """Largest modulus of the eigenvalues of the closed loop from one capture to the next.

    Args:
        loop: The loop.
        latency_s: From the instant of a capture to its command, s.

    Returns:
        The radius; the loop is stable below 1.

    Raises:
        ValueError: The latency is negative or not finite.
    """
    return float(np.abs(np.linalg.eigvals(transition(loop, latency_s))).max())


def transition(loop: Loop, latency_s: float) -> FloatArray:
    """What one period does to the state: position, velocity, earlier positions, earlier commands.

    Args:
        loop: The loop.
        latency_s: From the instant of a capture to its command, s.

    Returns:
        The matrix, shape (2 + window - 1 + late + 1, same), where ``late`` is the number of whole periods of latency.

    Raises:
        ValueError: The latency is negative or not finite.
    """
    late, rest_s = _split(loop, latency_s)
    T, n = loop.period_s, loop.window
    first = 2 + n - 1
    size = first + late + 1
    A = np.zeros((size, size))
    gains = loop.weights()
    # The command made from this sample; a_now[j] is the command made j samples ago.
    row = np.zeros(size)
    row[0] = gains[0]
    row[2:first] = gains[1:]
    commands = np.vstack((row, np.eye(size)[first:]))
    newer, older = commands[late], commands[late + 1]
    held_s = T - rest_s
    A[0, :2] = 1.0, T
    A[0] += (rest_s * T - 0.5 * rest_s**2) * older + 0.5 * held_s**2 * newer
    A[1, 1] = 1.0
    A[1] += rest_s * older + held_s * newer
    if n > 1:
        A[2, 0] = 1.0
        A[3:first, 2 : first - 1] = np.eye(n - 2)
    A[first:] = commands[: late + 1]
    return A


def _split(loop: Loop, latency_s: float) -> tuple[int, float]:
    if not 0.0 <= latency_s < np.inf:
        raise ValueError(f"a latency must not be negative, got {latency_s}")
    late = int(latency_s // loop.period_s)
    return late, latency_s - late * loop.period_s


def _frequency_margins(loop: Loop, latency_s: float) -> tuple[float, float, float]:
    """Phase margin (rad), crossover (rad/s) and gain margin of the open loop."""
    late, rest_s = _split(loop, latency_s)
    T = loop.period_s
    w = np.geomspace(1e-3 * loop.frequency_radps, pi / T, max(_FREQUENCIES, ceil(pi / T)))
    z = np.exp(1j * w * T)
    held_s = T - rest_s
    # Position per command: the held double integrator, exact with a delay of a fraction of a period.
    velocity = (rest_s / z + held_s) / (z - 1.0)
    position = (T * velocity + (rest_s * T - 0.5 * rest_s**2) / z + 0.5 * held_s**2) / (z - 1.0)
    law = sum(g * z ** (-k) for k, g in enumerate(loop.weights()))
    # Negative feedback: the law's weights carry their sign.
    response = -position * z ** (-late) * law
    gain, phase = np.abs(response), np.unwrap(np.angle(response))
    # At low frequency a double integrator lags by half a turn.
    phase -= 2.0 * pi * round((phase[0] + pi) / (2.0 * pi))
    crossings = np.flatnonzero((gain[:-1] >= 1.0) & (gain[1:] < 1.0))
    if not crossings.size:
        return np.nan, np.nan, np.nan
    margins = []
    for i in crossings:
        share = np.log(gain[i]) / np.log(gain[i] / gain[i + 1])
        margins.append((phase[i] + share * (phase[i + 1] - phase[i]) + pi, w[i] + share * (w[i + 1] - w[i])))
    phase_rad, crossover_radps = min(margins)
    turns = np.flatnonzero((phase[:-1] > -pi) & (phase[1:] <= -pi))
    gain_margin = float(1.0 / gain[turns].max()) if turns.size else np.inf
    return float(phase_rad), float(crossover_radps), gain_margin
