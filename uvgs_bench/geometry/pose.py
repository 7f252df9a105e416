"""A rigid transform that knows its frames and refuses to be composed where they do not meet."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, nan

import numpy as np
from numpy.typing import ArrayLike

from uvgs_bench.errors import FrameMismatch
from uvgs_bench.geometry.arrays import FloatArray, read_only
from uvgs_bench.geometry.se3 import (
    nearest_rotation,
    quaternion_from_rotation,
    rotation_defect,
    rotation_from_quaternion,
    se3_adjoint,
    se3_exp,
    se3_log,
)

FRAMES = ("camera", "beacon", "board", "gantry", "carriage", "body", "world")


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """``target_from_source``: maps points of the source frame into the target frame.

    Args:
        R: Rotation, shape (3, 3), orthonormal to 1e-6 (it is made exactly orthonormal).
        t_m: Translation, shape (3,), m: the source origin in the target frame.
        target: Name of the target frame, one of ``FRAMES``.
        source: Name of the source frame, one of ``FRAMES``.

    Raises:
        ValueError: R is no rotation, or a value is not finite.
        FrameMismatch: A frame name is unknown.
    """

    R: FloatArray
    t_m: FloatArray
    target: str
    source: str

    def __post_init__(self) -> None:
        for frame in (self.target, self.source):
            if frame not in FRAMES:
                raise FrameMismatch(f"unknown frame '{frame}', expected one of {', '.join(FRAMES)}")
        R = np.array(self.R, dtype=np.float64, order="C")
        t_m = read_only(self.t_m, (3,))
        x, y, z = t_m
        drift, det = rotation_defect(R) if R.shape == (3, 3) else (nan, nan)
        if not (isfinite(drift) and isfinite(x) and isfinite(y) and isfinite(z)):
            raise ValueError("a pose needs a finite 3x3 rotation and a finite translation")
        if drift > 1e-6 or det < 0.0:
            raise ValueError(f"not a rotation: |R R^T - 1| = {drift:.1e}, det = {det:.3f}")
        if drift > 1e-14:
            R = nearest_rotation(R)
        R.flags.writeable = False
        object.__setattr__(self, "R", R)
        object.__setattr__(self, "t_m", t_m)

    @classmethod
    def identity(cls, target: str, source: str) -> Pose:
        """The pose of two frames that coincide."""
        return cls(np.eye(3), np.zeros(3), target, source)

    @classmethod
    def from_quaternion(cls, xyzw: ArrayLike, t_m: ArrayLike, target: str, source: str) -> Pose:
        """Build from a quaternion (x, y, z, w), scalar last, normalised here.

        Args:
            xyzw: Quaternion, shape (4,), not zero.
            t_m: Translation, shape (3,), m.
            target: Target frame.
            source: Source frame.

        Returns:
            The pose.

        Raises:
            ValueError: The quaternion is zero or not finite.
        """
        q = np.array(xyzw, dtype=np.float64).reshape(4)
        if not np.isfinite(q).all() or float(np.linalg.norm(q)) < 1e-12:
            raise ValueError("a rotation needs a finite quaternion that is not zero")
        return cls(rotation_from_quaternion(q), np.asarray(t_m, dtype=np.float64), target, source)

    @classmethod
    def exp(cls, xi: ArrayLike, target: str, source: str) -> Pose:
        """The pose of a twist (omega, v), shape (6,), rad and m."""
        R, t = se3_exp(np.array(xi, dtype=np.float64).reshape(6))
        return cls(R, t, target, source)

    def __matmul__(self, other: Pose) -> Pose:
        """Compose: ``a_from_b @ b_from_c = a_from_c``.

        Raises:
            FrameMismatch: The inner frames differ.
        """
        if self.source != other.target:
            raise FrameMismatch(
                f"cannot compose {self.target}_from_{self.source} with {other.target}_from_{other.source}: "
                f"'{self.source}' and '{other.target}' do not meet"
            )
        return Pose(self.R @ other.R, self.R @ other.t_m + self.t_m, self.target, other.source)

    def inverse(self) -> Pose:
        """``source_from_target``."""
        return Pose(self.R.T, -(self.R.T @ self.t_m), self.source, self.target)

    def apply(self, points_m: ArrayLike) -> FloatArray:
        """Map points of the source frame into the target frame.

        Args:
            points_m: Points, shape (3,) or (N, 3), m.

        Returns:
            Points of the same shape, m, in the target frame.
        """
        result: FloatArray = np.asarray(points_m, dtype=np.float64) @ self.R.T + self.t_m
        return result

    def log(self) -> FloatArray:
        """Twist (omega, v), shape (6,), rad and m."""
        return se3_log(self.R, self.t_m)

    def adjoint(self) -> FloatArray:
        """Adjoint matrix, shape (6, 6), rotation first."""
        return se3_adjoint(self.R, self.t_m)

    def perturbed(self, xi: ArrayLike) -> Pose:
        """Left update ``exp(xi^) T`` by a twist (omega, v), shape (6,), in the target frame."""
        R, t = se3_exp(np.array(xi, dtype=np.float64).reshape(6))
        return Pose(R @ self.R, R @ self.t_m + t, self.target, self.source)

    def quaternion_xyzw(self) -> FloatArray:
        """Unit quaternion (x, y, z, w), w >= 0."""
        return quaternion_from_rotation(self.R)

    def matrix(self) -> FloatArray:
        """Homogeneous matrix, shape (4, 4)."""
        out = np.eye(4)
        out[:3, :3] = self.R
        out[:3, 3] = self.t_m
        return out

    def is_close(self, other: Pose, rotation_rad: float, translation_m: float) -> bool:
        """Whether two poses of the same frames agree within both tolerances."""
        if (self.target, self.source) != (other.target, other.source):
            return False
        angle = float(np.linalg.norm((self @ other.inverse()).log()[:3])) if self.source == other.source else np.inf
        return angle <= rotation_rad and float(np.linalg.norm(self.t_m - other.t_m)) <= translation_m
