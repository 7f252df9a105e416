"""Compiled search for every LED in its own window of the picture."""

from __future__ import annotations

from math import ceil, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.lens_kernels import project_point_with_jacobian
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.capture import ImageArray
from uvgs_bench.sensor.centroid_kernels import CX, CY, MEASURE_COLUMNS, SIGMA, WIDTH, WINDOW_RATIO, measure_blobs
from uvgs_bench.sensor.detection_kernels import (
    AREA,
    COMPONENT_COLUMNS,
    PERIMETER,
    X0,
    X1,
    Y0,
    Y1,
    find_components_in,
)
from uvgs_bench.sensor.judging_kernels import BELIEVED, fit_and_judge

# What can come of it.
FOUND, OUT_OF_VIEW, TOO_UNCERTAIN, NOT_ALONE, UNFIT, REFUSED = 0, 1, 2, 3, 4, 5
_MAX_HALF_PX = 72.0
# Half width of the room a centroid needs, over the width of its spot.
_ROOM = 8.0
# A spot as wide as can be expected of an LED: of a point spread of this deviation, px, and of its disc.
_WIDEST_PSF_PX = 1.2
_WIDTH_OF_DISC = 0.85
_DEVIATIONS = 3.5
# An LED this near to the edge of its cone may or may not be seen.
_CONE_SLACK = 0.03


@compiled
def find_leds(
    image: ImageArray,
    model_id: int,
    lens: FloatArray,
    leds: FloatArray,
    axes: FloatArray,
    radii: FloatArray,
    cos_limit: FloatArray,
    R: FloatArray,
    t: FloatArray,
    covariance: FloatArray,
    turn_rad: float,
    shift_m: float,
    half: int,
    threshold_k: float,
    threshold_floor: float,
    min_area: float,
    max_area: float,
    min_circularity: float,
    gain_e_per_dn: float,
    full_scale: float,
    centroid: FloatArray,
    sigma: FloatArray,
    seen: NDArray[np.int64],
) -> tuple[int, int]:
    """Look for each LED that should shine where a predicted pose puts it.

    Every window must hold one blob that can be an LED and nothing else, with room around it; any doubt is left to the
    search of the whole picture.

    Args:
        image: Brightness, shape (H, W).
        model_id: Lens model number.
        lens: Lens parameters for kernels.
        leds: LED positions, shape (n, 3), m.
        axes: Emission axes, shape (n, 3).
        radii: LED radii, shape (n,), m.
        cos_limit: Cosine of the widest visible angle, shape (n,); -2 for LEDs that shine everywhere.
        R: Predicted rotation, shape (3, 3).
        t: Predicted translation, shape (3,), m.
        covariance: Of the predicted pose, left tangent (omega, v), shape (6, 6).
        turn_rad: One deviation of the turn about the beacon since, rad.
        shift_m: One deviation of the shift since, m.
        half: Half side of the local threshold's window, px.
        threshold_k: k of ``mean + k sigma``.
        threshold_floor: Least height of a blob as a fraction of the brightest in its window.
        min_area: Smallest blob, px^2.
        max_area: Largest blob, px^2.
        min_circularity: Least 4 pi area / perimeter^2.
        gain_e_per_dn: Electrons per DN.
        full_scale: Largest DN.
        centroid: Output, shape (n, 2), px, first rows.
        sigma: Output, shape (n,), px, first entries.
        seen: Output, the LED of each row, shape (n,).

    Returns:
        What came of it, and how many LEDs were found.
    """
    height, width = image.shape
    n = leds.shape[0]
    most_px = int(2.0 * max_area)
    boxes = np.empty((n, 4))
    windows = np.empty((n, 4))
    components = np.empty((8, COMPONENT_COLUMNS))
    count = 0
    for i in range(n):
        x = R[0, 0] * leds[i, 0] + R[0, 1] * leds[i, 1] + R[0, 2] * leds[i, 2] + t[0]
        y = R[1, 0] * leds[i, 0] + R[1, 1] * leds[i, 1] + R[1, 2] * leds[i, 2] + t[1]
        z = R[2, 0] * leds[i, 0] + R[2, 1] * leds[i, 1] + R[2, 2] * leds[i, 2] + t[2]
        if cos_limit[i] > -1.0:
            dot = 0.0
            for k in range(3):
                d = R[k, 0] * axes[i, 0] + R[k, 1] * axes[i, 1] + R[k, 2] * axes[i, 2]
                dot -= d * (x if k == 0 else y if k == 1 else z)
            cosine = dot / sqrt(x * x + y * y + z * z)
            if cosine < cos_limit[i] - _CONE_SLACK - turn_rad:
                continue
            if cosine < cos_limit[i] + _CONE_SLACK + turn_rad:
                return OUT_OF_VIEW, count
        u, v, ok, ux, uy, uz, vx, vy, vz = project_point_with_jacobian(model_id, lens, x, y, z)
        if not ok:
            return OUT_OF_VIEW, count
        variance = max(
            _variance(ux, uy, uz, x, y, z, t, covariance, turn_rad, shift_m),
            _variance(vx, vy, vz, x, y, z, t, covariance, turn_rad, shift_m),
        )
        radius_px = radii[i] * sqrt(max(ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz))
        moved = _DEVIATIONS * sqrt(variance)
        reach = moved + 10.0 + 5.0 * radius_px
        if not reach <= _MAX_HALF_PX:
            return TOO_UNCERTAIN, count
        # With room enough for the centroid from the start the surroundings need not be searched again.
        width_px = WINDOW_RATIO * sqrt(_WIDEST_PSF_PX**2 + (_WIDTH_OF_DISC * radius_px) ** 2)
        side = ceil(min(max(reach, moved + _ROOM * width_px + 1.0), _MAX_HALF_PX))
        x0 = round(u) - side
        y0 = round(v) - side
        x1 = round(u) + side + 1
        y1 = round(v) + side + 1
        if x0 < 1 or y0 < 1 or x1 > width - 1 or y1 > height - 1:
            return OUT_OF_VIEW, count
        found = find_components_in(image, x0, y0, x1, y1, half, threshold_k, threshold_floor, most_px, components)
        if found < 0:
            return NOT_ALONE, count
        chosen = -1
        for c in range(found):
            if components[c, AREA] >= 0.5 * min_area:
                if chosen >= 0:
                    return NOT_ALONE, count
                chosen = c
        if chosen < 0:
            return UNFIT, count
        area = components[chosen, AREA]
        circularity = 4.0 * pi * area / max(components[chosen, PERIMETER] ** 2, 1e-9)
        if area < min_area or area > max_area or circularity < min_circularity:
            return UNFIT, count
        for k in range(4):
            boxes[count, k] = components[chosen, X0 + k]
        if components[chosen, X0] <= x0 or components[chosen, Y0] <= y0:
            return NOT_ALONE, count
        if components[chosen, X1] >= x1 - 1 or components[chosen, Y1] >= y1 - 1:
            return NOT_ALONE, count
        windows[count, 0], windows[count, 1], windows[count, 2], windows[count, 3] = x0, y0, x1, y1
        seen[count] = i
        count += 1
    if count < 4:
        return OUT_OF_VIEW, count
    table = np.empty((count, MEASURE_COLUMNS))
    measure_blobs(image, boxes[:count], np.ones(count, dtype=np.bool_), gain_e_per_dn, full_scale, table)
    for i in range(count):
        x = table[i, CX]
        y = table[i, CY]
        s = table[i, WIDTH]
        if not (table[i, SIGMA] > 0.0 and x > 0.0 and y > 0.0):
            return UNFIT, count
        for j in range(i):
            # Spots that reach into each other are taken apart in the whole picture, where all of them are known.
            if sqrt((x - table[j, CX]) ** 2 + (y - table[j, CY]) ** 2) < 4.0 * (s + table[j, WIDTH]):
                return NOT_ALONE, count
        room = _ROOM * s
        if (
            x - room < windows[i, 0]
            or y - room < windows[i, 1]
            or x + room > windows[i, 2] - 1
            or y + room > windows[i, 3] - 1
        ):
            x0 = max(0, int(x - room))
            y0 = max(0, int(y - room))
            x1 = min(width, int(x + room) + 2)
            y1 = min(height, int(y + room) + 2)
            found = find_components_in(image, x0, y0, x1, y1, half, threshold_k, threshold_floor, most_px, components)
            if found != 1:
                return NOT_ALONE, count
        centroid[i, 0] = x
        centroid[i, 1] = y
        sigma[i] = table[i, SIGMA]
    return FOUND, count


@compiled
def _variance(
    d: float,
    e: float,
    f: float,
    x: float,
    y: float,
    z: float,
    t: FloatArray,
    covariance: FloatArray,
    turn_rad: float,
    shift_m: float,
) -> float:
    """Variance of a pixel coordinate with derivative (d, e, f) by the point (x, y, z), px^2."""
    row = (f * y - e * z, d * z - f * x, e * x - d * y, d, e, f)
    total = 0.0
    for i in range(6):
        for j in range(6):
            total += row[i] * row[j] * covariance[i, j]
    qx = x - t[0]
    qy = y - t[1]
    qz = z - t[2]
    turned = (f * qy - e * qz) ** 2 + (d * qz - f * qx) ** 2 + (e * qx - d * qy) ** 2
    return float(total + turn_rad * turn_rad * turned + shift_m * shift_m * (d * d + e * e + f * f))


@compiled
def solve_tracked(
    image: ImageArray,
    model_id: int,
    lens: FloatArray,
    leds: FloatArray,
    axes: FloatArray,
    radii: FloatArray,
    cos_limit: FloatArray,
    beacon_m2: FloatArray,
    calibration: FloatArray,
    limits: FloatArray,
    R: FloatArray,
    t: FloatArray,
    covariance: FloatArray,
    turn_rad: float,
    shift_m: float,
    half: int,
    threshold_k: float,
    threshold_floor: float,
    min_area: float,
    max_area: float,
    min_circularity: float,
    gain_e_per_dn: float,
    full_scale: float,
    max_iterations: int,
    shift_doubt: float,
    led_px: FloatArray,
    led_residual: FloatArray,
    noise: FloatArray,
    by_beacon: FloatArray,
    by_calibration: FloatArray,
) -> tuple[int, int, float]:
    """From a prior to the next pose, in one call: find the LEDs, fit, judge.

    Args:
        image: As for ``find_leds``.
        model_id: Lens model number.
        lens: Lens parameters for kernels.
        leds: LED positions, shape (n, 3), m.
        axes: Emission axes, shape (n, 3).
        radii: LED radii, shape (n,), m; 0 where unknown.
        cos_limit: As for ``find_leds``.
        beacon_m2: As for ``fit_and_judge``.
        calibration: As for ``fit_and_judge``.
        limits: As for ``fit_and_judge``.
        R: Predicted rotation, then the result, shape (3, 3).
        t: Predicted translation, then the result, shape (3,), m.
        covariance: As for ``find_leds``.
        turn_rad: As for ``find_leds``.
        shift_m: As for ``find_leds``.
        half: As for ``find_leds``.
        threshold_k: As for ``find_leds``.
        threshold_floor: As for ``find_leds``.
        min_area: As for ``find_leds``.
        max_area: As for ``find_leds``.
        min_circularity: As for ``find_leds``.
        gain_e_per_dn: As for ``find_leds``.
        full_scale: As for ``find_leds``.
        max_iterations: As for ``fit_and_judge``.
        shift_doubt: As for ``fit_and_judge``.
        led_px: As for ``fit_and_judge``.
        led_residual: As for ``fit_and_judge``.
        noise: As for ``fit_and_judge``.
        by_beacon: As for ``fit_and_judge``.
        by_calibration: As for ``fit_and_judge``.

    Returns:
        What came of it (``FOUND``: a pose that is believed), how many LEDs were found, and the rms residual, px.
    """
    n = leds.shape[0]
    centroid = np.empty((n, 2))
    sigma = np.empty(n)
    seen = np.empty(n, dtype=np.int64)
    status, count = find_leds(
        image, model_id, lens, leds, axes, radii, cos_limit, R, t, covariance, turn_rad, shift_m, half, threshold_k,
        threshold_floor, min_area, max_area, min_circularity, gain_e_per_dn, full_scale, centroid, sigma, seen,
    )  # fmt: skip
    if status != FOUND:
        return status, count, 0.0
    verdict, _, _, _, rms = fit_and_judge(
        model_id, lens, leds, axes, radii, cos_limit, beacon_m2, calibration, limits, seen[:count], max_iterations,
        shift_doubt, centroid[:count], sigma[:count], R, t, led_px, led_residual, noise, by_beacon, by_calibration,
    )  # fmt: skip
    return (FOUND if verdict == BELIEVED else REFUSED), count, rms
