"""How bright and how wide each light is, for comparing LEDs of one beacon: only up to a common factor."""

from __future__ import annotations

from math import log, pi, sqrt

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.blobs import Blobs
from uvgs_bench.sensor.capture import ImageArray

# Light outside a blob's box that still belongs to it, px.
_MARGIN_PX = 2


@compiled
def _median(values: FloatArray) -> float:
    """Median, the values sorted in place. Numba's own brings scipy along when it is loaded: 0.2 s of the first pose."""
    n = values.shape[0]
    for i in range(1, n):
        value = values[i]
        j = i
        while j > 0 and values[j - 1] > value:
            values[j] = values[j - 1]
            j -= 1
        values[j] = value
    return 0.5 * float(values[(n - 1) // 2] + values[n // 2])


@compiled
def _look(image: ImageArray, x0: int, y0: int, x1: int, y1: int) -> tuple[float, float]:
    """Light above the surroundings, DN px^2, and the width of a Gaussian of this light and height, px; 0 when none."""
    height, width = image.shape
    x0 = max(0, x0 - _MARGIN_PX)
    y0 = max(0, y0 - _MARGIN_PX)
    x1 = min(width - 1, x1 + _MARGIN_PX)
    y1 = min(height - 1, y1 + _MARGIN_PX)
    ring = np.empty(2 * (x1 - x0 + y1 - y0 + 2))
    n = 0
    for x in range(x0, x1 + 1):
        ring[n] = float(image[y0, x])
        ring[n + 1] = float(image[y1, x])
        n += 2
    for y in range(y0 + 1, y1):
        ring[n] = float(image[y, x0])
        ring[n + 1] = float(image[y, x1])
        n += 2
    background = _median(ring[:n])
    light = 0.0
    peak = 0.0
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            value = float(image[y, x]) - background
            light += value
            peak = max(peak, value)
    if light <= 0.0 or peak <= 0.0:
        return 0.0, 0.0
    return light, sqrt(light / (2.0 * pi * peak))


def looks_of(image: ImageArray, blobs: Blobs) -> FloatArray:
    """Natural logarithms of light and width of each blob.

    A clipped blob is brighter and narrower than it looks by an unknown factor, so nothing is said about it; nor about
    one whose box holds another blob.

    Args:
        image: The raw picture, mono (H, W) or BGR (H, W, 3).
        blobs: The blobs.

    Returns:
        Shape (n, 2), NaN where unknown.
    """
    out = np.full((len(blobs), 2), np.nan)
    centres = blobs.centroid_px
    for i in range(len(blobs)):
        x0, y0, x1, y1 = (int(v) for v in blobs.box_px[i])
        if blobs.clipped_px2[i] > 0.0:
            continue
        reach = 2 * _MARGIN_PX
        inside = (centres >= (x0 - reach, y0 - reach)).all(axis=1) & (centres <= (x1 + reach, y1 + reach)).all(axis=1)
        if inside.sum() != 1:
            continue
        if image.ndim == 3:
            part = image[max(0, y0 - 3) : y1 + 4, max(0, x0 - 3) : x1 + 4]
            light, width = _look(np.ascontiguousarray(part.max(axis=2)), 1, 1, part.shape[1] - 2, part.shape[0] - 2)
        else:
            light, width = _look(image, x0, y0, x1, y1)
        if light > 0.0:
            out[i] = log(light), log(width)
    return out
