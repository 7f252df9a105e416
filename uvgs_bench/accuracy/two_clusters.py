"""Two beacons held rigidly, both seen in one capture: what varies between them is the sensor's error.

Source: ASTM E3064 for the idea (relative pose of two marker clusters on one artefact); no conformity is claimed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.clusters import Clusters
from uvgs_bench.accuracy.intervals import moment_intervals
from uvgs_bench.accuracy.quantity_catalogue import Quantity, quantity
from uvgs_bench.accuracy.tangent import rotation_logs
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.se3 import mean_rotation


def two_cluster_quantities(
    first: tuple[FloatArray, FloatArray],
    second: tuple[FloatArray, FloatArray],
    place: NDArray[np.int64],
    rng: np.random.Generator,
) -> tuple[Quantity, ...]:
    """How constant the pose of one beacon in the other's frame stays; no gantry and no registration are needed.

    An error that both beacons share in the same way (a wrong scale of both, say) does not show.

    Args:
        first: Rotations, shape (N, 3, 3), and translations, shape (N, 3), m, of camera_from_beacon of one beacon.
        second: The same of the other, in the same captures.
        place: Place of each capture, shape (N,).
        rng: Source of randomness for the intervals.

    Returns:
        Root mean square position and attitude about the mean relative pose, in the first beacon's axes.

    Raises:
        ValueError: No captures.
    """
    if len(place) == 0:
        raise ValueError("two clusters need captures that show both")
    back = first[0].transpose(0, 2, 1)
    R = back @ second[0]
    t_m = np.einsum("nij,nj->ni", back, second[1] - first[1])
    turn = rotation_logs(mean_rotation(R).T @ R)
    clusters = Clusters.of(place, rng)
    nothing = np.zeros((len(place), 3, 12))
    return (
        quantity("two_cluster_position_rms", moment_intervals(t_m - t_m.mean(axis=0), nothing, clusters).spread),
        quantity("two_cluster_attitude_rms", moment_intervals(turn, nothing, clusters).spread),
    )
