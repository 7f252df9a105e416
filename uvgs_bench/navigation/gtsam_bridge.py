"""What stands between us and GTSAM: parameters, the library itself, and its conventions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import so3_exp


@dataclass(frozen=True, slots=True)
class GraphConfig:
    """Parameters of the graph.

    Args:
        lag_s: How far back states are still estimated anew, s.
        pause_s: After so long without a pose a node is added all the same, s.
        huber_k: From this length of a factor's whitened residual on it weighs less. For six numbers; 1.345, made for
            one, would weigh down most good poses.
        factors: Whether the sensor enters as ``pose`` or as the pixels of its LEDs, ``led``.
        learns_beacon: Whether the beacon's place is a variable.
        beacon_sigma_m: How well it is known at first, per axis, m.
        beacon_sigma_rad: The same for its attitude, rad.

    Raises:
        ValueError: A parameter is not positive.
    """

    lag_s: float = 1.5
    pause_s: float = 0.25
    huber_k: float = 3.5
    factors: Literal["pose", "led"] = "pose"
    learns_beacon: bool = False
    beacon_sigma_m: float = 0.02
    beacon_sigma_rad: float = 0.02

    def __post_init__(self) -> None:
        for name in ("lag_s", "pause_s", "huber_k", "beacon_sigma_m", "beacon_sigma_rad"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


def load_gtsam() -> Any:
    """The library.

    Raises:
        ConfigError: It is not installed.
    """
    try:
        import gtsam
    except ImportError:
        raise ConfigError("the factor graph needs GTSAM: pip install 'uvgs-bench[fusion]'", "--method graph") from None
    return gtsam


def body_covariance(world_from_body: Pose, place_covariance: FloatArray) -> FloatArray:
    """Covariance of GTSAM's tangent (right, body axes) from that of (rotation, position) in world axes.

    Args:
        world_from_body: The pose.
        place_covariance: Shape (6, 6), rad and m.

    Returns:
        Shape (6, 6), rad and m.
    """
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = world_from_body.R.T
    result: FloatArray = turn @ place_covariance @ turn.T
    return result


def middle_force(force_mps2: FloatArray, rate_radps: FloatArray, dt_s: float) -> FloatArray:
    """A force over a step, in the axes the body has at its beginning.

    GTSAM turns a reading by the attitude at the beginning of its step. On Earth, where every reading holds gravity, the
    half step it lags behind is a false acceleration of ``rate g dt / 2``: 5 mm/s^2 at 0.1 rad/s and 100 Hz.

    Args:
        force_mps2: Mean specific force over the step, body axes, shape (3,), m/s^2.
        rate_radps: Mean rate over the step, shape (3,), rad/s.
        dt_s: Length of the step, s.

    Returns:
        Shape (3,), m/s^2.
    """
    return so3_exp(0.5 * dt_s * rate_radps) @ force_mps2
