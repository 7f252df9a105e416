"""Compiled passes over raw pixels: tile maxima, background and noise, bright components grown from peaks."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.capture import ImageArray

TILE_PX = 16
MAX_PEAKS = 4096
# Columns of the component table.
AREA, SUM_X, SUM_Y, X0, Y0, X1, Y1, PERIMETER, COMPONENT_COLUMNS = 0, 1, 2, 3, 4, 5, 6, 7, 8


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
    out = np.empty((rows, columns))
    n = columns * TILE_PX
    # Room for a line to be read up to 15 px on; beyond the picture it is 0. The loops stay in the pixel's own type and
    # work on arrays that lie apart, so that they run on whole registers.
    tops = np.zeros((rows, n + TILE_PX), dtype=image.dtype)
    moved = np.zeros(n, dtype=image.dtype)
    for row in range(rows):
        y0 = row * TILE_PX
        top = tops[row]
        line = image[y0]
        for x in range(width):
            top[x] = line[x]
        for y in range(y0 + 1, min(y0 + TILE_PX, height)):
            line = image[y]
            for x in range(width):
                p = top[x]
                q = line[x]
                if q > p:
                    p = q
                top[x] = p
        for shift in (8, 4, 2, 1):
            for x in range(n):
                moved[x] = top[x + shift]
            for x in range(n):
                p = top[x]
                q = moved[x]
                if q > p:
                    p = q
                top[x] = p
        for column in range(columns):
            out[row, column] = top[column * TILE_PX]
    return out


@compiled
def background_and_noise(image: ImageArray, maxima: FloatArray) -> tuple[float, float]:
    """Median of a sparse grid, and the deviation of the pixel noise from neighbours along the rows.

    Lights cover a small part of a picture, so a median does not see them, and differences of neighbours do not see a
    gradient. Both medians are taken within their grey step, because quiet pictures vary by one step.

    Args:
        image: Brightness, shape (H, W).
        maxima: Its tile maxima.

    Returns:
        Background and noise, DN.
    """
    height, width = image.shape
    step_y = 1 if height * width <= 4096 else 29
    step_x = 1 if height * width <= 4096 else 31
    brightest = 0
    for row in range(maxima.shape[0]):
        for column in range(maxima.shape[1]):
            brightest = max(brightest, int(maxima[row, column]))
    levels = np.zeros(brightest + 1, dtype=np.int32)
    steps = np.zeros(brightest + 1, dtype=np.int32)
    n = 0
    pairs = 0
    for y in range(min(3, step_y - 1), height, step_y):
        for x in range(min(4, step_x - 1), width, step_x):
            value = np.int64(image[y, x])
            levels[value] += 1
            n += 1
            if x + 1 < width:
                steps[abs(value - np.int64(image[y, x + 1]))] += 1
                pairs += 1
    # A difference of 0 stands for up to half a step, one of k for k - 1/2 to k + 1/2. The median of the absolute
    # difference of two normal values is 0.954 of their deviation.
    noise = 0.0
    if pairs > 0:
        noise = max(_median(steps, pairs) if 2 * steps[0] < pairs else 0.5 * pairs / (2.0 * steps[0]), 0.0) / 0.954
    return _median(levels, n), noise


@compiled
def _median(counts: NDArray[np.int32], n: int) -> float:
    """Median of n whole numbers from their histogram, even within the middle step."""
    below = 0
    value = 0
    while 2 * (below + counts[value]) < n:
        below += counts[value]
        value += 1
    return float(value - 0.5 + (0.5 * n - below) / counts[value])


@compiled
def _find_peaks(
    image: ImageArray,
    level: float,
    x0: int,
    y0: int,
    x1: int,
    y1: int,
    ys: NDArray[np.int64],
    xs: NDArray[np.int64],
    count: int,
) -> int:
    """Add local maxima of a box (ends excluded) above a level; the last of a plateau stands for it. -1: too many."""
    height, width = image.shape
    for y in range(y0, y1):
        for x in range(x0, x1):
            value = image[y, x]
            if value <= level:
                continue
            is_peak = True
            for v in range(max(0, y - 1), min(height, y + 2)):
                for u in range(max(0, x - 1), min(width, x + 2)):
                    other = image[v, u]
                    if other > value or (other == value and (v > y or (v == y and u > x))):
                        is_peak = False
            if is_peak:
                if count == ys.shape[0]:
                    return -1
                ys[count] = y
                xs[count] = x
                count += 1
    return count


@compiled
def surroundings(image: ImageArray, y: int, x: int, half: int) -> tuple[float, float, float, float]:
    """Mean and deviation of the window around a pixel, then of its darker half: background and noise, all DN."""
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
    total = 0.0
    square = 0.0
    n = 0
    for v in range(max(0, y - half), min(height, y + half + 1), 2):
        for u in range(max(0, x - half), min(width, x + half + 1), 2):
            value = float(image[v, u])
            if value < middle:
                total += value
                square += value * value
                n += 1
    if n == 0:
        return mean, sigma, peak, 0.0
    background = total / n
    return mean, sigma, background, sqrt(max(square / n - background * background, 0.0))


@compiled
def _label(slots: NDArray[np.int32], blocks: NDArray[np.int32], v: int, u: int) -> int:
    """Label of a pixel; tiles that were never touched have none."""
    slot = slots[v >> 4, u >> 4]
    return 0 if slot == 0 else int(blocks[slot - 1, ((v & 15) << 4) | (u & 15)])


@compiled
def _perimeter(
    slots: NDArray[np.int32], blocks: NDArray[np.int32], label: int, x0: int, y0: int, x1: int, y1: int
) -> float:
    """Length of the outline through the middles of pixel edges, by 2 x 2 patterns. Source: Gray, 1971, bit quads."""
    length = 0.0
    for y in range(y0 - 1, y1 + 1):
        for x in range(x0 - 1, x1 + 1):
            a = y >= y0 and x >= x0 and _label(slots, blocks, y, x) == label
            b = y >= y0 and x < x1 and _label(slots, blocks, y, x + 1) == label
            c = y < y1 and x >= x0 and _label(slots, blocks, y + 1, x) == label
            d = y < y1 and x < x1 and _label(slots, blocks, y + 1, x + 1) == label
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
def grow_components(
    image: ImageArray,
    ys: NDArray[np.int64],
    xs: NDArray[np.int64],
    half: int,
    k: float,
    floor: float,
    floor_share: float,
    table: FloatArray,
) -> int:
    """Grow 8-connected components from peaks, each down to its own local threshold.

    The threshold is ``mean + k sigma`` of the window as in the paper, but never above half the peak's height, because a
    large blob fills its own window and raises both. It depends on the surroundings of the peak alone, so that a blob is
    the same whether the whole picture was searched or only its window. Peaks are taken from the brightest down; a
    region that runs into an earlier one is that one's flank and is dropped.

    Args:
        image: Brightness, shape (H, W), uint8 or uint16.
        ys: Rows of the peaks.
        xs: Columns of the peaks.
        half: Half side of the local window, px.
        k: k of ``mean + k sigma``.
        floor: Least height of a peak above its local background, DN.
        floor_share: Least height of the threshold, as twice the fraction of the peak's.
        table: Output, shape (capacity, COMPONENT_COLUMNS).

    Returns:
        Number of components, or -1 when there are more than fit.
    """
    height, width = image.shape
    peaks = ys.shape[0]
    values = np.empty(peaks)
    for i in range(peaks):
        values[i] = -float(image[ys[i], xs[i]])
    order = np.argsort(values, kind="mergesort")
    # Labels by tile, made when a component first touches one: clearing a whole picture costs more than all the rest.
    slots = np.zeros(((height >> 4) + 1, (width >> 4) + 1), dtype=np.int32)
    blocks = np.empty((64, TILE_PX * TILE_PX), dtype=np.int32)
    used = 0
    stack = np.empty(1024, dtype=np.int64)
    count = 0
    label = 0
    for index in order:
        y = ys[index]
        x = xs[index]
        if _label(slots, blocks, y, x) != 0:
            continue
        mean, sigma, background, noise = surroundings(image, y, x, half)
        peak_dn = float(image[y, x]) - background
        if peak_dn < max(floor, 5.0 * noise) or peak_dn <= 0.0:
            continue
        least = 0.5 * max(floor_share * peak_dn, 5.0 * noise)
        threshold = background + max(min(mean + k * sigma - background, 0.5 * peak_dn), least)
        label += 1
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
        if slots[y >> 4, x >> 4] == 0:
            if used == blocks.shape[0]:
                blocks = np.concatenate((blocks, np.empty_like(blocks)))
            blocks[used] = 0
            used += 1
            slots[y >> 4, x >> 4] = used
        blocks[slots[y >> 4, x >> 4] - 1, ((y & 15) << 4) | (x & 15)] = label
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
                    if not image[b, a] > threshold:
                        continue
                    slot = slots[b >> 4, a >> 4]
                    if slot == 0:
                        if used == blocks.shape[0]:
                            blocks = np.concatenate((blocks, np.empty_like(blocks)))
                        blocks[used] = 0
                        used += 1
                        slot = used
                        slots[b >> 4, a >> 4] = slot
                    place = ((b & 15) << 4) | (a & 15)
                    if blocks[slot - 1, place] == 0:
                        blocks[slot - 1, place] = label
                        if top == stack.shape[0]:
                            stack = np.concatenate((stack, np.empty_like(stack)))
                        stack[top] = b * width + a
                        top += 1
                    elif blocks[slot - 1, place] != label:
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
        table[count, PERIMETER] = _perimeter(slots, blocks, label, x0, y0, x1, y1)
        count += 1
    return count


@compiled
def find_components(
    image: ImageArray,
    maxima: FloatArray,
    level: float,
    half: int,
    k: float,
    floor: float,
    floor_share: float,
    table: FloatArray,
) -> int:
    """Bright 8-connected components of a picture, looked for in bright tiles only.

    Args:
        image: Brightness, shape (H, W), uint8 or uint16.
        maxima: Its tile maxima.
        level: Peaks must exceed this, DN.
        half: As for ``grow_components``.
        k: As for ``grow_components``.
        floor: As for ``grow_components``.
        floor_share: As for ``grow_components``.
        table: As for ``grow_components``.

    Returns:
        Number of components, or -1 when there are more peaks or components than fit.
    """
    height, width = image.shape
    ys = np.empty(MAX_PEAKS, dtype=np.int64)
    xs = np.empty(MAX_PEAKS, dtype=np.int64)
    peaks = 0
    for row in range(maxima.shape[0]):
        for column in range(maxima.shape[1]):
            if maxima[row, column] > level:
                x = column * TILE_PX
                y = row * TILE_PX
                x1 = min(x + TILE_PX, width)
                y1 = min(y + TILE_PX, height)
                peaks = _find_peaks(image, level, x, y, x1, y1, ys, xs, peaks)
                if peaks < 0:
                    return -1
    return grow_components(image, ys[:peaks], xs[:peaks], half, k, floor, floor_share, table)


@compiled
def find_components_in(
    image: ImageArray,
    x0: int,
    y0: int,
    x1: int,
    y1: int,
    half: int,
    k: float,
    floor_share: float,
    table: FloatArray,
) -> int:
    """Bright components with their peak in a window of the picture, against the window's own background and noise.

    The window's threshold is never above the whole picture's, so nothing is overlooked that a full search would see.

    Args:
        image: Brightness, shape (H, W), uint8 or uint16.
        x0: First column.
        y0: First row.
        x1: Column past the last.
        y1: Row past the last.
        half: As for ``grow_components``.
        k: As for ``grow_components``.
        floor_share: As for ``grow_components``.
        table: As for ``grow_components``.

    Returns:
        Number of components, or -1 when there are more than fit.
    """
    # The loop stays in the pixel's own type, so that it runs on whole registers.
    tops = np.zeros(y1 - y0, dtype=image.dtype)
    best_y = y0
    for y in range(y0, y1):
        line = image[y, x0:x1]
        top = line[0]
        for x in range(x1 - x0):
            value = line[x]
            if value > top:
                top = value
        tops[y - y0] = top
        if top > tops[best_y - y0]:
            best_y = y
    best_x = x0
    while image[best_y, best_x] < tops[best_y - y0]:
        best_x += 1
    _, _, background, noise = surroundings(image, best_y, best_x, half)
    floor = max(floor_share * (float(image[best_y, best_x]) - background), 5.0 * noise)
    ys = np.empty(256, dtype=np.int64)
    xs = np.empty(256, dtype=np.int64)
    peaks = 0
    for y in range(y0, y1):
        if tops[y - y0] > background + floor:
            peaks = _find_peaks(image, background + floor, x0, y, x1, y + 1, ys, xs, peaks)
            if peaks < 0:
                return -1
    return grow_components(image, ys[:peaks], xs[:peaks], half, k, floor, floor_share, table)
