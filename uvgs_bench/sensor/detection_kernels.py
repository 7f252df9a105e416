"""Compiled growth of bright components from peaks, each down to its own local threshold."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.capture import ImageArray
from uvgs_bench.sensor.growth_kernels import BLOCK_PX, ENDLESS, FLANK, erase, grow, label_of
from uvgs_bench.sensor.peak_kernels import MAX_PEAKS, find_peaks, find_window_peaks, is_bounded, stands_out

# Columns of the component table.
AREA, SUM_X, SUM_Y, X0, Y0, X1, Y1, PERIMETER, COMPONENT_COLUMNS = 0, 1, 2, 3, 4, 5, 6, 7, 8
# Where the full window shows no light or its component has no end, narrower ones look closer: half sides, px.
_CLOSER_PX = (15, 8)
# There a light must be so much higher than elsewhere, because specks stand alone in narrow windows.
_CLOSER_FLOOR = 2.0
# A light is wide when 4 px from its top the first share of its height is left, and alone when nothing on the rim of its
# window is higher than the second.
_SHOULDER, _RIM = 0.7, 0.6
# Two peaks are two lights when the picture between them falls by this share of the lower one's height.
_SADDLE = 0.1
# Places higher than this are not looked at for two lights, px.
_MOST_SPLIT_PX = 20


@compiled
def _surroundings(image: ImageArray, y: int, x: int, half: int) -> tuple[float, float, float, float]:
    """Mean and deviation of the window around a pixel, then of its darker half: background and noise, all DN.

    Of a texture the darker half is half of a normal distribution; what cutting it took from its deviation is given
    back by how many pixels are left.
    """
    height, width = image.shape
    x0 = max(0, x - half)
    x1 = min(width, x + half + 1)
    # Whole numbers, in loops that run on whole registers.
    total = 0
    square = 0
    n = 0
    peak = int(image[y, x])
    lowest = image[y, x]
    for v in range(max(0, y - half), min(height, y + half + 1), 2):
        line = image[v, x0:x1]
        n += x1 - x0
        for u in range(x1 - x0):
            p = line[u]
            value = int(p)
            total += value
            square += value * value
            if p < lowest:
                lowest = p
    mean = total / n
    sigma = sqrt(max(square / n - mean * mean, 0.0))
    middle = (int(lowest) + peak + 1) // 2
    total = 0
    square = 0
    dark = 0
    for v in range(max(0, y - half), min(height, y + half + 1), 2):
        line = image[v, x0:x1]
        for u in range(x1 - x0):
            value = int(line[u])
            is_dark = 1 if value < middle else 0
            value *= is_dark
            total += value
            square += value * value
            dark += is_dark
    if dark == 0:
        return mean, sigma, float(peak), 0.0
    background = total / dark
    noise = sqrt(max(square / dark - background * background, 0.0))
    if not _is_wide_light(image, y, x, half, background):
        # Of a normal distribution cut in the middle 0.6 of the deviation is left.
        noise /= min(max(0.8 * dark / n + 0.2, 0.6), 1.0)
    return mean, sigma, background, noise


@compiled
def _is_wide_light(image: ImageArray, y: int, x: int, half: int, background: float) -> bool:
    """Whether a peak is high all about it, and a flat top or the only high place up to the rim of its window.

    Then what is dark there is its flank, and no texture: bumps as wide as that are round and have others beside them.
    """
    height, width = image.shape
    rise = float(image[y, x]) - background
    shoulder = background + _SHOULDER * rise
    flat = 0
    for v, u in ((y - 4, x), (y + 4, x), (y, x - 4), (y, x + 4)):
        if v >= 0 and v < height and u >= 0 and u < width:
            if float(image[v, u]) < shoulder:
                return False
            flat += image[v, u] == image[y, x]
    if flat >= 2:
        return True
    level = background + _RIM * rise
    x0 = max(0, x - half)
    x1 = min(width, x + half + 1)
    y0 = max(0, y - half)
    y1 = min(height, y + half + 1)
    for u in range(x0, x1, 2):
        if float(image[y0, u]) > level or float(image[y1 - 1, u]) > level:
            return False
    is_alone = True
    for v in range(y0, y1, 2):
        is_alone &= float(image[v, x0]) <= level and float(image[v, x1 - 1]) <= level
    return is_alone


@compiled
def _threshold(
    image: ImageArray, y: int, x: int, half: int, k: float, floor: float, floor_share: float
) -> tuple[float, float]:
    """Local threshold of a peak and its background, DN; the threshold is NaN when the peak does not stand out."""
    mean, sigma, background, noise = _surroundings(image, y, x, half)
    peak_dn = float(image[y, x]) - background
    if peak_dn < max(floor, 5.0 * noise) or peak_dn <= 0.0:
        return np.nan, background
    least = 0.5 * max(floor_share * peak_dn, 5.0 * noise)
    return background + max(min(mean + k * sigma - background, 0.5 * peak_dn), least), background


@compiled
def _perimeter(runs: NDArray[np.int64], x0: int, y0: int, x1: int, y1: int) -> float:
    """Length of the outline through the middles of pixel edges, by 2 x 2 patterns. Source: Gray, 1971, bit quads."""
    is_inside = np.zeros((y1 - y0 + 3, x1 - x0 + 3), dtype=np.uint8)
    for i in range(runs.shape[0]):
        is_inside[runs[i, 0] - y0 + 1, runs[i, 1] - x0 + 1 : runs[i, 2] - x0 + 2] = 1
    straight = 0
    halves = 0
    for y in range(is_inside.shape[0] - 1):
        above = is_inside[y]
        below = is_inside[y + 1]
        for x in range(is_inside.shape[1] - 1):
            n = above[x] + above[x + 1] + below[x] + below[x + 1]
            if n == 1 or n == 3:
                halves += 1
            elif n == 2:
                if above[x] == below[x + 1]:
                    halves += 2
                else:
                    straight += 1
    return straight + 0.7071067811865476 * halves


@compiled
def _box_mean(image: ImageArray, y: int, x: int) -> float:
    """Mean of 3 x 3 px."""
    height, width = image.shape
    total = 0.0
    n = 0
    for v in range(max(0, y - 1), min(height, y + 2)):
        for u in range(max(0, x - 1), min(width, x + 2)):
            total += float(image[v, u])
            n += 1
    return total / n


@compiled
def _saddle(image: ImageArray, y: int, x: int, other_y: int, other_x: int, background: float, floor: float) -> float:
    """Level that parts two peaks when they are two lights, else 0, DN: above the lowest place of the line between."""
    steps = 2 * max(abs(other_y - y), abs(other_x - x))
    lower = min(_box_mean(image, y, x), _box_mean(image, other_y, other_x))
    lowest = lower
    for i in range(1, steps):
        v = y + round((other_y - y) * i / steps)
        u = x + round((other_x - x) * i / steps)
        lowest = min(lowest, _box_mean(image, v, u))
    if lower - lowest <= max(_SADDLE * (lower - background), 0.3 * floor):
        return 0.0
    # So much higher that the two do not touch at a corner.
    return lowest + 0.3 * (lower - lowest)


@compiled
def grow_components(
    image: ImageArray,
    ys: NDArray[np.int64],
    xs: NDArray[np.int64],
    half: int,
    k: float,
    floor: float,
    floor_share: float,
    most_px: int,
    table: FloatArray,
) -> int:
    """Grow 8-connected components from peaks, each down to its own local threshold.

    The threshold is ``mean + k sigma`` of the window as in the paper, but never above half the peak's height, because a
    large blob fills its own window and raises both. It depends on the surroundings of the peak alone, so that a blob is
    the same whether the whole picture was searched or only its window. Peaks are taken from the brightest down; a
    region that runs into an earlier one is that one's flank and is dropped. One that has no end, as a bright sheet, is
    given up; a light before or beside it is looked for in a narrower window. Where a region holds two lights, their
    thresholds are raised until it falls apart.

    Args:
        image: Brightness, shape (H, W), uint8 or uint16.
        ys: Rows of the peaks.
        xs: Columns of the peaks.
        half: Half side of the local window, px.
        k: k of ``mean + k sigma``.
        floor: Least height of a peak above its local background, DN.
        floor_share: Least height of the threshold, as twice the fraction of the peak's.
        most_px: Largest component, px.
        table: Output, shape (capacity, COMPONENT_COLUMNS).

    Returns:
        Number of components, or -1 when there are more than fit.
    """
    longest = longest_px(most_px)
    height, width = image.shape
    peaks = ys.shape[0]
    values = np.empty(peaks)
    for i in range(peaks):
        values[i] = -float(image[ys[i], xs[i]])
    order = np.argsort(values, kind="mergesort")
    # Labels by block, made when a component first touches one: clearing a whole picture costs more than all the rest.
    slots = np.zeros(((height >> 4) + 1, (width >> 4) + 1), dtype=np.int32)
    blocks = np.empty((64, BLOCK_PX * BLOCK_PX), dtype=np.int32)
    used = 0
    runs = np.empty((most_px, 3), dtype=np.int64)
    is_endless = np.zeros((1 + len(_CLOSER_PX)) * peaks + 1, dtype=np.bool_)
    raised = np.zeros(peaks)
    count = 0
    label = 0
    for at in range(peaks):
        index = order[at]
        y = ys[index]
        x = xs[index]
        mark = label_of(slots, blocks, y, x)
        if mark != 0 and not is_endless[mark]:
            continue
        for look in range(1 + len(_CLOSER_PX)):
            window = half
            most = most_px
            if look > 0:
                window = _CLOSER_PX[look - 1]
                most = window * window
                if window >= half:
                    continue
            elif mark != 0:
                continue
            least = floor if look == 0 else _CLOSER_FLOOR * floor
            if look == 1 and not stands_out(image, y, x, least):
                break
            threshold, background = _threshold(image, y, x, window, k, least, floor_share)
            if np.isnan(threshold):
                continue
            if look == 0 and not is_bounded(image, y, x, threshold, 1, longest):
                continue
            threshold = max(threshold, raised[index])
            label += 1
            status, filled, used, blocks = grow(
                image, y, x, threshold, label, most, look > 0, is_endless, slots, blocks, used, runs
            )
            if status == ENDLESS:
                is_endless[label] = True
                continue
            for _ in range(4):
                if runs[filled - 1, 0] - y > _MOST_SPLIT_PX or filled > 2 * _MOST_SPLIT_PX:
                    break
                higher = threshold
                for later in range(at + 1, peaks):
                    other = order[later]
                    if label_of(slots, blocks, ys[other], xs[other]) != label:
                        continue
                    level = _saddle(image, y, x, ys[other], xs[other], background, floor)
                    if level > 0.0:
                        raised[other] = max(raised[other], level)
                        # It leaked round the line between them.
                        if level <= threshold:
                            level = 0.5 * (threshold + float(image[ys[other], xs[other]]))
                        higher = max(higher, level)
                if higher <= threshold:
                    break
                threshold = higher
                erase(runs[:filled], label, slots, blocks)
                status, filled, used, blocks = grow(
                    image, y, x, threshold, label, most, look > 0, is_endless, slots, blocks, used, runs
                )
            if status == FLANK:
                break
            if count == table.shape[0]:
                return -1
            _describe(runs[:filled], table[count])
            count += 1
            break
    return count


@compiled
def longest_px(most_px: int) -> int:
    """How long a component of so many pixels can be: a light is at most a few times as long as wide.

    Args:
        most_px: Its pixels.

    Returns:
        Its length, px.
    """
    return int(1.5 * sqrt(most_px))


@compiled
def _describe(runs: NDArray[np.int64], row: FloatArray) -> None:
    """Fill a row of the component table."""
    area = 0
    sum_x = 0.0
    sum_y = 0.0
    x0 = y0 = 1 << 40
    x1 = y1 = 0
    for i in range(runs.shape[0]):
        v = int(runs[i, 0])
        first = int(runs[i, 1])
        last = int(runs[i, 2])
        n = last - first + 1
        area += n
        sum_x += 0.5 * n * (first + last)
        sum_y += float(n * v)
        x0 = min(x0, first)
        x1 = max(x1, last)
        y0 = min(y0, v)
        y1 = max(y1, v)
    row[AREA] = area
    row[SUM_X] = sum_x
    row[SUM_Y] = sum_y
    row[X0] = x0
    row[Y0] = y0
    row[X1] = x1
    row[Y1] = y1
    row[PERIMETER] = _perimeter(runs, x0, y0, x1, y1)


@compiled
def find_components(
    image: ImageArray,
    maxima: ImageArray,
    half: int,
    k: float,
    floor: float,
    floor_share: float,
    most_px: int,
    table: FloatArray,
) -> int:
    """Bright 8-connected components of a picture, looked for in bright tiles only.

    Args:
        image: Brightness, shape (H, W), uint8 or uint16.
        maxima: Its tile maxima.
        half: As for ``grow_components``.
        k: As for ``grow_components``.
        floor: As for ``grow_components``.
        floor_share: As for ``grow_components``.
        most_px: As for ``grow_components``.
        table: As for ``grow_components``.

    Returns:
        Number of components, or -1 when there are more peaks or components than fit.
    """
    ys = np.empty(MAX_PEAKS, dtype=np.int64)
    xs = np.empty(MAX_PEAKS, dtype=np.int64)
    peaks = find_peaks(image, maxima, floor, half, longest_px(most_px), ys, xs)
    if peaks < 0:
        return -1
    return grow_components(image, ys[:peaks], xs[:peaks], half, k, floor, floor_share, most_px, table)


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
    most_px: int,
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
        most_px: As for ``grow_components``.
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
    _, _, background, noise = _surroundings(image, best_y, best_x, half)
    floor = max(floor_share * (float(image[best_y, best_x]) - background), 5.0 * noise)
    ys = np.empty(256, dtype=np.int64)
    xs = np.empty(256, dtype=np.int64)
    peaks = 0
    for y in range(y0, y1):
        if tops[y - y0] > background + floor:
            peaks = find_window_peaks(image, background + floor, x0, y, x1, y + 1, ys, xs, peaks)
            if peaks < 0:
                return -1
    return grow_components(image, ys[:peaks], xs[:peaks], half, k, floor, floor_share, most_px, table)
