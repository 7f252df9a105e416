"""What else may differ from the nominal bench besides the two poses: axis scale, squareness, and the camera's clock.

A term moves the carriage: ``t' = M (t - v tau)`` in gantry axes, with ``M = I + U`` and U upper triangular. The first
axis keeps its direction, later axes lean towards earlier ones. Rotary axes have no terms.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from uvgs_bench.accuracy.distributions import t_quantiles
from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.units import NS_PER_S

TERM_GROUPS: dict[str, int] = {"axis_scale": 3, "squareness": 3, "time_offset": 1, "time_rate": 1}
"""Terms a registration may be asked to fit, with the number of their parameters, in the order of the parameters."""
TERM_COUNT = 8
SENSOR_COUNT = 2

# Positions further than this from a linear function of the axis positions are turned by a rotary axis.
_STRAIGHT_M = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class AxisTerms:
    """How the linear motion of the carriage differs from the nominal axes, along the axes of the gantry frame.

    Args:
        scale: Relative excess of travel along gantry x, y, z, shape (3,).
        shear_rad: Lean of a later axis towards an earlier one, in the order xy, xz, yz, shape (3,), rad.
        covariance: Covariance of scales and shears, shape (6, 6); zero along what is held.
        null_directions: Directions of (scale, shear) held at zero because they were not asked for, not justified, not
            seen, or look like an error of the sensor's own scale, orthonormal rows, shape (k, 6).
        degrees_of_freedom: How well the variance of each is known, shape (6,).
    """

    scale: FloatArray
    shear_rad: FloatArray
    covariance: FloatArray
    null_directions: FloatArray
    degrees_of_freedom: FloatArray = field(default_factory=lambda: np.full(6, np.inf))

    @property
    def matrix(self) -> FloatArray:
        """``M`` of ``t' = M t``, shape (3, 3)."""
        return axis_matrix(np.concatenate([self.scale, self.shear_rad]))

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations of scales and shears, shape (6,), 1 and rad; zero where held."""
        return read_only(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def half_widths(self) -> FloatArray:
        """Half of the 95 % intervals of scales and shears, shape (6,), 1 and rad; zero where held."""
        return read_only(self.sigmas * t_quantiles(0.975, self.degrees_of_freedom))


def axis_matrix(errors: FloatArray) -> FloatArray:
    """``M`` of scales x, y, z and shears xy, xz, yz.

    Args:
        errors: Scales and shears, shape (6,), 1 and rad.

    Returns:
        Upper triangular matrix, shape (3, 3).
    """
    sx, sy, sz, xy, xz, yz = errors
    return np.array([[1.0 + sx, xy, xz], [0.0, 1.0 + sy, yz], [0.0, 0.0, 1.0 + sz]])


def moved_carriage_m(obs: Observations, terms: FloatArray, origin_ns: int) -> FloatArray:
    """Where the carriage truly was at the instants of the captures.

    Args:
        obs: Captures; only the gantry's fields are used.
        terms: Scales x, y, z, shears xy, xz, yz (1, rad), time offset (s) and its rate (s/s), shape (8,).
        origin_ns: Instant at which the offset is the time offset, ns.

    Returns:
        Translations of gantry_from_carriage, shape (N, 3), m.
    """
    lag_s = terms[6] + terms[7] * _elapsed_s(obs, origin_ns)
    out: FloatArray = (obs.t_gs_m - obs.velocity_gs_mps * lag_s[:, None]) @ axis_matrix(terms[:6]).T
    return out


def carriage_jacobian(obs: Observations, terms: FloatArray, origin_ns: int) -> FloatArray:
    """Derivative of ``moved_carriage_m`` by the terms, shape (N, 3, 8)."""
    elapsed_s = _elapsed_s(obs, origin_ns)
    t_m = obs.t_gs_m - obs.velocity_gs_mps * (terms[6] + terms[7] * elapsed_s)[:, None]
    out = np.zeros((obs.count, 3, TERM_COUNT))
    for axis in range(3):
        out[:, axis, axis] = t_m[:, axis]
    for k, (earlier, later) in enumerate(((0, 1), (0, 2), (1, 2))):
        out[:, earlier, 3 + k] = t_m[:, later]
    out[:, :, 6] = -obs.velocity_gs_mps @ axis_matrix(terms[:6]).T
    out[:, :, 7] = out[:, :, 6] * elapsed_s[:, None]
    return out


def term_jacobian(obs: Observations, left: Pose, terms: FloatArray, origin_ns: int) -> FloatArray:
    """Derivative of the left tangent of each prediction by the terms.

    Args:
        obs: Captures.
        left: The left pose.
        terms: As for ``moved_carriage_m``.
        origin_ns: Likewise, ns.

    Returns:
        Derivatives, shape (N, 6, 8): a term turns nothing, so its twist is a mere shift.
    """
    moved = carriage_jacobian(obs, terms, origin_ns)
    if obs.mount == "camera_on_carriage":
        moved = -obs.R_gs.transpose(0, 2, 1) @ moved
    return np.concatenate([np.zeros_like(moved), left.R @ moved], axis=1)


def sensor_jacobian(t_predicted_m: FloatArray) -> FloatArray:
    """Derivative of the left tangent of a pose by two errors of scale the sensor itself may have.

    Args:
        t_predicted_m: Predicted translations of camera_from_beacon, shape (N, 3), m.

    Returns:
        Derivatives, shape (N, 6, 2): relative error of depth (focal length), and of all lengths (size of the beacon).
    """
    out = np.zeros((len(t_predicted_m), 6, SENSOR_COUNT))
    out[:, 5, 0] = t_predicted_m[:, 2]
    out[:, 3:, 1] = t_predicted_m
    return out


def sensor_like_terms(obs: Observations, left: Pose) -> FloatArray:
    """Combinations of axis terms that look like an error of the sensor's own scale.

    Args:
        obs: Captures.
        left: The left pose.

    Returns:
        Orthonormal rows (scale, shear), shape (2, 6): all axes alike look like a wrong size of the beacon; travel along
        the line of sight, with the leans that go with it, looks like a wrong focal length.
    """
    sight = np.broadcast_to(left.R[2], (obs.count, 3))
    if obs.mount == "camera_on_carriage":
        sight = np.einsum("nij,j->ni", obs.R_gs, left.R[2])
    x, y, z = sight.T
    depth = np.array([(pair).mean() for pair in (x * x, y * y, z * z, 2.0 * x * y, 2.0 * x * z, 2.0 * y * z)])
    size = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    return np.ascontiguousarray(np.linalg.qr(np.column_stack([size, depth]))[0].T)


def is_straight(obs: Observations) -> bool:
    """Whether the carriage's place is a linear function of the axis positions, so that axis terms mean something."""
    rows = np.column_stack([np.ones(obs.count), obs.axis_position])
    rest = obs.t_gs_m - rows @ np.linalg.lstsq(rows, obs.t_gs_m, rcond=None)[0]
    return bool(np.abs(rest).max() < _STRAIGHT_M)


def _elapsed_s(obs: Observations, origin_ns: int) -> FloatArray:
    return np.asarray((obs.t_ns - origin_ns) / NS_PER_S, dtype=np.float64)
