"""What else may differ from the nominal bench besides the two poses: axis scale, squareness, and the camera's clock.

A term moves the carriage: ``t' = M (t - v tau)`` in gantry axes, with ``M = I + U`` and U upper triangular. The first
axis keeps its direction, later axes lean towards earlier ones. Rotary axes have no terms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.geometry import FloatArray, read_only

TERM_GROUPS: dict[str, int] = {"axis_scale": 3, "squareness": 3, "time_offset": 1, "time_rate": 1}
"""Terms a registration may be asked to fit, with the number of their parameters, in the order of the parameters."""


@dataclass(frozen=True, slots=True, eq=False)
class AxisTerms:
    """How the linear motion of the carriage differs from the nominal axes, along the axes of the gantry frame.

    Args:
        scale: Relative excess of travel along gantry x, y, z, shape (3,).
        shear_rad: Lean of a later axis towards an earlier one, in the order xy, xz, yz, shape (3,), rad.
        covariance: Covariance of scales and shears, shape (6, 6); zero along what is held.
        null_directions: Directions of (scale, shear) that the data cannot tell from the sensor's own scale, held at
            zero and so left with the sensor, orthonormal rows, shape (k, 6).
    """

    scale: FloatArray
    shear_rad: FloatArray
    covariance: FloatArray
    null_directions: FloatArray

    @property
    def matrix(self) -> FloatArray:
        """``M`` of ``t' = M t``, shape (3, 3)."""
        return axis_matrix(np.concatenate([self.scale, self.shear_rad]))

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations of scales and shears, shape (6,), 1 and rad; zero where held."""
        return read_only(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))


def axis_matrix(errors: FloatArray) -> FloatArray:
    """``M`` of scales x, y, z and shears xy, xz, yz.

    Args:
        errors: Scales and shears, shape (6,), 1 and rad.

    Returns:
        Upper triangular matrix, shape (3, 3).
    """
    sx, sy, sz, xy, xz, yz = errors
    return np.array([[1.0 + sx, xy, xz], [0.0, 1.0 + sy, yz], [0.0, 0.0, 1.0 + sz]])
