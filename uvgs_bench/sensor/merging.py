"""LEDs whose light may have run into one blob: seen ones that an unseen one should shine beside.

Two lights nearer than some widths of a spot are one blob between them, off by up to half their distance with the small
deviation of a bright spot. No residual shows it when three LEDs are left, and with many LEDs it can hide in the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.sensor.evidence_kernels import is_lit
from uvgs_bench.sensor.led_table import LedTable

# A light this many widths (deviations) of a spot away that is not found as a blob of its own moves the centroid of the
# spot by less than its deviation, whatever its brightness; by trial on drawn pairs.
REACH_WIDTHS = 5.0
# Of the place of an unseen LED relative to a seen one.
_DEVIATIONS = 3.0


@dataclass(frozen=True, slots=True)
class Overlap:
    """A seen LED that an unseen one may shine into.

    Args:
        seen: Index of the LED whose blob is doubted.
        unseen: Index of the other.
        apart_px: Distance of their places, px.
        reach_px: Nearer than this they may be one blob, px.
    """

    seen: int
    unseen: int
    apart_px: float
    reach_px: float


def find_overlaps(
    pose: Pose, covariance: FloatArray, lens: Lens, leds: LedTable, seen: NDArray[np.int64], width_px: FloatArray
) -> list[Overlap]:
    """Seen LEDs beside which an unseen one should shine by its cone.

    Args:
        pose: camera_from_beacon.
        covariance: Its covariance, left tangent (omega, v), shape (6, 6).
        lens: The lens.
        leds: The tabulated beacon.
        seen: Indices of the LEDs whose blobs are used, shape (k,).
        width_px: Deviation of a Gaussian as wide as the spot of each, shape (k,), px.

    Returns:
        At most one per seen LED, the nearest, in the order of ``seen``; none when every LED is seen.
    """
    n = len(leds.positions_m)
    if len(seen) == n:
        return []
    R, t = pose.R.copy(), pose.t_m.copy()
    points = pose.apply(leds.positions_m)
    places, by_point, _ = lens.project_with_jacobians(points)
    by_pose = np.empty((n, 2, 6))
    for i, (x, y, z) in enumerate(points):
        by_pose[i, :, :3] = by_point[i] @ np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
        by_pose[i, :, 3:] = by_point[i]
    hidden = [
        i
        for i in set(range(n)).difference(seen.tolist())
        if np.isfinite(places[i]).all() and is_lit(R, t, leds.positions_m[i], leds.axes[i], leds.cos_limit[i])
    ]
    overlaps = []
    for i, width in zip(seen.tolist(), width_px.tolist(), strict=True):
        nearest: Overlap | None = None
        for j in hidden:
            between = by_pose[j] - by_pose[i]
            spread = float(np.trace(between @ covariance @ between.T))
            reach = REACH_WIDTHS * width + _DEVIATIONS * float(np.sqrt(max(spread, 0.0)))
            apart = float(np.linalg.norm(places[j] - places[i]))
            if apart < reach and (nearest is None or apart < nearest.apart_px):
                nearest = Overlap(i, j, apart, reach)
        if nearest is not None:
            overlaps.append(nearest)
    return overlaps
