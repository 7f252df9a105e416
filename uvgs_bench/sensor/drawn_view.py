"""A view of a beacon drawn with few strokes, for using every kernel once before the first real picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.sensor.led_table import LedTable

_DARK_DN, _EDGE_DN, _CORE_DN = 10, 120, 200
_FROM_BORDER_PX = 3.0
# Distance from the camera over the beacon's longest edge.
_DISTANCE = 12.0


def facing_pose(leds: LedTable) -> Pose:
    """A pose before the camera in which the LEDs shine towards it, turned a little so that no view is degenerate.

    Args:
        leds: The tabulated beacon.

    Returns:
        camera_from_beacon.
    """
    mean = leds.axes.sum(axis=0)
    length = float(np.linalg.norm(mean))
    forward = -mean / length if length > 0.1 else np.array([0.0, 0.0, 1.0])
    side = np.cross(np.eye(3)[int(np.argmin(np.abs(forward)))], forward)
    side /= np.linalg.norm(side)
    R = np.array([side, np.cross(forward, side), forward])
    R = so3_exp(np.array([0.05, 0.2, 0.0])) @ R
    t_m = np.array([0.0, 0.0, _DISTANCE * leds.longest_m]) - R @ leds.positions_m.mean(axis=0)
    return Pose(R, t_m, "camera", "beacon")


def draw_view(lens: Lens, places_px: FloatArray, hidden: int = 0) -> NDArray[np.uint8]:
    """A dark picture with one small spot per place.

    Args:
        lens: The lens; its picture size.
        places_px: Where, shape (n, 2), px; what lies outside the picture is left out.
        hidden: How many of the first places are left dark.

    Returns:
        The picture, shape (H, W).
    """
    image = np.full((lens.height_px, lens.width_px), _DARK_DN, dtype=np.uint8)
    for u, v in places_px[hidden:]:
        if np.isfinite(u) and lens.contains(np.array([[u, v]]), _FROM_BORDER_PX)[0]:
            y, x = round(v), round(u)
            image[y - 1 : y + 2, x - 1 : x + 2] = _EDGE_DN
            image[y, x] = _CORE_DN
    return image
