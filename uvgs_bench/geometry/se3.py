"""SO(3) and SE(3): exponential, logarithm, adjoint and Jacobians, accurate near 0 and near pi, compiled.

Tangent order is ``xi = (omega, v)``, rotation first; the update is on the left, ``T <- exp(xi^) T``.

Source: T. D. Barfoot, State Estimation for Robotics, chapter 7; J. Solà et al., A micro Lie theory, appendices B and D.
"""

from __future__ import annotations

from math import atan2, cos, sin, sqrt

import numpy as np

from uvgs_bench.geometry.arrays import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.geometry.small_matrices import product, times

# Below this squared angle the series with three terms is exact to double precision.
_SMALL_ANGLE_SQUARED = 1e-4
_SINE_OF_80_DEG = 0.984807753012208


@compiled
def hat(w: FloatArray) -> FloatArray:
    """Skew-symmetric matrix of a vector, ``hat(w) @ p == cross(w, p)``.

    Args:
        w: Vector, shape (3,).

    Returns:
        Matrix, shape (3, 3).
    """
    out = np.zeros((3, 3))
    out[0, 1] = -w[2]
    out[0, 2] = w[1]
    out[1, 0] = w[2]
    out[1, 2] = -w[0]
    out[2, 0] = -w[1]
    out[2, 1] = w[0]
    return out


@compiled
def _series(angle_squared: float) -> tuple[float, float, float]:
    """Coefficients sin(a)/a, (1 - cos(a))/a^2, (a - sin(a))/a^3, stable at a = 0."""
    if angle_squared < _SMALL_ANGLE_SQUARED:
        a2 = angle_squared
        return (
            1.0 - a2 / 6.0 * (1.0 - a2 / 20.0 * (1.0 - a2 / 42.0)),
            0.5 - a2 / 24.0 * (1.0 - a2 / 30.0 * (1.0 - a2 / 56.0)),
            1.0 / 6.0 - a2 / 120.0 * (1.0 - a2 / 42.0 * (1.0 - a2 / 72.0)),
        )
    a = sqrt(angle_squared)
    s_half = sin(0.5 * a)
    return sin(a) / a, 2.0 * s_half * s_half / angle_squared, (a - sin(a)) / (angle_squared * a)


@compiled
def so3_exp(w: FloatArray) -> FloatArray:
    """Rotation matrix of a rotation vector (Rodrigues).

    Args:
        w: Rotation vector, shape (3,), rad.

    Returns:
        Rotation, shape (3, 3).
    """
    a, b, _ = _series(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    W = hat(w)
    return np.eye(3) + a * W + b * product(W, W)


@compiled
def quaternion_from_rotation(R: FloatArray) -> FloatArray:
    """Unit quaternion (x, y, z, w), w >= 0, of a rotation, by the largest of four pivots (Shepperd).

    Args:
        R: Rotation, shape (3, 3).

    Returns:
        Quaternion, shape (4,), scalar last.
    """
    q = np.empty(4)
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace >= R[0, 0] and trace >= R[1, 1] and trace >= R[2, 2]:
        q[3] = 1.0 + trace
        q[0] = R[2, 1] - R[1, 2]
        q[1] = R[0, 2] - R[2, 0]
        q[2] = R[1, 0] - R[0, 1]
    else:
        i = 0
        if R[1, 1] > R[0, 0]:
            i = 1
        if R[2, 2] > R[i, i]:
            i = 2
        j = (i + 1) % 3
        k = (i + 2) % 3
        q[i] = 1.0 + R[i, i] - R[j, j] - R[k, k]
        q[j] = R[j, i] + R[i, j]
        q[k] = R[k, i] + R[i, k]
        q[3] = R[k, j] - R[j, k]
    norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[3] < 0.0:
        norm = -norm
    return q / norm


@compiled
def rotation_from_quaternion(q: FloatArray) -> FloatArray:
    """Rotation of a quaternion (x, y, z, w); the quaternion is normalised first.

    Args:
        q: Quaternion, shape (4,), scalar last, not zero.

    Returns:
        Rotation, shape (3, 3).
    """
    n = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    x = q[0] / n
    y = q[1] / n
    z = q[2] / n
    w = q[3] / n
    R = np.empty((3, 3))
    R[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    R[0, 1] = 2.0 * (x * y - z * w)
    R[0, 2] = 2.0 * (x * z + y * w)
    R[1, 0] = 2.0 * (x * y + z * w)
    R[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    R[1, 2] = 2.0 * (y * z - x * w)
    R[2, 0] = 2.0 * (x * z - y * w)
    R[2, 1] = 2.0 * (y * z + x * w)
    R[2, 2] = 1.0 - 2.0 * (x * x + y * y)
    return R


@compiled
def rotation_defect(R: FloatArray) -> tuple[float, float]:
    """How far a matrix is from a rotation.

    Args:
        R: Matrix, shape (3, 3).

    Returns:
        Largest element of ``|R R^T - 1|``, NaN when an element of R is not finite; determinant of R.
    """
    worst = 0.0
    for i in range(3):
        for j in range(i + 1):
            product = R[i, 0] * R[j, 0] + R[i, 1] * R[j, 1] + R[i, 2] * R[j, 2]
            worst = max(worst, abs(product - (1.0 if i == j else 0.0)))
    c0 = R[1, 1] * R[2, 2] - R[1, 2] * R[2, 1]
    c1 = R[1, 2] * R[2, 0] - R[1, 0] * R[2, 2]
    c2 = R[1, 0] * R[2, 1] - R[1, 1] * R[2, 0]
    det = R[0, 0] * c0 + R[0, 1] * c1 + R[0, 2] * c2
    # 0 x is 0, or NaN when x is not finite; a maximum alone would pass over a NaN.
    spoilt = 0.0
    for i in range(3):
        for j in range(3):
            spoilt += 0.0 * R[i, j]
    return worst + spoilt, det


@compiled
def so3_log(R: FloatArray) -> FloatArray:
    """Rotation vector of a rotation, angle in [0, pi]; by quaternion, so that no digits are lost near 0 or pi.

    Args:
        R: Rotation, shape (3, 3).

    Returns:
        Rotation vector, shape (3,), rad.
    """
    q = quaternion_from_rotation(R)
    s2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2]
    s = sqrt(s2)
    if s < 1e-8:
        # 2 atan(s / w) / s = (2 / w) (1 - s^2 / (3 w^2)); the square is below double precision here.
        factor = 2.0 / q[3]
    else:
        factor = 2.0 * atan2(s, q[3]) / s
    out = np.empty(3)
    out[0] = factor * q[0]
    out[1] = factor * q[1]
    out[2] = factor * q[2]
    return out


@compiled
def so3_left_jacobian(w: FloatArray) -> FloatArray:
    """Left Jacobian of SO(3): ``exp((w + dw)^) ~ exp((J dw)^) exp(w^)``.

    Args:
        w: Rotation vector, shape (3,), rad.

    Returns:
        Matrix, shape (3, 3).
    """
    _, b, c = _series(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    W = hat(w)
    return np.eye(3) + b * W + c * product(W, W)


@compiled
def so3_left_jacobian_inverse(w: FloatArray) -> FloatArray:
    """Inverse of the left Jacobian of SO(3); singular only at angle 2 pi.

    Args:
        w: Rotation vector, shape (3,), rad, angle below 2 pi.

    Returns:
        Matrix, shape (3, 3).
    """
    a2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if a2 < _SMALL_ANGLE_SQUARED:
        c = 1.0 / 12.0 + a2 / 720.0 + a2 * a2 / 30240.0
    else:
        a = sqrt(a2)
        half = 0.5 * a
        # (1 - (a/2) cot(a/2)) / a^2; the cotangent stays finite up to and beyond pi.
        c = (1.0 - half * cos(half) / sin(half)) / a2
    W = hat(w)
    out: FloatArray = np.eye(3) - 0.5 * W + c * product(W, W)
    return out


@compiled
def se3_exp(xi: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation and translation of a twist.

    Args:
        xi: Twist (omega, v), shape (6,), rad and m.

    Returns:
        R, shape (3, 3), and t, shape (3,), m.
    """
    w = xi[:3].copy()
    return so3_exp(w), times(so3_left_jacobian(w), xi[3:])


@compiled
def se3_log(R: FloatArray, t: FloatArray) -> FloatArray:
    """Twist of a rigid transform.

    Args:
        R: Rotation, shape (3, 3).
        t: Translation, shape (3,), m.

    Returns:
        Twist (omega, v), shape (6,), rad and m.
    """
    out = np.empty(6)
    w = so3_log(R)
    out[:3] = w
    out[3:] = times(so3_left_jacobian_inverse(w), t)
    return out


@compiled
def se3_adjoint(R: FloatArray, t: FloatArray) -> FloatArray:
    """Adjoint: ``T exp(xi^) T^-1 = exp((Ad xi)^)``, rotation first.

    Args:
        R: Rotation, shape (3, 3).
        t: Translation, shape (3,), m.

    Returns:
        Matrix, shape (6, 6).
    """
    out = np.zeros((6, 6))
    out[:3, :3] = R
    out[3:, 3:] = R
    out[3:, :3] = product(hat(t), R)
    return out


@compiled
def _q_block(w: FloatArray, v: FloatArray) -> FloatArray:
    """Lower-left block of the SE(3) left Jacobian. Source: Barfoot, equation 7.86b."""
    W = hat(w)
    V = hat(v)
    a2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if a2 < 1e-2:
        # Series: (a - sin a)/a^3; (1 - a^2/2 - cos a)/a^4 with sign; the combination of both.
        c1 = 1.0 / 6.0 - a2 / 120.0 + a2 * a2 / 5040.0 - a2 * a2 * a2 / 362880.0
        c2 = 1.0 / 24.0 - a2 / 720.0 + a2 * a2 / 40320.0 - a2 * a2 * a2 / 3628800.0
        c3 = 1.0 / 120.0 - a2 / 2520.0 + a2 * a2 / 120960.0 - a2 * a2 * a2 / 9979200.0
    else:
        a = sqrt(a2)
        a4 = a2 * a2
        c1 = (a - sin(a)) / (a2 * a)
        c2 = (a2 / 2.0 + cos(a) - 1.0) / a4
        c3 = (2.0 * a - 3.0 * sin(a) + a * cos(a)) / (2.0 * a4 * a)
    WV = product(W, V)
    VW = product(V, W)
    WVW = product(WV, W)
    WWV = product(W, WV)
    VWW = product(VW, W)
    out: FloatArray = 0.5 * V + c1 * (WV + VW + WVW) + c2 * (WWV + VWW - 3.0 * WVW)
    out += c3 * (product(WVW, W) + product(W, WVW))
    return out


@compiled
def se3_left_jacobian(xi: FloatArray) -> FloatArray:
    """Left Jacobian of SE(3): ``exp((xi + d)^) ~ exp((J d)^) exp(xi^)``.

    Args:
        xi: Twist (omega, v), shape (6,), rad and m.

    Returns:
        Matrix, shape (6, 6).
    """
    w = xi[:3].copy()
    J = so3_left_jacobian(w)
    out = np.zeros((6, 6))
    out[:3, :3] = J
    out[3:, 3:] = J
    out[3:, :3] = _q_block(w, xi[3:].copy())
    return out


@compiled
def se3_left_jacobian_inverse(xi: FloatArray) -> FloatArray:
    """Inverse of the left Jacobian of SE(3).

    Args:
        xi: Twist (omega, v), shape (6,), rad and m, angle below 2 pi.

    Returns:
        Matrix, shape (6, 6).
    """
    w = xi[:3].copy()
    K = so3_left_jacobian_inverse(w)
    out = np.zeros((6, 6))
    out[:3, :3] = K
    out[3:, 3:] = K
    out[3:, :3] = -product(product(K, _q_block(w, xi[3:].copy())), K)
    return out


def rotation_angle(R: FloatArray) -> float:
    """Angle of a rotation in [0, pi], accurate to the last digits near 0 and near pi.

    Args:
        R: Rotation, shape (3, 3).

    Returns:
        Angle, rad.
    """
    return float(np.linalg.norm(so3_log(np.ascontiguousarray(R, dtype=np.float64))))


def nearest_rotation(M: FloatArray) -> FloatArray:
    """The rotation nearest to a matrix in the Frobenius norm (orthogonal Procrustes).

    Args:
        M: Matrix, shape (3, 3).

    Returns:
        Rotation, shape (3, 3), determinant +1.
    """
    U, _, Vt = np.linalg.svd(M)
    d = 1.0 if np.linalg.det(U @ Vt) > 0.0 else -1.0
    return np.ascontiguousarray(U @ np.diag([1.0, 1.0, d]) @ Vt)


def mean_rotation(rotations: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Chordal mean of rotations, refined to the Karcher mean.

    Args:
        rotations: Rotations, shape (N, 3, 3), N >= 1, within a half turn of each other.
        weights: Weights, shape (N,), not negative; equal when None.

    Returns:
        Rotation, shape (3, 3).

    Source: Markley et al., Averaging Quaternions, 2007; Hartley et al., Rotation Averaging, 2013.
    """
    w = np.ones(len(rotations)) if weights is None else np.asarray(weights, dtype=np.float64)
    w = w / w.sum()
    R = nearest_rotation(np.einsum("n,nij->ij", w, rotations))
    for _ in range(20):
        step = np.zeros(3)
        for weight, other in zip(w, rotations, strict=True):
            step += weight * so3_log(np.ascontiguousarray(R.T @ other))
        R = np.ascontiguousarray(R @ so3_exp(step))
        if float(np.linalg.norm(step)) < 1e-14:
            break
    return R


def rotation_from_euler_zyx(yaw_rad: float, pitch_rad: float, roll_rad: float) -> FloatArray:
    """Rotation of intrinsic Z-Y-X Euler angles: ``Rz(yaw) Ry(pitch) Rx(roll)``. For files and reports only.

    Args:
        yaw_rad: Angle about z, rad.
        pitch_rad: Angle about the new y, rad.
        roll_rad: Angle about the newest x, rad.

    Returns:
        Rotation, shape (3, 3).
    """
    z = so3_exp(np.array([0.0, 0.0, yaw_rad]))
    y = so3_exp(np.array([0.0, pitch_rad, 0.0]))
    x = so3_exp(np.array([roll_rad, 0.0, 0.0]))
    return np.ascontiguousarray(z @ y @ x)


def euler_zyx_from_rotation(R: FloatArray) -> tuple[float, float, float]:
    """Intrinsic Z-Y-X Euler angles of a rotation. For reports only; at pitch +-pi/2 roll is set to 0.

    Args:
        R: Rotation, shape (3, 3).

    Returns:
        yaw, pitch, roll, rad; pitch in [-pi/2, pi/2].
    """
    cosine = float(np.hypot(R[0, 0], R[1, 0]))
    pitch = atan2(-float(R[2, 0]), cosine)
    if cosine < 1e-9:
        return atan2(-float(R[0, 1]), float(R[1, 1])), pitch, 0.0
    return atan2(float(R[1, 0]), float(R[0, 0])), pitch, atan2(float(R[2, 1]), float(R[2, 2]))


def is_near_gimbal_lock(R: FloatArray) -> bool:
    """Whether yaw and roll of a rotation trade with one another: its pitch is beyond 80 degrees.

    Args:
        R: Rotation, shape (3, 3).

    Returns:
        Whether its Euler angles should not be read one by one.
    """
    return bool(abs(R[2, 0]) > _SINE_OF_80_DEG)


def angle_between(a: FloatArray, b: FloatArray) -> float:
    """Angle between two vectors in [0, pi], accurate for nearly parallel ones.

    Args:
        a: Vector, shape (3,), not zero.
        b: Vector, shape (3,), not zero.

    Returns:
        Angle, rad.
    """
    return atan2(float(np.linalg.norm(np.cross(a, b))), float(np.dot(a, b)))
