"""P3P by a conic pencil (Lambda Twist): up to four poses from three rays, compiled."""

from __future__ import annotations

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.three_rays import pose_from_distances, solve_distances


@compiled
def solve_p3p(rays: FloatArray, points: FloatArray, Rs: FloatArray, ts: FloatArray) -> int:
    """Poses that put three points on three rays.

    Args:
        rays: Unit rays in the camera frame, shape (3, 3), one a row.
        points: Points in the beacon frame, shape (3, 3), m, one a row, not collinear.
        Rs: Output, rotations camera_from_beacon, shape (4, 3, 3).
        ts: Output, translations, shape (4, 3), m.

    Returns:
        Number of poses, 0 to 4; all have positive distances.
    """
    a0 = a1 = a2 = b0 = b1 = b2 = 0.0
    for c in range(3):
        a0 += (points[0, c] - points[1, c]) ** 2
        a1 += (points[0, c] - points[2, c]) ** 2
        a2 += (points[1, c] - points[2, c]) ** 2
        b0 += rays[0, c] * rays[1, c]
        b1 += rays[0, c] * rays[2, c]
        b2 += rays[1, c] * rays[2, c]
    distances = np.empty((4, 3))
    count = 0
    for i in range(solve_distances(b0, b1, b2, a0, a1, a2, distances)):
        d0, d1, d2 = distances[i, 0], distances[i, 1], distances[i, 2]
        if pose_from_distances(rays, points, d0, d1, d2, Rs[count], ts[count]):
            count += 1
    return count
