"""Compiled loops of the bundle adjustment: the normal equations view by view, and the update of the poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.lens_kernels import KERNEL_SIZE, coefficient_columns, project_point_with_jacobian
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.geometry.se3 import se3_exp

POSE_SIZE = 6


@compiled
def gram_of_views(
    model_id: int,
    parameters: FloatArray,
    R_cb: FloatArray,
    t_cb: FloatArray,
    points_m: FloatArray,
    px: FloatArray,
    bounds: NDArray[np.intp],
    by_shape: FloatArray,
    lens_size: int,
    shape_size: int,
) -> FloatArray:
    """Products of all pairs of columns of the Jacobian and the residual, summed over the corners of each view.

    Columns: six of the pose (left update, rotation first), the first parameters of the lens, the shape of the board,
    and the residual, observed minus projected.

    Args:
        model_id: Number of the lens.
        parameters: ``Lens.kernel_parameters``, shape (17,).
        R_cb: Rotations camera from board, shape (V, 3, 3).
        t_cb: Translations, shape (V, 3), m.
        points_m: Board points as shaped, shape (N, 3), m.
        px: Observed pixels, shape (N, 2), px.
        bounds: Where each view begins, and the end, shape (V + 1,).
        by_shape: Derivative of the board points by the shape, shape (N, 3, 3).
        lens_size: How many parameters of the lens have columns.
        shape_size: How many shape parameters have columns.

    Returns:
        Shape (V, n, n) with n = 7 + lens_size + shape_size, px^2 per unit; NaN where a corner is not seen.
    """
    size = POSE_SIZE + lens_size + shape_size + 1
    out = np.zeros((bounds.shape[0] - 1, size, size))
    columns = np.zeros((2, KERNEL_SIZE))
    J = np.empty((2, size))
    for view in range(bounds.shape[0] - 1):
        R, t, gram = R_cb[view], t_cb[view], out[view]
        for i in range(bounds[view], bounds[view + 1]):
            X, Y, Z = points_m[i, 0], points_m[i, 1], points_m[i, 2]
            x = R[0, 0] * X + R[0, 1] * Y + R[0, 2] * Z + t[0]
            y = R[1, 0] * X + R[1, 1] * Y + R[1, 2] * Z + t[1]
            z = R[2, 0] * X + R[2, 1] * Y + R[2, 2] * Z + t[2]
            u, v, is_valid, u_x, u_y, u_z, v_x, v_y, v_z = project_point_with_jacobian(model_id, parameters, x, y, z)
            if not is_valid:
                gram[:, :] = np.nan
                break
            # d p' / d xi = [-[p']^ | I] for the left update; a row a of d px / d p' times -[p']^ is p' x a.
            for row, ax, ay, az in ((0, u_x, u_y, u_z), (1, v_x, v_y, v_z)):
                J[row, 0], J[row, 1], J[row, 2] = y * az - z * ay, z * ax - x * az, x * ay - y * ax
                J[row, 3], J[row, 4], J[row, 5] = ax, ay, az
                for k in range(shape_size):
                    bx, by, bz = by_shape[i, 0, k], by_shape[i, 1, k], by_shape[i, 2, k]
                    J[row, POSE_SIZE + lens_size + k] = (
                        ax * (R[0, 0] * bx + R[0, 1] * by + R[0, 2] * bz)
                        + ay * (R[1, 0] * bx + R[1, 1] * by + R[1, 2] * bz)
                        + az * (R[2, 0] * bx + R[2, 1] * by + R[2, 2] * bz)
                    )
            if lens_size > 0:
                coefficient_columns(model_id, parameters, x, y, z, columns)
                for k in range(lens_size):
                    J[0, POSE_SIZE + k], J[1, POSE_SIZE + k] = columns[0, k], columns[1, k]
            J[0, size - 1], J[1, size - 1] = px[i, 0] - u, px[i, 1] - v
            for row in range(size):
                a, b = J[0, row], J[1, row]
                for column in range(row, size):
                    gram[row, column] += a * J[0, column] + b * J[1, column]
        for row in range(size):
            for column in range(row):
                gram[row, column] = gram[column, row]
    return out


@compiled
def moved_poses(R_cb: FloatArray, t_cb: FloatArray, twists: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Left update of every pose (V, 3, 3), (V, 3) by its twist (V, 6), rotation first."""
    R_out, t_out = np.empty_like(R_cb), np.empty_like(t_cb)
    for view in range(R_cb.shape[0]):
        dR, dt = se3_exp(twists[view])
        for i in range(3):
            for j in range(3):
                R_out[view, i, j] = (
                    dR[i, 0] * R_cb[view, 0, j] + dR[i, 1] * R_cb[view, 1, j] + dR[i, 2] * R_cb[view, 2, j]
                )
            t_out[view, i] = dR[i, 0] * t_cb[view, 0] + dR[i, 1] * t_cb[view, 1] + dR[i, 2] * t_cb[view, 2] + dt[i]
    return R_out, t_out
