"""A simulated inertial unit: what a body on a known path would feel, with white noise and biases that wander."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.navigation.imu import ImuNoise, ImuSamples
from uvgs_bench.navigation.rigid import RigidState
from uvgs_bench.units import ns_from_s


@dataclass(frozen=True, slots=True)
class TrueImu:
    """What is true of the unit, and unknown to whoever uses it.

    Args:
        noise: Its noise.
        acceleration_bias_sigma_mps2: Deviation the biases of its accelerometers are drawn with at switch-on, m/s^2.
        rate_bias_sigma_radps: Deviation the biases of its gyroscopes are drawn with, rad/s.
        rate_hz: Readings per second, Hz.
        clock_offset_s: How much later than the truth its readings are stamped, s.
    """

    noise: ImuNoise = ImuNoise()  # noqa: RUF009 - frozen
    acceleration_bias_sigma_mps2: float = 0.05
    rate_bias_sigma_radps: float = 0.005
    rate_hz: float = 125.0
    clock_offset_s: float = 0.0

    def __post_init__(self) -> None:
        if not self.rate_hz > 0.0:
            raise ValueError(f"rate_hz must be positive, got {self.rate_hz}")
        if min(self.acceleration_bias_sigma_mps2, self.rate_bias_sigma_radps) < 0.0:
            raise ValueError("deviations of biases must not be negative")


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedImu:
    """Readings with the biases that were in them.

    Args:
        samples: The readings.
        acceleration_bias_mps2: True bias at each reading, shape (N, 3), m/s^2.
        rate_bias_radps: True bias at each reading, shape (N, 3), rad/s.
    """

    samples: ImuSamples
    acceleration_bias_mps2: FloatArray
    rate_bias_radps: FloatArray


def simulate_imu(
    motion: Callable[[float], RigidState],
    duration_s: float,
    truth: TrueImu,
    gravity_mps2: FloatArray,
    rng: np.random.Generator,
) -> SimulatedImu:
    """Read a simulated unit along a path.

    Args:
        motion: The body at a time, s, ``world_from_body``.
        duration_s: How long, s.
        truth: The unit.
        gravity_mps2: Gravity in world axes, shape (3,), m/s^2.
        rng: Source of noise and biases.

    Returns:
        Readings from 0 s on, with their biases.
    """
    step_s = 1.0 / truth.rate_hz
    times_s = np.arange(int(duration_s * truth.rate_hz) + 1) * step_s
    count, noise = len(times_s), truth.noise
    sigmas = np.repeat((truth.acceleration_bias_sigma_mps2, truth.rate_bias_sigma_radps), 3)
    walks = np.repeat((noise.acceleration_walk_mps3_rthz, noise.rate_walk_radps2_rthz), 3) * np.sqrt(step_s)
    whites = np.repeat((noise.acceleration_noise_mps2_rthz, noise.rate_noise_radps_rthz), 3) / np.sqrt(step_s)
    steps = walks * rng.standard_normal((count, 6))
    steps[0] = sigmas * rng.standard_normal(6)
    bias = np.cumsum(steps, axis=0)
    exact = np.empty((count, 6))
    for row, t_s in zip(exact, times_s, strict=True):
        state = motion(float(t_s))
        row[:3] = (state.acceleration_mps2 - gravity_mps2) @ state.pose.R
        row[3:] = state.rate_radps
    read = exact + bias + whites * rng.standard_normal((count, 6))
    t_ns = np.array([ns_from_s(float(t_s) + truth.clock_offset_s) for t_s in times_s], dtype=np.int64)
    samples = ImuSamples(t_ns, read_only(read[:, :3]), read_only(read[:, 3:]))
    return SimulatedImu(samples, read_only(bias[:, :3]), read_only(bias[:, 3:]))
