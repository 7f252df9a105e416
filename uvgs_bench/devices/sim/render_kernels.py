"""Compiled loops of the simulated camera: light onto pixels, and a flat board seen through a lens."""

from __future__ import annotations

from math import ceil, erf, floor, isfinite, sqrt

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled


@compiled
def add_spots(
    light: FloatArray, px: FloatArray, amount: FloatArray, colour: FloatArray, sigma_px: float
) -> tuple[int, int, int, int]:
    """Add Gaussian spots, each integrated over the square of every pixel.

    Beyond five standard deviations nothing is added (6e-7 of the light along each direction).

    Args:
        light: Picture that is added to, shape (H, W, C), DN.
        px: Centres, shape (K, 2), px; NaN is skipped.
        amount: Light of each spot, shape (K,), DN px.
        colour: Share of each channel, shape (C,).
        sigma_px: Standard deviation, px.

    Returns:
        First and past-the-last row, first and past-the-last column that were touched; an empty range when none was.
    """
    height, width, channels = light.shape
    top, bottom, left, right = height, 0, width, 0
    scale = 1.0 / (sqrt(2.0) * sigma_px)
    reach = 5.0 * sigma_px
    along_u = np.empty(int(2.0 * reach) + 4)
    for k in range(px.shape[0]):
        u, v = px[k, 0], px[k, 1]
        if not (isfinite(u) and isfinite(v)) or abs(u) > 1e6 or abs(v) > 1e6 or amount[k] <= 0.0:
            continue
        i0, i1 = max(0, floor(v - reach + 0.5)), min(height, ceil(v + reach - 0.5) + 1)
        j0, j1 = max(0, floor(u - reach + 0.5)), min(width, ceil(u + reach - 0.5) + 1)
        if i0 >= i1 or j0 >= j1:
            continue
        top, bottom, left, right = min(top, i0), max(bottom, i1), min(left, j0), max(right, j1)
        low = erf((j0 - 0.5 - u) * scale)
        for j in range(j0, j1):
            high = erf((j + 0.5 - u) * scale)
            along_u[j - j0] = 0.5 * (high - low)
            low = high
        low = erf((i0 - 0.5 - v) * scale)
        for i in range(i0, i1):
            high = erf((i + 0.5 - v) * scale)
            share = 0.5 * (high - low) * amount[k]
            low = high
            for j in range(j0, j1):
                spot = share * along_u[j - j0]
                for c in range(channels):
                    light[i, j, c] += spot * colour[c]
    return top, bottom, left, right


@compiled
def see_plane(
    rays: FloatArray,
    texel_from_ray: FloatArray,
    texture: FloatArray,
    picture: FloatArray,
    box: tuple[int, int, int, int],
    samples: int,
) -> None:
    """Paint a textured plane into a picture, averaged over a grid of points in every pixel.

    Args:
        rays: x/z and y/z of every pixel centre, shape (H, W, 2); NaN where the lens has none.
        texel_from_ray: Homography from (x/z, y/z, 1) to texture column and row, shape (3, 3); the third entry is
            positive in front of the camera.
        texture: Brightness, shape (h, w), interpolated between texel centres.
        picture: Picture that is painted, shape (H, W); untouched where the plane is not seen.
        box: First and past-the-last row, first and past-the-last column to look at, within the picture's inner pixels.
        samples: Points along each side of a pixel.
    """
    H = texel_from_ray
    rows, columns = texture.shape
    for i in range(box[0], box[1]):
        for j in range(box[2], box[3]):
            x_u = 0.5 * (rays[i, j + 1, 0] - rays[i, j - 1, 0])
            y_u = 0.5 * (rays[i, j + 1, 1] - rays[i, j - 1, 1])
            x_v = 0.5 * (rays[i + 1, j, 0] - rays[i - 1, j, 0])
            y_v = 0.5 * (rays[i + 1, j, 1] - rays[i - 1, j, 1])
            if not isfinite(x_u + y_u + x_v + y_v):
                continue
            total = 0.0
            for a in range(samples):
                dv = (a + 0.5) / samples - 0.5
                for b in range(samples):
                    du = (b + 0.5) / samples - 0.5
                    x = rays[i, j, 0] + du * x_u + dv * x_v
                    y = rays[i, j, 1] + du * y_u + dv * y_v
                    depth = H[2, 0] * x + H[2, 1] * y + H[2, 2]
                    value = picture[i, j]
                    if depth > 0.0:
                        column = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / depth
                        row = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / depth
                        if 0.0 <= column < columns - 1.0 and 0.0 <= row < rows - 1.0:
                            c, r = int(column), int(row)
                            s, t = column - c, row - r
                            value = (1.0 - t) * ((1.0 - s) * texture[r, c] + s * texture[r, c + 1]) + t * (
                                (1.0 - s) * texture[r + 1, c] + s * texture[r + 1, c + 1]
                            )
                    total += value
            picture[i, j] = total / (samples * samples)
