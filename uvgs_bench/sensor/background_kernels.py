"""Compiled look at the darker part of a picture: background, pixel noise, texture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.capture import ImageArray

# Distance at which a texture as coarse as a light shows, px.
_BLOTCH_PX = 12


@compiled
def background_and_noise(image: ImageArray, brightest: int) -> tuple[float, float, float]:
    """Median of a sparse grid, and deviations of pixels from neighbours along the rows and from pixels 12 px on.

    Lights cover a small part of a picture, so a median does not see them, and differences of neighbours do not see a
    gradient: theirs is the pixel noise. Where the other is larger, more than half of the picture has a texture. Medians
    are taken within their grey step, because quiet pictures vary by one step.

    Args:
        image: Brightness, shape (H, W).
        brightest: Its brightest pixel, DN.

    Returns:
        Background, noise and texture, DN.
    """
    height, width = image.shape
    step_y = 1 if height * width <= 4096 else 29
    step_x = 1 if height * width <= 4096 else 31
    levels = np.zeros(brightest + 1, dtype=np.int32)
    steps = np.zeros(brightest + 1, dtype=np.int32)
    blotches = np.zeros(brightest + 1, dtype=np.int32)
    n = 0
    pairs = 0
    far_pairs = 0
    for y in range(min(3, step_y - 1), height, step_y):
        for x in range(min(4, step_x - 1), width, step_x):
            value = np.int64(image[y, x])
            levels[value] += 1
            n += 1
            if x + 1 < width:
                steps[abs(value - np.int64(image[y, x + 1]))] += 1
                pairs += 1
            if x + _BLOTCH_PX < width:
                blotches[abs(value - np.int64(image[y, x + _BLOTCH_PX]))] += 1
                far_pairs += 1
    return _median(levels, n), _deviation(steps, pairs), _deviation(blotches, far_pairs)


@compiled
def _deviation(differences: NDArray[np.int32], n: int) -> float:
    """Deviation of normal values from the histogram of their absolute differences.

    A difference of 0 stands for up to half a step, one of k for k - 1/2 to k + 1/2. The median of the absolute
    difference of two normal values is 0.954 of their deviation.
    """
    if n == 0:
        return 0.0
    median = _median(differences, n) if 2 * differences[0] < n else 0.5 * n / (2.0 * differences[0])
    return max(median, 0.0) / 0.954


@compiled
def _median(counts: NDArray[np.int32], n: int) -> float:
    """Median of n whole numbers from their histogram, even within the middle step."""
    below = 0
    value = 0
    while 2 * (below + counts[value]) < n:
        below += counts[value]
        value += 1
    return float(value - 0.5 + (0.5 * n - below) / counts[value])
