"""Pictures of cameras that keep one colour per pixel (Bayer mosaics): made whole, and what that costs a centroid.

The missing colours are interpolated between neighbours of the same colour. A centroid of the result has the noise of
the pixels that were there, not of those made up between them, and of a narrow spot the grid of one colour is too
coarse.
"""

from __future__ import annotations

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor.capture import BayerPattern, ImageArray

# Noise of a centroid over that of a picture with all its pixels: red and blue have every fourth pixel, green every
# second. Four and two raw weights over those of the interpolated pixels give 2.7 and 1.8; measured 2.2 and 1.7, because
# part of it shows in the noise around the spot.
_SPARSE_RED_BLUE, _SPARSE_GREEN = 2.25, 1.7
# Bias by where within the grid a spot lies, root mean square: a factor times exp(-rate s^2) for a spot of deviation s,
# px; s^2 is the square of the width seen less what interpolation adds. By trial on drawn mosaics, 0.5 to 3 px.
_BIAS_RED_BLUE, _RATE_RED_BLUE, _ADDED_RED_BLUE_PX2 = 0.754, 2.2, 0.6
_BIAS_GREEN, _RATE_GREEN, _ADDED_GREEN_PX2 = 0.51, 4.5, 0.2
_MOST_BIAS_PX = 0.4
# Where two colours are alike, the brightest of them changes from pixel to pixel.
_SWITCHING_PX = 0.005
# In this range of hue, degrees, green is as bright as any other; colourless light has no hue.
_GREEN_FROM_DEG, _GREEN_TO_DEG = 65.0, 175.0


def develop(mosaic: ImageArray, pattern: BayerPattern) -> ImageArray:
    """Interpolate the missing colours of a mosaic bilinearly.

    Args:
        mosaic: Raw pixels, shape (H, W), H and W even, uint8 or uint16.
        pattern: Colours of the first two pixels of the first two rows.

    Returns:
        BGR, shape (H, W, 3), same type.

    Raises:
        ValueError: The mosaic has another shape.
    """
    import cv2

    if mosaic.ndim != 2 or mosaic.shape[0] % 2 or mosaic.shape[1] % 2:
        raise ValueError(f"expected a mosaic (H, W) with even sides, got {mosaic.shape}")
    # OpenCV names a pattern by the second and third pixel of the second row.
    code = {
        "rggb": cv2.COLOR_BayerBG2BGR,
        "bggr": cv2.COLOR_BayerRG2BGR,
        "grbg": cv2.COLOR_BayerGB2BGR,
        "gbrg": cv2.COLOR_BayerGR2BGR,
    }[pattern]
    image: ImageArray = cv2.cvtColor(mosaic, code)
    return image


def mosaic_sigma(sigma_px: FloatArray, width_px: FloatArray, hue_deg: FloatArray) -> FloatArray:
    """Deviations of centroids in a developed mosaic.

    Args:
        sigma_px: Deviations if every pixel had been there, shape (n,), px.
        width_px: Width of the spots as seen, shape (n,), px.
        hue_deg: Hue of their light, shape (n,), degrees; NaN for colourless light.

    Returns:
        Deviations, shape (n,), px.
    """
    hue = np.where(np.isnan(hue_deg), 120.0, hue_deg)
    is_green = (hue >= _GREEN_FROM_DEG) & (hue <= _GREEN_TO_DEG)
    red_blue2 = np.maximum(width_px**2 - _ADDED_RED_BLUE_PX2, 0.0)
    green2 = np.maximum(width_px**2 - _ADDED_GREEN_PX2, 0.0)
    bias = np.where(
        is_green, _BIAS_GREEN * np.exp(-_RATE_GREEN * green2), _BIAS_RED_BLUE * np.exp(-_RATE_RED_BLUE * red_blue2)
    )
    factor = np.where(is_green, _SPARSE_GREEN, _SPARSE_RED_BLUE)
    result: FloatArray = np.sqrt((factor * sigma_px) ** 2 + np.minimum(bias, _MOST_BIAS_PX) ** 2 + _SWITCHING_PX**2)
    return result
