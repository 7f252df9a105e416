"""First guess of a registration in closed form, from differences between stations only.

Relative rotations of two stations and, where the carriage did not turn between them, their displacement are seen by the
camera rotated by the left pose alone: that gives its rotation (Wahba's problem). The right rotation is a chordal mean,
and both translations are linear. Where only one direction is known, the angle about it is scanned.

Source: G. Wahba, 1965; F. L. Markley, Attitude determination using vector observations, 1988.
"""

from __future__ import annotations

import numpy as np

from uvgs_bench.accuracy.tangent import rotation_logs
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.se3 import nearest_rotation, so3_exp

_MOST_STATIONS = 60
_SCAN_STEPS = 24
_ROBUST_PASSES = 6


def start_poses(
    R_g: FloatArray, t_g_m: FloatArray, R_b: FloatArray, t_b_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Guess the left and right pose of ``B_i = left @ G_i @ right``.

    Args:
        R_g: Rotations of G, one per station, shape (S, 3, 3).
        t_g_m: Translations of G, shape (S, 3), m.
        R_b: Rotations of camera_from_beacon, shape (S, 3, 3).
        t_b_m: Translations of camera_from_beacon, shape (S, 3), m.

    Returns:
        R_left, t_left, R_right, t_right. Where the data leave a choice, it is arbitrary but consistent with the data.
    """
    chosen = np.unique(np.linspace(0, len(R_g) - 1, min(len(R_g), _MOST_STATIONS)).round().astype(np.int64))
    R_g, t_g_m, R_b, t_b_m = R_g[chosen], t_g_m[chosen], R_b[chosen], t_b_m[chosen]
    length_m = max(float(np.median(np.linalg.norm(t_b_m, axis=1))), 1e-6)
    there, seen = _direction_pairs(R_g, t_g_m, R_b, t_b_m)
    R_0, axis = _wahba(there, seen)
    if axis is None:
        candidates = [R_0]
    else:
        angles = 2.0 * np.pi * np.arange(_SCAN_STEPS) / _SCAN_STEPS
        candidates = [R_0 @ so3_exp(axis * angle) for angle in angles]
    best: tuple[float, tuple[FloatArray, FloatArray, FloatArray, FloatArray]] | None = None
    for R_left in candidates:
        R_right = _robust_mean((R_left @ R_g).transpose(0, 2, 1) @ R_b)
        t_left, t_right, rest_m = _translations(R_left, R_g, t_g_m, t_b_m)
        turn = np.linalg.norm(rotation_logs(R_b @ (R_left @ R_g @ R_right).transpose(0, 2, 1)), axis=1)
        cost = float(np.median(rest_m)) / length_m + float(np.median(turn))
        # Candidates the data cannot tell apart differ by rounding only; the first stays.
        if best is None or cost < 0.999 * best[0] - 1e-12:
            best = (cost, (R_left, t_left, R_right, t_right))
    assert best is not None
    return best[1]


def _direction_pairs(
    R_g: FloatArray, t_g_m: FloatArray, R_b: FloatArray, t_b_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Vectors of the gantry side and the same vectors as the camera sees them, (M, 3) each, about unit size."""
    i, j = np.triu_indices(len(R_g), 1)
    turn_g = rotation_logs(R_g[i] @ R_g[j].transpose(0, 2, 1))
    angle = np.linalg.norm(turn_g, axis=1)
    # Near a half turn the sign of a rotation vector is a coin toss.
    turned = (angle > 1e-3) & (angle < 3.0)
    turn_b = rotation_logs(R_b[i] @ R_b[j].transpose(0, 2, 1))
    straight = angle < 1e-9
    shift_g, shift_b = t_g_m[i] - t_g_m[j], t_b_m[i] - t_b_m[j]
    travel_m = np.linalg.norm(shift_g, axis=1)
    scale_m = float(travel_m.max()) if travel_m.max() > 0.0 else 1.0
    straight &= travel_m > 1e-3 * scale_m
    there = np.concatenate([turn_g[turned], shift_g[straight] / scale_m])
    seen = np.concatenate([turn_b[turned], shift_b[straight] / scale_m])
    return there, seen


def _wahba(there: FloatArray, seen: FloatArray) -> tuple[FloatArray, FloatArray | None]:
    """Rotation with ``seen ~ R @ there``, and the one known direction when all vectors are parallel."""
    if len(there) == 0:
        return np.eye(3), np.array([0.0, 0.0, 1.0])
    _, spread, directions = np.linalg.svd(there, full_matrices=False)
    weights = np.ones(len(there))
    R = np.eye(3)
    for _ in range(_ROBUST_PASSES):
        R = nearest_rotation(np.einsum("n,ni,nj->ij", weights, seen, there))
        weights = _absolute_weights(np.linalg.norm(seen - there @ R.T, axis=1))
    is_one_direction = len(spread) < 2 or spread[1] < 1e-3 * spread[0]
    return R, np.ascontiguousarray(directions[0]) if is_one_direction else None


def _robust_mean(rotations: FloatArray) -> FloatArray:
    """Chordal mean by least absolute deviations."""
    weights = np.ones(len(rotations))
    R: FloatArray = rotations[0]
    for _ in range(_ROBUST_PASSES):
        R = nearest_rotation(np.einsum("n,nij->ij", weights, rotations))
        weights = _absolute_weights(np.linalg.norm(rotation_logs(rotations @ R.T), axis=1))
    return R


def _translations(
    R_left: FloatArray, R_g: FloatArray, t_g_m: FloatArray, t_b_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Left and right translation by least absolute deviations, and what remains per station, m."""
    count = len(R_g)
    rows = np.concatenate([np.broadcast_to(np.eye(3), (count, 3, 3)), R_left @ R_g], axis=2)
    wanted = t_b_m - t_g_m @ R_left.T
    # A whisper of a prior at zero picks one of the answers the data cannot tell apart.
    prior = np.diag([0.0, 0.0, 0.0, 1e-6, 1e-6, 1e-6])
    weights = np.ones(count)
    x = np.zeros(6)
    rest = np.zeros(count)
    for _ in range(_ROBUST_PASSES):
        weights = weights / weights.mean()
        H = np.einsum("n,nki,nkj->ij", weights, rows, rows) / count + prior
        x = np.linalg.solve(H, np.einsum("n,nki,nk->i", weights, rows, wanted) / count)
        rest = np.linalg.norm(wanted - rows @ x, axis=1)
        weights = _absolute_weights(rest)
    return x[:3], x[3:], rest


def _absolute_weights(distance: FloatArray) -> FloatArray:
    """Weights that turn least squares into least absolute deviations, bounded at the median distance."""
    weights: FloatArray = 1.0 / np.maximum(distance, max(float(np.median(distance)), 1e-12))
    return weights
