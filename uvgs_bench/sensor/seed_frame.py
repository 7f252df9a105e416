"""A frame that looks along three lights, and a coarse map of the lights about them, compiled."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled

# Lights farther to the side than this have no place in the frame.
_LEAST_COSINE = 0.2


@compiled
def seed_frame(rays: FloatArray, seed: NDArray[np.int64], B: FloatArray, xy: FloatArray) -> float:
    """A frame that looks along a seed: rows of B, and where it sees all rays, shape (m, 2), nan far to the side.

    Gates near the seed are then round whatever the lens is. Returns the longest side of the seed as seen there.
    """
    first, second = rays[seed[0]], rays[seed[1]]
    norm = 0.0
    for c in range(3):
        B[2, c] = first[c] + second[c] + rays[seed[2], c]
        norm += B[2, c] ** 2
    along = 0.0
    for c in range(3):
        B[2, c] /= sqrt(norm)
        along += B[2, c] * (second[c] - first[c])
    norm = 0.0
    for c in range(3):
        B[0, c] = second[c] - first[c] - along * B[2, c]
        norm += B[0, c] ** 2
    for c in range(3):
        B[0, c] /= sqrt(norm)
    for c in range(3):
        B[1, c] = B[2, (c + 1) % 3] * B[0, (c + 2) % 3] - B[2, (c + 2) % 3] * B[0, (c + 1) % 3]
    for i in range(rays.shape[0]):
        z = B[2, 0] * rays[i, 0] + B[2, 1] * rays[i, 1] + B[2, 2] * rays[i, 2]
        for axis in range(2):
            v = B[axis, 0] * rays[i, 0] + B[axis, 1] * rays[i, 1] + B[axis, 2] * rays[i, 2]
            xy[i, axis] = v / z if z > _LEAST_COSINE else np.nan
    longest = 0.0
    for c in range(3):
        i, j = seed[c], seed[(c + 1) % 3]
        longest = max(longest, (xy[i, 0] - xy[j, 0]) ** 2 + (xy[i, 1] - xy[j, 1]) ** 2)
    return sqrt(longest)


@compiled
def lay_out(xy: FloatArray, cell: float, cells: NDArray[np.bool_]) -> None:
    """Mark the cells about a seed that hold a light or touch one that does."""
    cells[:] = False
    half = cells.shape[0] // 2
    for blob in range(xy.shape[0]):
        x, y = xy[blob, 0] / cell + half, xy[blob, 1] / cell + half
        # False for nan too: what lies beyond the cells is not asked.
        if 1.0 <= x < cells.shape[0] - 1 and 1.0 <= y < cells.shape[0] - 1:
            for i in range(int(y) - 1, int(y) + 2):
                for j in range(int(x) - 1, int(x) + 2):
                    cells[i, j] = True
