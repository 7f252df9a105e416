"""Products of 3 x 3 matrices in kernels.

Numba's own operator calls BLAS: that loads scipy in the middle of the work, and takes longer than the sums.
"""

from __future__ import annotations

import numpy as np

from uvgs_bench.geometry.arrays import FloatArray
from uvgs_bench.geometry.compiled import compiled


@compiled
def product(A: FloatArray, B: FloatArray) -> FloatArray:
    """``A @ B`` for 3 x 3 matrices.

    Args:
        A: Matrix, shape (3, 3).
        B: Matrix, shape (3, 3).

    Returns:
        Matrix, shape (3, 3).
    """
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
    return out


@compiled
def times(A: FloatArray, v: FloatArray) -> FloatArray:
    """``A @ v`` for a 3 x 3 matrix.

    Args:
        A: Matrix, shape (3, 3).
        v: Vector, shape (3,).

    Returns:
        Vector, shape (3,).
    """
    out = np.empty(3)
    for i in range(3):
        out[i] = A[i, 0] * v[0] + A[i, 1] * v[1] + A[i, 2] * v[2]
    return out
