"""Compiled passes over raw pixels: tile maxima, and peaks that can be the top of a light.

Most of a bright sheet, window or wall is told from lights by tiles; what is left by whether the light falls around it.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.capture import ImageArray

TILE_PX = 8
MAX_PEAKS = 4096
# A small light has fallen by this share of its height above the darkest surroundings, on all sides, at one of these
# distances, px. What falls less must stand out from the tiles around by so many of their deviations.
_DEEP_FALL, _FALL = 0.75, 0.25
_SPREAD = 2.5
_RINGS_PX = (3, 6, 12)
# Larger ones are looked for from the brightest pixel of each tile, in steps of this many px.
_STRIDE_PX = 2


@compiled
def tiles_around(half: int) -> int:
    """How far the surroundings of a tile reach, in tiles.

    Args:
        half: Half side of the local window, px.
    """
    return half // TILE_PX + 1


@compiled
def tile_maxima(image: ImageArray) -> ImageArray:
    """Brightest pixel of each tile of 8 x 8 px, in one pass over memory.

    Args:
        image: Brightness, shape (H, W), uint8 or uint16, C-contiguous.

    Returns:
        Maxima, shape (ceil(H / 8), ceil(W / 8)), same type.
    """
    height, width = image.shape
    rows = (height + TILE_PX - 1) // TILE_PX
    columns = (width + TILE_PX - 1) // TILE_PX
    out = np.empty((rows, columns), dtype=image.dtype)
    n = columns * TILE_PX
    # Room for a line to be read up to 7 px on; beyond the picture it is 0. The loops stay in the pixel's own type and
    # work on arrays that lie apart, so that they run on whole registers.
    top = np.zeros(n + TILE_PX, dtype=image.dtype)
    moved = np.zeros(n, dtype=image.dtype)
    for row in range(rows):
        y0 = row * TILE_PX
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
        for shift in (4, 2, 1):
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
def _darkest_around(maxima: ImageArray, row: int, reach: int, line: ImageArray, out: ImageArray) -> None:
    """Darkest tile within a reach of each tile of a row: what it may be seen against, itself a mount of a few px.

    ``line`` is longer than a row by the reach on both sides, where it stays bright.
    """
    rows, columns = maxima.shape
    middle = line[reach : reach + columns]
    middle[:] = maxima[row]
    for other in range(max(0, row - reach), min(rows, row + reach + 1)):
        _keep_lower(middle, maxima[other])
    out[:] = middle
    for shift in range(2 * reach + 1):
        _keep_lower(out, line[shift : shift + columns])


@compiled
def _keep_lower(target: ImageArray, other: ImageArray) -> None:
    for x in range(target.shape[0]):
        p = target[x]
        q = other[x]
        if q < p:
            p = q
        target[x] = p


@compiled
def _spread_around(maxima: ImageArray, row: int, reach: int, out: FloatArray) -> None:
    """Mean of the tiles within a reach of each tile of a row plus some deviations: bumps of a texture stay below."""
    rows, columns = maxima.shape
    total = np.zeros(columns + 1)
    square = np.zeros(columns + 1)
    first = max(0, row - reach)
    last = min(rows, row + reach + 1)
    for x in range(columns):
        a = 0
        b = 0
        for other in range(first, last):
            value = int(maxima[other, x])
            a += value
            b += value * value
        total[x + 1] = total[x] + a
        square[x + 1] = square[x] + b
    for x in range(columns):
        low = max(0, x - reach)
        high = min(columns, x + reach + 1)
        n = (last - first) * (high - low)
        mean = (total[high] - total[low]) / n
        out[x] = mean + _SPREAD * sqrt(max((square[high] - square[low]) / n - mean * mean, 0.0))


@compiled
def _falls_around(image: ImageArray, y: int, x: int, level: float) -> bool:
    """Whether the picture is below a level on all sides of a pixel at one of the distances of a small light."""
    height, width = image.shape
    for r in _RINGS_PX:
        d = (3 * r + 2) // 4
        if (
            (x < r or image[y, x - r] <= level)
            and (x + r >= width or image[y, x + r] <= level)
            and (y < r or image[y - r, x] <= level)
            and (y + r >= height or image[y + r, x] <= level)
            and (y < d or x < d or image[y - d, x - d] <= level)
            and (y < d or x + d >= width or image[y - d, x + d] <= level)
            and (y + d >= height or x < d or image[y + d, x - d] <= level)
            and (y + d >= height or x + d >= width or image[y + d, x + d] <= level)
        ):
            return True
    return False


@compiled
def stands_out(image: ImageArray, y: int, x: int, floor: float) -> bool:
    """Whether a pixel is above eight around it, at one of the distances of a small light, by 10 of their deviations.

    Args:
        image: Brightness, shape (H, W).
        y: Row.
        x: Column.
        floor: Least height above their mean, DN.

    Returns:
        The answer; places outside of the picture do not count.
    """
    height, width = image.shape
    top = float(image[y, x])
    for r in _RINGS_PX:
        d = (3 * r + 2) // 4
        total = 0.0
        square = 0.0
        n = 0
        for dy, dx in ((0, -r), (0, r), (-r, 0), (r, 0), (-d, -d), (-d, d), (d, -d), (d, d)):
            v = y + dy
            u = x + dx
            if v >= 0 and v < height and u >= 0 and u < width:
                value = float(image[v, u])
                total += value
                square += value * value
                n += 1
        mean = total / n
        rise = top - mean
        if rise >= floor and rise * rise >= 100.0 * (square / n - mean * mean):
            return True
    return False


@compiled
def is_bounded(image: ImageArray, y: int, x: int, level: float, stride: int, reach: int) -> bool:
    """Whether the bright place around a pixel ends, along both axes and diagonals, within a length.

    Args:
        image: Brightness, shape (H, W).
        y: Row.
        x: Column.
        level: What is above is bright, DN.
        stride: Step, px; narrower gaps may be missed.
        reach: Greatest length, px.

    Returns:
        The answer.
    """
    height, width = image.shape
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        steps = 1
        for sign in (1, -1):
            v = y + sign * stride * dy
            u = x + sign * stride * dx
            while v >= 0 and v < height and u >= 0 and u < width and image[v, u] > level:
                steps += 1
                if steps * stride > reach:
                    return False
                v += sign * stride * dy
                u += sign * stride * dx
    return True


@compiled
def find_peaks(
    image: ImageArray,
    maxima: ImageArray,
    floor: float,
    half: int,
    reach: int,
    ys: NDArray[np.int64],
    xs: NDArray[np.int64],
) -> int:
    """Local maxima that can be the top of a light, against the darkest tile of their surroundings.

    A light small against a tile is seen by the fall around it. Of a larger one any pixel will do, so that only the
    brightest peak of each tile is looked at, and left out when the bright place has no end within the reach.

    Args:
        image: Brightness, shape (H, W), uint8 or uint16.
        maxima: Its tile maxima.
        floor: Least height, DN.
        half: Half side of the local window, px.
        reach: Longest light, px.
        ys: Output, rows.
        xs: Output, columns.

    Returns:
        Number of peaks, or -1 when there are more than fit.
    """
    height, width = image.shape
    rows, columns = maxima.shape
    around = tiles_around(half)
    brightest = int(maxima.max())
    # Tiles are compared with whole numbers of their own type.
    step = int(floor)
    lowest = int(maxima.min()) + step
    line = np.empty(columns + 2 * around, dtype=maxima.dtype)
    line[:] = brightest
    darkest = np.empty(columns, dtype=maxima.dtype)
    spread = np.empty(columns)
    spread_row = -1
    count = 0
    padded = np.zeros((TILE_PX + 2, width + 2), dtype=image.dtype)
    is_peak = np.zeros(width, dtype=np.uint8)
    best_y = np.empty(columns, dtype=np.int64)
    best_x = np.empty(columns, dtype=np.int64)
    for row in range(rows):
        if not _top(maxima[row]) > lowest:
            continue
        _darkest_around(maxima, row, around, line, darkest)
        first = 0
        while first < columns:
            if not int(maxima[row, first]) > int(darkest[first]) + step:
                first += 1
                continue
            last = first
            while last < columns and int(maxima[row, last]) > int(darkest[last]) + step:
                best_y[last] = -1
                last += 1
            x0 = first * TILE_PX
            n = min(last * TILE_PX, width) - x0
            y0 = row * TILE_PX
            lines = min(TILE_PX, height - y0)
            for j in range(lines + 2):
                _copy_padded(image, y0 + j - 1, x0, n, padded[j])
            for j in range(lines):
                y = y0 + j
                _mark_peaks(padded[j], padded[j + 1], padded[j + 2], n, is_peak)
                for i in range(n):
                    if is_peak[i] == 0:
                        continue
                    x = x0 + i
                    column = x // TILE_PX
                    top = float(image[y, x])
                    dark = float(darkest[column])
                    if top <= dark + floor:
                        continue
                    is_small = _falls_around(image, y, x, top - max(0.5 * floor, _DEEP_FALL * (top - dark)))
                    if not is_small and _falls_around(image, y, x, top - max(0.5 * floor, _FALL * (top - dark))):
                        if spread_row != row:
                            _spread_around(maxima, row, around, spread)
                            spread_row = row
                        is_small = top > spread[column]
                    if is_small:
                        if count == ys.shape[0]:
                            return -1
                        ys[count] = y
                        xs[count] = x
                        count += 1
                    elif best_y[column] < 0 or image[y, x] >= image[best_y[column], best_x[column]]:
                        best_y[column] = y
                        best_x[column] = x
            for column in range(first, last):
                y = best_y[column]
                if y < 0 or not _is_highest(maxima, row, column):
                    continue
                x = best_x[column]
                top = float(image[y, x])
                if not is_bounded(image, y, x, top - _FALL * (top - float(darkest[column])), _STRIDE_PX, reach):
                    continue
                if count == ys.shape[0]:
                    return -1
                ys[count] = y
                xs[count] = x
                count += 1
            first = last
    return count


@compiled
def _is_highest(maxima: ImageArray, row: int, column: int) -> bool:
    """Whether no tile next to a tile is brighter."""
    rows, columns = maxima.shape
    value = maxima[row, column]
    for r in range(max(0, row - 1), min(rows, row + 2)):
        for c in range(max(0, column - 1), min(columns, column + 2)):
            if maxima[r, c] > value:
                return False
    return True


@compiled
def _top(values: ImageArray) -> int:
    top = values[0]
    for x in range(values.shape[0]):
        p = values[x]
        if p > top:
            top = p
    return int(top)


@compiled
def _copy_padded(image: ImageArray, y: int, x0: int, n: int, target: ImageArray) -> None:
    """Copy a piece of a line with one pixel more on both sides; beyond the picture it is 0."""
    height, width = image.shape
    if y < 0 or y >= height:
        target[: n + 2] = 0
        return
    target[1 : n + 1] = image[y, x0 : x0 + n]
    target[0] = image[y, x0 - 1] if x0 > 0 else 0
    target[n + 1] = image[y, x0 + n] if x0 + n < width else 0


@compiled
def _mark_peaks(above: ImageArray, line: ImageArray, below: ImageArray, n: int, out: NDArray[np.uint8]) -> None:
    """Mark local maxima of a padded line; the last of a plateau stands for it. Runs on whole registers."""
    for i in range(n):
        v = line[i + 1]
        out[i] = (
            (v >= line[i])
            & (v > line[i + 2])
            & (v >= above[i])
            & (v >= above[i + 1])
            & (v >= above[i + 2])
            & (v > below[i])
            & (v > below[i + 1])
            & (v > below[i + 2])
        )


@compiled
def find_window_peaks(
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
    """Add every local maximum of a box (ends excluded) above a level to those found.

    Args:
        image: Brightness, shape (H, W), uint8 or uint16.
        level: They exceed this, DN.
        x0: First column.
        y0: First row.
        x1: Column past the last.
        y1: Row past the last.
        ys: Rows, filled from ``count`` on.
        xs: Columns, likewise.
        count: How many there are already.

    Returns:
        How many there are now, or -1 when there are more than fit. The last of a plateau stands for it.
    """
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
