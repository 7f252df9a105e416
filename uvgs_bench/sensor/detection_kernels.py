"""Compiled passes over raw pixels: tile maxima, bright components grown from peaks, centroids with their deviation."""

from __future__ import annotations

from math import ceil, exp, sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.capture import ImageArray

TILE_PX = 16
MAX_PEAKS = 4096
# Window of the centroid over the width of the spot.
WINDOW_RATIO = 1.4
# What a flat, clipped top adds to the deviation of a centroid, by trial on drawn spots.
CLIPPED_SIGMA_PX = 0.01
# Columns of the component table.
AREA, SUM_X, SUM_Y, X0, Y0, X1, Y1, PERIMETER, COMPONENT_COLUMNS = 0, 1, 2, 3, 4, 5, 6, 7, 8
# Columns of the measurement table.
CX, CY, SIGMA, PEAK, BACKGROUND, WIDTH, CLIPPED, MEASURE_COLUMNS = 0, 1, 2, 3, 4, 5, 6, 7


@compiled
def tile_maxima(image: ImageArray) -> FloatArray:
    """Brightest pixel of each tile of 16 x 16 px, in one pass over memory.

    Args:
        image: Brightness, shape (H, W), uint8 or uint16, C-contiguous.

    Returns:
        Maxima, shape (ceil(H / 16), ceil(W / 16)).
    """
    height, width = image.shape
    rows = (height + TILE_PX - 1) // TILE_PX
    columns = (width + TILE_PX - 1) // TILE_PX
    out = np.zeros((rows, columns))
    column_max = np.empty(width, dtype=image.dtype)
    for row in range(rows):
        y0 = row * TILE_PX
        column_max[:] = image[y0]
        for y in range(y0 + 1, min(y0 + TILE_PX, height)):
            line = image[y]
            for x in range(width):
                column_max[x] = max(column_max[x], line[x])
        for column in range(columns):
            best = column_max[column * TILE_PX]
            for x in range(column * TILE_PX + 1, min((column + 1) * TILE_PX, width)):
                best = max(best, column_max[x])
            out[row, column] = best
    return out


@compiled
def _find_peaks(
    image: ImageArray, maxima: FloatArray, level: float, ys: NDArray[np.int64], xs: NDArray[np.int64]
) -> int:
    """Local maxima above a level; the last pixel of a plateau in reading order stands for it. -1: too many."""
    height, width = image.shape
    count = 0
    for row in range(maxima.shape[0]):
        for column in range(maxima.shape[1]):
            if maxima[row, column] <= level:
                continue
            for y in range(row * TILE_PX, min((row + 1) * TILE_PX, height)):
                for x in range(column * TILE_PX, min((column + 1) * TILE_PX, width)):
                    value = image[y, x]
                    if value <= level:
                        continue
                    is_peak = True
                    for dy in range(-1, 2):
                        for dx in range(-1, 2):
                            v = y + dy
                            u = x + dx
                            if (dy == 0 and dx == 0) or v < 0 or u < 0 or v >= height or u >= width:
                                continue
                            other = image[v, u]
                            later = dy > 0 or (dy == 0 and dx > 0)
                            if other > value or (later and other == value):
                                is_peak = False
                    if is_peak:
                        if count == ys.shape[0]:
                            return -1
                        ys[count] = y
                        xs[count] = x
                        count += 1
    return count


@compiled
def _local_threshold(image: ImageArray, y: int, x: int, half: int, k: float, floor: float) -> float:
    """Threshold around a peak, or inf when the peak does not stand out.

    ``mean + k sigma`` of the window as in the paper, but never above half the peak's height, because a large blob fills
    its own window and raises both.
    """
    height, width = image.shape
    peak = float(image[y, x])
    total = 0.0
    square = 0.0
    n = 0
    lowest = peak
    for v in range(max(0, y - half), min(height, y + half + 1), 2):
        for u in range(max(0, x - half), min(width, x + half + 1), 2):
            value = float(image[v, u])
            total += value
            square += value * value
            lowest = min(lowest, value)
            n += 1
    mean = total / n
    sigma = sqrt(max(square / n - mean * mean, 0.0))
    middle = 0.5 * (lowest + peak)
    low_total = 0.0
    low_square = 0.0
    m = 0
    for v in range(max(0, y - half), min(height, y + half + 1), 2):
        for u in range(max(0, x - half), min(width, x + half + 1), 2):
            value = float(image[v, u])
            if value < middle:
                low_total += value
                low_square += value * value
                m += 1
    if m == 0:
        return np.inf
    background = low_total / m
    noise = sqrt(max(low_square / m - background * background, 0.0))
    height_dn = peak - background
    if height_dn < max(floor, 5.0 * noise):
        return np.inf
    return max(min(mean + k * sigma, background + 0.5 * height_dn), background + 0.5 * floor)


@compiled
def _perimeter(labels: NDArray[np.int32], label: int, x0: int, y0: int, x1: int, y1: int) -> float:
    """Length of the outline through the middles of pixel edges, by 2 x 2 patterns. Source: Gray, 1971, bit quads."""
    height, width = labels.shape
    length = 0.0
    for y in range(y0 - 1, y1 + 1):
        for x in range(x0 - 1, x1 + 1):
            a = y >= 0 and x >= 0 and labels[y, x] == label
            b = y >= 0 and x + 1 < width and labels[y, x + 1] == label
            c = y + 1 < height and x >= 0 and labels[y + 1, x] == label
            d = y + 1 < height and x + 1 < width and labels[y + 1, x + 1] == label
            n = int(a) + int(b) + int(c) + int(d)
            if n == 1 or n == 3:
                length += 0.7071067811865476
            elif n == 2:
                if (a and d) or (b and c):
                    length += 1.4142135623730951
                else:
                    length += 1.0
    return length


@compiled
def find_components(
    image: ImageArray, maxima: FloatArray, level: float, half: int, k: float, floor: float, table: FloatArray
) -> int:
    """Bright 8-connected components, each grown from its peak down to its own local threshold.

    Peaks are taken from the brightest down; a region that runs into an earlier one is that one's flank and is dropped.

    Args:
        image: Brightness, shape (H, W), uint8 or uint16.
        maxima: Its tile maxima.
        level: Peaks must exceed this, DN.
        half: Half side of the local window, px.
        k: k of ``mean + k sigma``.
        floor: Least height above the local background, DN.
        table: Output, shape (capacity, COMPONENT_COLUMNS).

    Returns:
        Number of components, or -1 when there are more peaks or components than fit.
    """
    height, width = image.shape
    ys = np.empty(MAX_PEAKS, dtype=np.int64)
    xs = np.empty(MAX_PEAKS, dtype=np.int64)
    peaks = _find_peaks(image, maxima, level, ys, xs)
    if peaks < 0:
        return -1
    values = np.empty(peaks)
    for i in range(peaks):
        values[i] = -float(image[ys[i], xs[i]])
    order = np.argsort(values, kind="mergesort")
    labels = np.zeros((height, width), dtype=np.int32)
    stack = np.empty(height * width, dtype=np.int64)
    count = 0
    label = 0
    for index in order:
        y = ys[index]
        x = xs[index]
        if labels[y, x] != 0:
            continue
        threshold = _local_threshold(image, y, x, half, k, floor)
        if threshold == np.inf:
            continue
        label += 1
        labels[y, x] = label
        stack[0] = y * width + x
        top = 1
        area = 0
        sum_x = 0.0
        sum_y = 0.0
        x0 = x
        x1 = x
        y0 = y
        y1 = y
        is_flank = False
        while top > 0:
            top -= 1
            v = stack[top] // width
            u = stack[top] - v * width
            area += 1
            sum_x += u
            sum_y += v
            x0 = min(x0, u)
            x1 = max(x1, u)
            y0 = min(y0, v)
            y1 = max(y1, v)
            for b in range(max(0, v - 1), min(height, v + 2)):
                for a in range(max(0, u - 1), min(width, u + 2)):
                    if image[b, a] > threshold:
                        if labels[b, a] == 0:
                            labels[b, a] = label
                            stack[top] = b * width + a
                            top += 1
                        elif labels[b, a] != label:
                            is_flank = True
        if is_flank:
            continue
        if count == table.shape[0]:
            return -1
        table[count, AREA] = area
        table[count, SUM_X] = sum_x
        table[count, SUM_Y] = sum_y
        table[count, X0] = x0
        table[count, Y0] = y0
        table[count, X1] = x1
        table[count, Y1] = y1
        table[count, PERIMETER] = _perimeter(labels, label, x0, y0, x1, y1)
        count += 1
    return count


@compiled
def _ring_background(image: ImageArray, x0: int, y0: int, x1: int, y1: int, peak: float) -> tuple[float, float]:
    """Mean and variance of the undisturbed pixels of a frame 3 px wide around a box."""
    height, width = image.shape
    limit = peak
    mean = 0.0
    variance = 0.0
    for _ in range(3):
        total = 0.0
        square = 0.0
        n = 0
        for y in range(max(0, y0 - 3), min(height, y1 + 4)):
            for x in range(max(0, x0 - 3), min(width, x1 + 4)):
                if y >= y0 and y <= y1 and x >= x0 and x <= x1:
                    continue
                value = float(image[y, x])
                if value < limit:
                    total += value
                    square += value * value
                    n += 1
        if n < 8:
            break
        mean = total / n
        variance = max(square / n - mean * mean, 0.0)
        limit = min(mean + 3.5 * sqrt(variance) + 1.0, mean + 0.5 * (peak - mean))
    return mean, variance


@compiled
def _settle(
    patch: FloatArray, x: float, y: float, s: float, noise: float, gain_e_per_dn: float
) -> tuple[float, float, float]:
    """Fixed point of the windowed centroid in a patch without background, and its variance; NaN when it wanders off."""
    height, width = patch.shape
    r = ceil(4.0 * s)
    start_x = x
    start_y = y
    ex = np.empty(width)
    settled = False
    for _ in range(40):
        a = max(0, int(x) - r)
        b = min(width, int(x) + r + 2)
        for u in range(a, b):
            ex[u] = exp(-0.5 * (u - x) * (u - x) / (s * s))
        weight = 0.0
        mx = 0.0
        my = 0.0
        for v in range(max(0, int(y) - r), min(height, int(y) + r + 2)):
            ey = exp(-0.5 * (v - y) * (v - y) / (s * s))
            for u in range(a, b):
                w = ey * ex[u] * patch[v, u]
                weight += w
                mx += w * (u - x)
                my += w * (v - y)
        if weight <= 0.0:
            break
        x += 2.0 * mx / weight
        y += 2.0 * my / weight
        if abs(x - start_x) + abs(y - start_y) > 2.0 + 2.0 * s:
            break
        if abs(mx) + abs(my) < 1e-5 * weight:
            settled = True
            break
    if not settled:
        return np.nan, np.nan, np.nan
    vx = 0.0
    vy = 0.0
    slope_x = 0.0
    slope_y = 0.0
    for v in range(max(0, int(y) - r), min(height, int(y) + r + 2)):
        for u in range(max(0, int(x) - r), min(width, int(x) + r + 2)):
            dx = u - x
            dy = v - y
            w = exp(-0.5 * (dx * dx + dy * dy) / (s * s))
            pixel_variance = noise + max(patch[v, u], 0.0) / gain_e_per_dn
            vx += w * w * dx * dx * pixel_variance
            vy += w * w * dy * dy * pixel_variance
            slope_x += w * patch[v, u] * (1.0 - dx * dx / (s * s))
            slope_y += w * patch[v, u] * (1.0 - dy * dy / (s * s))
    if slope_x <= 0.0 or slope_y <= 0.0:
        return np.nan, np.nan, np.nan
    return x, y, 0.5 * (vx / (slope_x * slope_x) + vy / (slope_y * slope_y))


@compiled
def _patch_of(image: ImageArray, x0: int, y0: int, size: int, background: float) -> FloatArray:
    """A square of the picture above a background; outside the picture it is 0, as if the background went on."""
    height, width = image.shape
    out = np.zeros((size, size))
    for v in range(max(0, -y0), min(size, height - y0)):
        for u in range(max(0, -x0), min(size, width - x0)):
            out[v, u] = float(image[y0 + v, x0 + u]) - background
    return out


@compiled
def _measure_one(
    image: ImageArray, gain_e_per_dn: float, noise: FloatArray, table: FloatArray, i: int, s: float
) -> None:
    """Settle one centroid from where the table has it, without the light of neighbours that are already measured."""
    half = ceil(6.0 * s) + 5
    x0 = int(table[i, CX]) - half
    y0 = int(table[i, CY]) - half
    patch = _patch_of(image, x0, y0, 2 * half + 1, table[i, BACKGROUND])
    moved = not np.isnan(table[i, SIGMA])
    if moved:
        for j in range(table.shape[0]):
            if j == i or np.isnan(table[j, CX]):
                continue
            sigma = table[j, WIDTH] / WINDOW_RATIO
            height = table[j, PEAK] - table[j, BACKGROUND]
            if abs(table[j, CX] - table[i, CX]) + abs(table[j, CY] - table[i, CY]) > 2.0 * half + 5.0 * sigma:
                continue
            for v in range(patch.shape[0]):
                for u in range(patch.shape[1]):
                    dx = x0 + u - table[j, CX]
                    dy = y0 + v - table[j, CY]
                    patch[v, u] -= height * exp(-0.5 * (dx * dx + dy * dy) / (sigma * sigma))
    x, y, variance = _settle(patch, table[i, CX] - x0, table[i, CY] - y0, s, noise[i], gain_e_per_dn)
    if table[i, CLIPPED] > 0.0:
        variance += CLIPPED_SIGMA_PX * CLIPPED_SIGMA_PX
    if moved:
        variance += 0.04 * ((x + x0 - table[i, CX]) ** 2 + (y + y0 - table[i, CY]) ** 2)
    table[i, CX] = x + x0
    table[i, CY] = y + y0
    table[i, SIGMA] = sqrt(variance)


@compiled
def measure_blobs(
    image: ImageArray, boxes: FloatArray, gain_e_per_dn: float, full_scale: float, table: FloatArray
) -> None:
    """Centroid of each blob on raw pixels, weighted by intensity above local background and a Gaussian window.

    The window sits on the centroid it finds (a fixed point), so a symmetric spot has no bias from where it is cut off,
    and a constant background error has no influence. It is wider than the spot: better against shot noise, and the sum
    over pixels does not depend on where within a pixel the spot lies. Light of a near neighbour is taken away first, as
    a Gaussian of the neighbour's height and width; a fifth of what that changes is added to the deviation.

    Args:
        image: Brightness, shape (H, W).
        boxes: Bounding boxes x0, y0, x1, y1, inclusive, shape (n, 4), raw px.
        gain_e_per_dn: Electrons per DN.
        full_scale: Largest DN; pixels there are clipped.
        table: Output, shape (n, MEASURE_COLUMNS); NaN centroid when it did not settle.

    Source: Bertin and Arnouts, SExtractor, windowed positions; deviation by error propagation of the fixed point.
    """
    height, width = image.shape
    n = boxes.shape[0]
    noise = np.empty(n)
    for i in range(n):
        x0 = int(boxes[i, 0])
        y0 = int(boxes[i, 1])
        x1 = int(boxes[i, 2])
        y1 = int(boxes[i, 3])
        peak = 0.0
        clipped = 0
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                value = float(image[y, x])
                peak = max(peak, value)
                if value >= full_scale:
                    clipped += 1
        reach = ceil(0.75 * max(x1 - x0 + 1, y1 - y0 + 1)) + 2
        background, variance = _ring_background(image, x0 - reach, y0 - reach, x1 + reach, y1 + reach, peak)
        # Quantisation alone leaves 1/12 when the background is too quiet to show it.
        noise[i] = max(variance, 1.0 / 12.0)
        middle = background + 0.5 * (peak - background)
        half_area = 0
        total = 0.0
        cx = 0.0
        cy = 0.0
        for y in range(max(0, y0 - 1), min(height, y1 + 2)):
            for x in range(max(0, x0 - 1), min(width, x1 + 2)):
                value = float(image[y, x])
                if value > middle:
                    half_area += 1
                    total += value - background
                    cx += x * (value - background)
                    cy += y * (value - background)
        for column in range(MEASURE_COLUMNS):
            table[i, column] = np.nan
        table[i, PEAK] = peak
        table[i, BACKGROUND] = background
        table[i, CLIPPED] = clipped
        if total <= 0.0:
            continue
        # Area above half height of a Gaussian is 2 pi s^2 ln 2.
        s = max(WINDOW_RATIO * sqrt(half_area / 4.355172180607204), 1.1)
        table[i, WIDTH] = s
        table[i, CX] = cx / total
        table[i, CY] = cy / total
        _measure_one(image, gain_e_per_dn, noise, table, i, s)
    for i in range(n):
        if np.isnan(table[i, CX]):
            continue
        nearest = np.inf
        for j in range(n):
            if j != i and not np.isnan(table[j, CX]):
                d = sqrt((table[i, CX] - table[j, CX]) ** 2 + (table[i, CY] - table[j, CY]) ** 2)
                if d < 4.0 * (table[i, WIDTH] + table[j, WIDTH]):
                    nearest = min(nearest, d)
        if nearest < np.inf:
            _measure_one(image, gain_e_per_dn, noise, table, i, min(table[i, WIDTH], max(1.1, 0.25 * nearest)))
