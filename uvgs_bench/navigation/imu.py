"""An inertial measurement unit: what its noise is, and samples of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.units import s_from_ns

STANDARD_GRAVITY_MPS2 = 9.80665
"""Size of gravity where nothing better is known, m/s^2."""


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """White noise and bias walks of an inertial measurement unit; the defaults are those of a consumer MEMS part.

    A density is the deviation of a mean over one second; a walk is the deviation the bias gathers in one second.

    Args:
        acceleration_noise_mps2_rthz: White noise of each accelerometer, m/s^2 per root Hz.
        rate_noise_radps_rthz: White noise of each gyroscope, rad/s per root Hz.
        acceleration_walk_mps3_rthz: Random walk of each accelerometer's bias, m/s^3 per root Hz.
        rate_walk_radps2_rthz: Random walk of each gyroscope's bias, rad/s^2 per root Hz.

    Raises:
        ValueError: A value is not positive.
    """

    acceleration_noise_mps2_rthz: float = 1.5e-3
    rate_noise_radps_rthz: float = 1.5e-4
    acceleration_walk_mps3_rthz: float = 1.0e-4
    rate_walk_radps2_rthz: float = 1.0e-5

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")

    def vector(self) -> FloatArray:
        """The four values in the order of the fields, shape (4,), for kernels."""
        return read_only([getattr(self, name) for name in self.__slots__])


@dataclass(frozen=True, slots=True, eq=False)
class ImuSamples:
    """Samples in ascending time.

    Args:
        t_ns: Instants, shape (N,), int64, ns, strictly ascending.
        acceleration_mps2: Specific force (what an accelerometer feels: at rest on Earth it points up), axes of the
            body, shape (N, 3), m/s^2.
        rate_radps: Angular velocity, axes of the body, shape (N, 3), rad/s.

    Raises:
        ValueError: Shapes differ, a value is not finite, or time does not ascend.
    """

    t_ns: NDArray[np.int64]
    acceleration_mps2: FloatArray
    rate_radps: FloatArray

    def __post_init__(self) -> None:
        t_ns = np.array(self.t_ns, dtype=np.int64)
        t_ns.flags.writeable = False
        acceleration = read_only(self.acceleration_mps2, (-1, 3))
        rate = read_only(self.rate_radps, (-1, 3))
        if t_ns.ndim != 1 or not len(t_ns) == len(acceleration) == len(rate):
            raise ValueError(f"expected as many instants as samples, got {t_ns.shape}, {acceleration.shape}")
        if not (np.isfinite(acceleration).all() and np.isfinite(rate).all()):
            raise ValueError("a sample is not finite")
        if len(t_ns) > 1 and int(np.diff(t_ns).min()) <= 0:
            raise ValueError("the instants of the samples must ascend")
        object.__setattr__(self, "t_ns", t_ns)
        object.__setattr__(self, "acceleration_mps2", acceleration)
        object.__setattr__(self, "rate_radps", rate)

    def __len__(self) -> int:
        return len(self.t_ns)

    def shifted(self, offset_ns: int) -> ImuSamples:
        """The same samples stamped later by an offset, ns."""
        return ImuSamples(self.t_ns + offset_ns, self.acceleration_mps2, self.rate_radps)

    def between(self, start_ns: int, end_ns: int) -> ImuSamples:
        """The samples of ``start_ns <= t < end_ns``."""
        i, j = np.searchsorted(self.t_ns, (start_ns, end_ns))
        return ImuSamples(self.t_ns[i:j], self.acceleration_mps2[i:j], self.rate_radps[i:j])

    @property
    def rate_hz(self) -> float:
        """Median rate of the samples, Hz; NaN with fewer than two."""
        return 1.0 / s_from_ns(int(np.median(np.diff(self.t_ns)))) if len(self) > 1 else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class StaticBias:
    """What a unit at rest tells about its biases.

    Args:
        rate_bias_radps: Bias of the gyroscopes, shape (3,), rad/s.
        rate_sigma_radps: Its standard deviation per axis, shape (3,), rad/s.
        acceleration_bias_mps2: Bias of the accelerometers, shape (3,), m/s^2.
        acceleration_sigma_mps2: Its standard deviation per axis, shape (3,), m/s^2; with gravity it holds the doubt
            of the attitude.
        is_still: Whether the samples scatter no more than the stated noise allows.
    """

    rate_bias_radps: FloatArray
    rate_sigma_radps: FloatArray
    acceleration_bias_mps2: FloatArray
    acceleration_sigma_mps2: FloatArray
    is_still: bool


def fit_static_bias(
    samples: ImuSamples,
    noise: ImuNoise,
    R_world_from_body: FloatArray,
    attitude_sigma_rad: float,
    gravity_mps2: FloatArray,
) -> StaticBias:
    """Biases of a unit at rest.

    Args:
        samples: Samples at rest, at least 2.
        noise: Noise of the unit.
        R_world_from_body: Attitude at rest, shape (3, 3).
        attitude_sigma_rad: Its standard deviation about each axis, rad.
        gravity_mps2: Gravity in world axes, shape (3,), m/s^2; zero in free fall.

    Returns:
        The biases.

    Raises:
        ValueError: Fewer than 2 samples.
    """
    if len(samples) < 2:
        raise ValueError("biases at rest need at least 2 samples")
    span_s = len(samples) / samples.rate_hz
    felt = samples.acceleration_mps2 + gravity_mps2 @ R_world_from_body
    tilt = attitude_sigma_rad * float(np.linalg.norm(gravity_mps2))
    walks = np.array([noise.acceleration_walk_mps3_rthz, noise.rate_walk_radps2_rthz]) * np.sqrt(span_s)
    whites = np.array([noise.acceleration_noise_mps2_rthz, noise.rate_noise_radps_rthz])
    # Half a step beyond what white noise of this density makes at this rate still counts as rest.
    allowed = 1.5 * whites * np.sqrt(samples.rate_hz) + walks
    scatter = np.array([samples.acceleration_mps2.std(axis=0).max(), samples.rate_radps.std(axis=0).max()])
    sigma = np.hypot(whites / np.sqrt(span_s), walks)
    return StaticBias(
        rate_bias_radps=read_only(samples.rate_radps.mean(axis=0)),
        rate_sigma_radps=read_only(np.full(3, sigma[1])),
        acceleration_bias_mps2=read_only(felt.mean(axis=0)),
        acceleration_sigma_mps2=read_only(np.full(3, np.hypot(sigma[0], tilt))),
        is_still=bool((scatter <= allowed).all()),
    )
