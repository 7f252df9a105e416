"""Which LEDs of a capture are clipped: a light whose core stands at full scale pulls its own centroid."""

from __future__ import annotations

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor.blobs import full_scale_of
from uvgs_bench.sensor.capture import Capture

_REACH_PX = 1


def clipped_led_count(capture: Capture, led_px: FloatArray) -> int:
    """How many LEDs have a pixel at full scale at their centre or next to it.

    Args:
        capture: The picture.
        led_px: Where the LEDs were seen, shape (n, 2), raw px; NaN where one was not.

    Returns:
        The number of LEDs.
    """
    image = capture.image
    full_scale = full_scale_of(capture)
    count = 0
    for u, v in led_px[np.isfinite(led_px).all(axis=1)].round().astype(int).tolist():
        rows = slice(max(v - _REACH_PX, 0), v + _REACH_PX + 1)
        columns = slice(max(u - _REACH_PX, 0), u + _REACH_PX + 1)
        core = image[rows, columns]
        count += bool(core.size) and bool((core >= full_scale).any())
    return count
