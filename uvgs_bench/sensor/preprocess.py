"""Stage 1: from a picture to what is bright in it.

``intensity`` is shared by both pipelines; ``segment`` is section 2.1 of the paper: decimate, normalise, blur, threshold
by local mean and deviation, open and close.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.sensor.capture import ImageArray
from uvgs_bench.sensor.config import UvgsConfig


@dataclass(frozen=True, slots=True, eq=False)
class Segmentation:
    """The binary picture B(x, y).

    Args:
        binary: 0 or 1, shape (h, w), uint8, decimated px.
        scale_x: Decimated px per raw px along x.
        scale_y: Decimated px per raw px along y.
    """

    binary: NDArray[np.uint8]
    scale_x: float
    scale_y: float


def intensity(image: ImageArray) -> ImageArray:
    """Brightness of each pixel: the picture itself, or the brightest of its three channels.

    The largest channel keeps a pure blue LED as bright as a white one; a luma would take nine tenths from it.

    Args:
        image: Mono (H, W) or BGR (H, W, 3), uint8 or uint16.

    Returns:
        Shape (H, W), C-contiguous, same type.
    """
    if image.ndim == 2:
        flat: ImageArray = image if image.flags.c_contiguous else image.copy()
        return flat
    import cv2

    blue, green, red = cv2.split(image)
    brightest: ImageArray = cv2.max(cv2.max(blue, green), red)
    return brightest


def segment(raw: ImageArray, config: UvgsConfig) -> Segmentation:
    """Binary picture of what stands out from its surroundings.

    Decimation averages over the area each new pixel covers (sampling alone would alias small blobs). The threshold is
    ``mean + max(k sigma, floor)``: without the floor a flat background passes its own noise.

    Args:
        raw: Brightness, shape (H, W), not constant.
        config: Parameters alpha, sigma, window, k, floor, structuring element.

    Returns:
        The binary picture and its scale.

    Source: section 2.1 of the uVGS-2 paper.
    """
    import cv2

    height, width = raw.shape
    small: NDArray[np.float32] = raw.astype(np.float32)
    if config.alpha < 1.0:
        size = (max(1, round(width * config.alpha)), max(1, round(height * config.alpha)))
        small = cv2.resize(small, size, interpolation=cv2.INTER_AREA)
    low, high = float(small.min()), float(small.max())
    normal = (small - low) / max(high - low, 1e-9)
    if config.blur_sigma_px > 0.0:
        normal = cv2.GaussianBlur(normal, (0, 0), config.blur_sigma_px)
    side = (config.window_px, config.window_px)
    mean = cv2.boxFilter(normal, cv2.CV_64F, side)
    square = cv2.sqrBoxFilter(normal, cv2.CV_64F, side)
    deviation = np.sqrt(np.maximum(square - mean * mean, 0.0))
    above = normal > mean + np.maximum(config.threshold_k * deviation, config.threshold_floor)
    binary: NDArray[np.uint8] = above.astype(np.uint8)
    if config.element_px > 1:
        element = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (config.element_px, config.element_px))
        binary = cv2.morphologyEx(binary, cv2.MORPH_OPEN, element)
        binary = cv2.morphologyEx(binary, cv2.MORPH_CLOSE, element)
    return Segmentation(binary, small.shape[1] / width, small.shape[0] / height)
