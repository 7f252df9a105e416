"""Many poses at once: logarithms, adjoints and Jacobians over a leading axis, for tables of thousands of captures."""

from __future__ import annotations

import numpy as np

from uvgs_bench.geometry import FloatArray

# Bernoulli numbers over factorials of x / (e^x - 1), powers 2, 4, 6, 8, 10; odd powers above the first vanish.
_BERNOULLI = (1.0 / 12.0, -1.0 / 720.0, 1.0 / 30240.0, -1.0 / 1209600.0, 1.0 / 47900160.0)
_NEGLIGIBLE = 1e-15


def hats(w: FloatArray) -> FloatArray:
    """Skew-symmetric matrices.

    Args:
        w: Vectors, shape (N, 3).

    Returns:
        Matrices, shape (N, 3, 3).
    """
    out = np.zeros((len(w), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -w[:, 2], w[:, 1], -w[:, 0]
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = w[:, 2], -w[:, 1], w[:, 0]
    return out


def rotation_logs(R: FloatArray) -> FloatArray:
    """Rotation vectors, angle in [0, pi], by quaternion so that no digits are lost near 0 or pi.

    Args:
        R: Rotations, shape (N, 3, 3).

    Returns:
        Rotation vectors, shape (N, 3), rad.
    """
    from scipy.spatial.transform import Rotation

    # Below a sixth of a turn the skew part alone keeps all digits, and costs a fraction.
    skew = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine = np.sqrt((skew**2).sum(axis=1))
    cosine = 0.5 * (R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2] - 1.0)
    vectors: FloatArray = (
        skew * np.where(sine > 1e-9, np.arctan2(sine, cosine) / np.maximum(sine, 1e-300), 1.0)[:, None]
    )
    is_far = ~(cosine > 0.5)
    if is_far.any():
        vectors[is_far] = Rotation.from_matrix(R[is_far]).as_rotvec()
    return vectors


def pose_logs(R: FloatArray, t_m: FloatArray) -> FloatArray:
    """Twists (omega, v) of rigid transforms.

    Args:
        R: Rotations, shape (N, 3, 3).
        t_m: Translations, shape (N, 3), m.

    Returns:
        Twists, shape (N, 6), rad and m.
    """
    w = rotation_logs(R)
    angle_squared = (w**2).sum(axis=1)
    is_small = angle_squared < 1e-4
    safe = np.where(is_small, 1.0, angle_squared)
    half = 0.5 * np.sqrt(safe)
    exact = (1.0 - half * np.cos(half) / np.sin(half)) / safe
    series = 1.0 / 12.0 + angle_squared / 720.0 + angle_squared**2 / 30240.0
    c = np.where(is_small, series, exact)
    wt = np.cross(w, t_m)
    return np.concatenate([w, t_m - 0.5 * wt + c[:, None] * np.cross(w, wt)], axis=1)


def adjoints(R: FloatArray, t_m: FloatArray) -> FloatArray:
    """Adjoint matrices, rotation first.

    Args:
        R: Rotations, shape (N, 3, 3).
        t_m: Translations, shape (N, 3), m.

    Returns:
        Matrices, shape (N, 6, 6).
    """
    out = np.zeros((len(R), 6, 6))
    out[:, :3, :3] = R
    out[:, 3:, 3:] = R
    out[:, 3:, :3] = hats(t_m) @ R
    return out


def left_jacobian_inverses(xi: FloatArray) -> FloatArray:
    """Inverses of the left Jacobian of SE(3) by its Bernoulli series, exact to 1e-10 for angles below 0.6 rad.

    The truncation reaches 1e-3 at pi; only captures that are wrong altogether are that far from their prediction.

    Args:
        xi: Twists (omega, v), shape (N, 6), rad and m.

    Returns:
        Matrices, shape (N, 6, 6).
    """
    ad = np.zeros((len(xi), 6, 6))
    W = hats(xi[:, :3])
    ad[:, :3, :3] = W
    ad[:, 3:, 3:] = W
    ad[:, 3:, :3] = hats(xi[:, 3:])
    out = np.eye(6) - 0.5 * ad
    power = squared = ad @ ad
    # A power 2k of a twist goes with its angle to the 2k - 1; what is below rounding is not worth its products.
    angle = float(np.sqrt((xi[:, :3] ** 2).sum(axis=1).max(initial=0.0)))
    for k, coefficient in enumerate(_BERNOULLI):
        if k and abs(coefficient) * angle ** (2 * k + 1) < _NEGLIGIBLE:
            break
        if k:
            power = power @ squared
        out += coefficient * power
    return out
