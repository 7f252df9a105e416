"""Compiled centroids of spots on raw pixels, each with its own deviation."""

from __future__ import annotations

from math import ceil, exp, sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.capture import ImageArray

# Window of the centroid over the width of the spot.
WINDOW_RATIO = 1.4
# Area above half height of a Gaussian over the square of its deviation, 2 pi ln 2.
HALF_AREA = 4.355172180607204
# What the rim of a clipped top adds to the deviation of a centroid, px, at a width of 1 px; falls with the width to the
# power 1.5. By trial on drawn spots without noise; it swings with the height by a factor of two either way.
CLIPPED_SIGMA_PX = 0.017
# Pixels far apart differ by so much more in variance than neighbours where the background is uneven.
_UNEVEN = 1.6
# What is left of the light of a near neighbour, by trial on drawn pairs: this share of the spot's width at so many
# widths, falling at this rate with the distance.
_NEAR_SHARE, _NEAR_WIDTHS, _NEAR_RATE = 0.05, 3.6, 1.5
# Columns of the measurement table.
CX, CY, SIGMA, PEAK, BACKGROUND, WIDTH, CLIPPED, MEASURE_COLUMNS = 0, 1, 2, 3, 4, 5, 6, 7


@compiled
def _ring_background(image: ImageArray, x0: int, y0: int, x1: int, y1: int, peak: float) -> tuple[float, float, bool]:
    """Mean and variance of the undisturbed pixels of a frame 3 px wide around a box, and whether it is uneven.

    Uneven means that neighbours are much more alike than pixels far apart.
    """
    height, width = image.shape
    # Whole numbers add up without rounding in any order, so that the sums run on whole registers.
    frame = np.empty(6 * (x1 - x0 + y1 - y0 + 8), dtype=np.int64)
    filled = 0
    for y in range(max(0, y0 - 3), min(height, y1 + 4)):
        is_side = y >= y0 and y <= y1
        for x in range(max(0, x0 - 3), min(width, x0 if is_side else x1 + 4)):
            frame[filled] = image[y, x]
            filled += 1
        if is_side:
            for x in range(max(0, x1 + 1), min(width, x1 + 4)):
                frame[filled] = image[y, x]
                filled += 1
    limit = peak
    mean = 0.0
    variance = 0.0
    for _ in range(3):
        total = 0
        square = 0
        n = 0
        below = ceil(limit)
        for value in frame[:filled]:
            taken = int(value < below)
            total += taken * int(value)
            square += taken * int(value) * int(value)
            n += taken
        if n < 8:
            break
        mean = total / n
        variance = max(square / n - mean * mean, 0.0)
        limit = min(mean + 3.5 * sqrt(variance) + 1.0, mean + 0.5 * (peak - mean))
    steps = 0.0
    n = 0
    for i in range(1, filled):
        if frame[i] < limit and frame[i - 1] < limit:
            step = frame[i] - frame[i - 1]
            steps += step * step
            n += 1
    return mean, variance, n > 0 and variance > _UNEVEN * max(0.5 * steps / n, 1.0 / 12.0)


@compiled
def _bell(x: float, low: int, high: int, curvature: float, out: FloatArray) -> None:
    """``exp(-curvature (u - x)^2 / 2)`` for u from low up to high, by ratios from the middle outwards."""
    middle = min(max(int(x), low), high - 1)
    d = middle - x
    shrink = exp(-curvature)
    top = exp(-0.5 * curvature * d * d)
    out[middle - low] = top
    value = top
    ratio = exp(-0.5 * curvature * (2.0 * d + 1.0))
    for u in range(middle + 1, high):
        value *= ratio
        ratio *= shrink
        out[u - low] = value
    value = top
    ratio = exp(0.5 * curvature * (2.0 * d - 1.0))
    for u in range(middle - 1, low - 1, -1):
        value *= ratio
        ratio *= shrink
        out[u - low] = value


@compiled
def _settle(
    patch: FloatArray, x: float, y: float, s: float, noise: float, gain_e_per_dn: float, clip: float
) -> tuple[float, float, float, float]:
    """Fixed point of the windowed centroid in a patch without background, its variance and slope; NaN when it wanders.

    Newton's method on ``sum w I (u - x) = 0``; its slope is what the error propagation needs as well. Columns are
    summed first, because sums side by side run on whole registers. Pixels that reach ``clip`` have no noise.
    """
    height, width = patch.shape
    # There the product of window and spot is below 1e-5.
    r = ceil(3.0 * s)
    start_x = x
    start_y = y
    ex = np.empty(2 * r + 2)
    ey = np.empty(2 * r + 2)
    light = np.empty(2 * r + 2)
    first = np.empty(2 * r + 2)
    second = np.empty(2 * r + 2)
    curvature = 1.0 / (s * s)
    for _ in range(25):
        u0 = max(0, int(x) - r)
        u1 = min(width, int(x) + r + 2)
        v0 = max(0, int(y) - r)
        v1 = min(height, int(y) + r + 2)
        if u0 >= u1 or v0 >= v1:
            break
        n = u1 - u0
        _bell(x, u0, u1, curvature, ex)
        _bell(y, v0, v1, curvature, ey)
        light[:] = 0.0
        first[:] = 0.0
        second[:] = 0.0
        for v in range(v0, v1):
            dy = v - y
            w0 = ey[v - v0]
            w1 = w0 * dy
            w2 = w0 * (1.0 - curvature * dy * dy)
            row = patch[v, u0:u1]
            for k in range(n):
                light[k] += w0 * row[k]
                first[k] += w1 * row[k]
                second[k] += w2 * row[k]
        weight = mx = my = slope_x = slope_y = 0.0
        for k in range(n):
            dx = u0 + k - x
            weight += ex[k] * light[k]
            mx += ex[k] * light[k] * dx
            my += ex[k] * first[k]
            slope_x += ex[k] * light[k] * (1.0 - curvature * dx * dx)
            slope_y += ex[k] * second[k]
        if weight <= 0.0:
            break
        # Far from a centre the slope may be anything; the plain iteration of the windowed centroid goes half the way.
        step_x = mx / slope_x if slope_x > 0.25 * weight else 2.0 * mx / weight
        step_y = my / slope_y if slope_y > 0.25 * weight else 2.0 * my / weight
        # Newton's step squares the error, so that after a step this small 1e-6 px is left at most.
        if abs(step_x) + abs(step_y) < 5e-4 and slope_x > 0.0 and slope_y > 0.0:
            shot = 1.0 / gain_e_per_dn
            first[:] = 0.0
            second[:] = 0.0
            for v in range(v0, v1):
                dy = v - y
                w0 = ey[v - v0] * ey[v - v0]
                w2 = w0 * dy * dy
                row = patch[v, u0:u1]
                for k in range(n):
                    variance = noise + shot * max(row[k], 0.0) if row[k] < clip else 0.0
                    first[k] += w0 * variance
                    second[k] += w2 * variance
            vx = vy = 0.0
            for k in range(n):
                dx = u0 + k - x
                vx += ex[k] * ex[k] * dx * dx * first[k]
                vy += ex[k] * ex[k] * second[k]
            variance = 0.5 * (vx / (slope_x * slope_x) + vy / (slope_y * slope_y))
            return x + step_x, y + step_y, variance, 0.5 * (slope_x + slope_y)
        x += min(max(step_x, -s), s)
        y += min(max(step_y, -s), s)
        if abs(x - start_x) + abs(y - start_y) > 2.0 + 2.0 * s:
            break
    return np.nan, np.nan, np.nan, np.nan


@compiled
def _patch_of(image: ImageArray, x0: int, y0: int, size: int, background: float) -> FloatArray:
    """A square of the picture above a background; outside the picture it is 0, as if the background went on."""
    height, width = image.shape
    out = np.zeros((size, size))
    left = max(0, -x0)
    n = min(size, width - x0) - left
    if n > 0:
        for v in range(max(0, -y0), min(size, height - y0)):
            line = image[y0 + v, x0 + left : x0 + left + n]
            row = out[v, left : left + n]
            for u in range(n):
                row[u] = line[u] - background
    return out


@compiled
def _unevenness(image: ImageArray, x: float, y: float, s: float, background: float) -> float:
    """Variance of the first moment of the background alone: its median over eight places around a spot.

    Noise that is alike over several pixels, as a texture's, moves a centroid by more than its variance says.
    """
    height, width = image.shape
    r = ceil(3.0 * s)
    away = ceil(4.0 * s) + 2
    squares = np.empty(16)
    n = 0
    curvature = 1.0 / (s * s)
    ex = np.empty(2 * r + 1)
    for u in range(2 * r + 1):
        ex[u] = exp(-0.5 * (u - r) * (u - r) * curvature)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            cx = int(x) + dx * away
            cy = int(y) + dy * away
            if (dx == 0 and dy == 0) or cx < r or cy < r or cx + r >= width or cy + r >= height:
                continue
            mx = my = 0.0
            for v in range(2 * r + 1):
                line = image[cy - r + v, cx - r : cx + r + 1]
                light = first = 0.0
                for u in range(2 * r + 1):
                    w = ex[u] * (float(line[u]) - background)
                    light += w
                    first += w * (u - r)
                mx += ex[v] * first
                my += ex[v] * (v - r) * light
            squares[n] = mx * mx
            squares[n + 1] = my * my
            n += 2
    # The median of the square of a normal value is 0.455 of its variance.
    return float(np.median(squares[:n])) / 0.455 if n > 0 else 0.0


@compiled
def _measure_one(
    image: ImageArray,
    gain_e_per_dn: float,
    full_scale: float,
    noise: FloatArray,
    is_uneven: NDArray[np.bool_],
    place: FloatArray,
    among: bool,
    table: FloatArray,
    i: int,
    s: float,
) -> None:
    """Settle one centroid from its place; ``among`` others their light is taken away first, from where they are."""
    half = ceil(5.0 * s) + 5
    x0 = int(place[i, 0]) - half
    y0 = int(place[i, 1]) - half
    patch = _patch_of(image, x0, y0, 2 * half + 1, table[i, BACKGROUND])
    near = 0.0
    if among:
        ex = np.empty(2 * half + 1)
        ey = np.empty(2 * half + 1)
        for j in range(table.shape[0]):
            if j == i or np.isnan(table[j, WIDTH]):
                continue
            sigma = table[j, WIDTH] / WINDOW_RATIO
            height = table[j, PEAK] - table[j, BACKGROUND]
            apart = sqrt((place[j, 0] - place[i, 0]) ** 2 + (place[j, 1] - place[i, 1]) ** 2)
            if apart > 2.0 * half + 5.0 * sigma:
                continue
            wider = max(sigma, table[i, WIDTH] / WINDOW_RATIO)
            near += (_NEAR_SHARE * wider * exp(-_NEAR_RATE * (apart / wider - _NEAR_WIDTHS))) ** 2
            reach = ceil(5.0 * sigma)
            u0 = max(0, int(place[j, 0]) - x0 - reach)
            u1 = min(patch.shape[1], int(place[j, 0]) - x0 + reach + 2)
            v0 = max(0, int(place[j, 1]) - y0 - reach)
            v1 = min(patch.shape[0], int(place[j, 1]) - y0 + reach + 2)
            if u0 >= u1 or v0 >= v1:
                continue
            _bell(place[j, 0] - x0, u0, u1, 1.0 / (sigma * sigma), ex)
            _bell(place[j, 1] - y0, v0, v1, 1.0 / (sigma * sigma), ey)
            for v in range(v0, v1):
                row = patch[v, u0:u1]
                w = height * ey[v - v0]
                for k in range(u1 - u0):
                    row[k] -= w * ex[k]
    clip = full_scale - table[i, BACKGROUND] - 0.5
    x, y, variance, slope = _settle(patch, place[i, 0] - x0, place[i, 1] - y0, s, noise[i], gain_e_per_dn, clip)
    x += x0
    y += y0
    if table[i, CLIPPED] > 0.0:
        # Half height of what is left and the clipped top bound areas of a Gaussian of the same width.
        half_area = HALF_AREA * (table[i, WIDTH] / WINDOW_RATIO) ** 2
        spot_px2 = max((half_area - table[i, CLIPPED]) / HALF_AREA, 0.25)
        variance += CLIPPED_SIGMA_PX * CLIPPED_SIGMA_PX / spot_px2**1.5
    if is_uneven[i] and slope > 0.0:
        variance += _unevenness(image, x, y, s, table[i, BACKGROUND]) / (slope * slope)
    if among:
        move = sqrt((x - place[i, 0]) ** 2 + (y - place[i, 1]) ** 2)
        variance += near + 0.04 * move * move
        if not move < 0.6 * table[i, WIDTH]:
            # It ran off to its neighbour.
            x = y = variance = np.nan
    table[i, CX] = x
    table[i, CY] = y
    table[i, SIGMA] = sqrt(variance)


@compiled
def measure_blobs(
    image: ImageArray,
    boxes: FloatArray,
    is_wanted: NDArray[np.bool_],
    gain_e_per_dn: float,
    full_scale: float,
    table: FloatArray,
) -> None:
    """Centroid of each blob on raw pixels, weighted by intensity above local background and a Gaussian window.

    The window sits on the centroid it finds (a fixed point), so a symmetric spot has no bias from where it is cut off,
    and a constant background error has no influence. It is wider than the spot: better against shot noise, and the sum
    over pixels does not depend on where within a pixel the spot lies. Light of a near neighbour is taken away first, as
    a Gaussian of the neighbour's height and width; a fifth of what that changes is added to the deviation, and what is
    left of a very near one. On an uneven background the deviation is what the background does around the spot.

    Args:
        image: Brightness, shape (H, W).
        boxes: Bounding boxes x0, y0, x1, y1, inclusive, shape (n, 4), raw px.
        is_wanted: Which are worth a centroid; of the others only the peak and the clipped pixels are said, shape (n,).
        gain_e_per_dn: Electrons per DN.
        full_scale: Largest DN; pixels there are clipped.
        table: Output, shape (n, MEASURE_COLUMNS); NaN centroid when it did not settle.

    Source: Bertin and Arnouts, SExtractor, windowed positions; deviation by error propagation of the fixed point.
    """
    height, width = image.shape
    n = boxes.shape[0]
    noise = np.empty(n)
    place = np.empty((n, 2))
    is_uneven = np.empty(n, dtype=np.bool_)
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
        for column in range(MEASURE_COLUMNS):
            table[i, column] = np.nan
        table[i, PEAK] = peak
        table[i, CLIPPED] = clipped
        if not is_wanted[i]:
            continue
        reach = ceil(0.75 * max(x1 - x0 + 1, y1 - y0 + 1)) + 2
        background, variance, is_uneven[i] = _ring_background(
            image, x0 - reach, y0 - reach, x1 + reach, y1 + reach, peak
        )
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
        table[i, BACKGROUND] = background
        if total <= 0.0:
            continue
        s = max(WINDOW_RATIO * sqrt(half_area / HALF_AREA), 1.1)
        table[i, WIDTH] = s
        place[i, 0] = cx / total
        place[i, 1] = cy / total
    for i in range(n):
        if np.isnan(table[i, WIDTH]):
            continue
        nearest = _nearest(place, table, i)
        if nearest == np.inf:
            _measure_one(image, gain_e_per_dn, full_scale, noise, is_uneven, place, False, table, i, table[i, WIDTH])
    # The lights among others are gone through twice, each time from where the last one put their neighbours.
    for _ in range(2):
        for i in range(n):
            if np.isnan(table[i, WIDTH]):
                continue
            nearest = _nearest(place, table, i)
            if nearest < np.inf:
                s = min(table[i, WIDTH], max(1.1, 0.25 * nearest))
                _measure_one(image, gain_e_per_dn, full_scale, noise, is_uneven, place, True, table, i, s)
        for i in range(n):
            if np.isfinite(table[i, SIGMA]):
                place[i, 0] = table[i, CX]
                place[i, 1] = table[i, CY]


@compiled
def _nearest(place: FloatArray, table: FloatArray, i: int) -> float:
    """Distance of the nearest spot whose light may reach into the window of another, px; infinite without one."""
    nearest = np.inf
    for j in range(place.shape[0]):
        if j != i and not np.isnan(table[j, WIDTH]):
            d = sqrt((place[i, 0] - place[j, 0]) ** 2 + (place[i, 1] - place[j, 1]) ** 2)
            if d < 4.0 * (table[i, WIDTH] + table[j, WIDTH]):
                nearest = min(nearest, d)
    return nearest
