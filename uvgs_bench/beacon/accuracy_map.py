"""What a beacon geometry can do before it is built: expected pose deviation and safety of labels by range and view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np

from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.se3 import so3_exp

# All relabelings of more LEDs than this are too many; then only swaps of two LEDs are tried.
_MAX_ENUMERATED = 5

Fit = Callable[[FloatArray, FloatArray], FloatArray]
"""Least-cost pose of LED points (n, 3), m, for centroids (N, n, 2), px: sums of squared residuals (N,), px^2."""


@dataclass(frozen=True, slots=True, eq=False)
class AccuracyMap:
    """Values over K ranges, T tilts and A azimuths; NaN where fewer than four LEDs are seen.

    Args:
        range_m: Shape (K,), m.
        tilt_rad: Angle between the beacon's facing direction and the line of sight, shape (T,), rad.
        azimuth_rad: Towards which side it is tilted, about its z axis from x to y, shape (A,), rad.
        position_sigma_m: Root sum of squares of the three deviations, shape (K, T, A), m.
        attitude_sigma_rad: The same for attitude, rad.
        margin_px: Root mean square residual per axis of the best fit with wrong labels, shape (K, T, A), px.
        separation_px: Least distance between two LEDs in the picture, shape (K, T, A), px.
        diameter_px: Largest LED diameter in the picture from the front, shape (K,), px; NaN when no LED states one.
    """

    range_m: FloatArray
    tilt_rad: FloatArray
    azimuth_rad: FloatArray
    position_sigma_m: FloatArray
    attitude_sigma_rad: FloatArray
    margin_px: FloatArray
    separation_px: FloatArray
    diameter_px: FloatArray


def accuracy_map(
    beacon: Beacon,
    lens: Lens,
    fit: Fit,
    sigma_px: float,
    range_m: FloatArray,
    tilt_rad: FloatArray,
    azimuth_rad: FloatArray,
) -> AccuracyMap:
    """Forecast a beacon in the middle of the picture.

    Args:
        beacon: The beacon; its own covariance does not count.
        lens: The lens.
        fit: The best pose for given labels, over all starts.
        sigma_px: Deviation of a centroid per axis, px.
        range_m: Ranges, shape (K,), m.
        tilt_rad: Tilts, shape (T,), rad.
        azimuth_rad: Azimuths, shape (A,), rad.

    Returns:
        The map.
    """
    shape = (len(range_m), len(tilt_rad), len(azimuth_rad))
    position, attitude, margin, separation = (np.full(shape, np.nan) for _ in range(4))
    views: dict[tuple[int, ...], list[tuple[tuple[int, ...], FloatArray]]] = {}
    centre = lens.unproject(np.array([[0.5 * lens.width_px, 0.5 * lens.height_px]]))[0]
    for at in np.ndindex(shape):
        k, i, j = at
        axis = np.array([np.cos(azimuth_rad[j]), np.sin(azimuth_rad[j]), 0.0])
        R, t = so3_exp(axis * tilt_rad[i]), centre * range_m[k]
        seen = _visible(beacon, R, t)
        if len(seen) < 4:
            continue
        p = beacon.positions_m[list(seen)] @ R.T + t
        px = lens.project(p)
        if not lens.contains(px).all():
            continue
        position[at], attitude[at] = _sigmas(lens, p, t, sigma_px)
        apart = np.linalg.norm(px[:, None] - px[None], axis=2)
        separation[at] = float(apart[np.triu_indices(len(px), 1)].min())
        views.setdefault(seen, []).append((at, px))
    for seen, group in views.items():
        orders = relabelings(len(seen))
        px = np.array([pixels[order] for _, pixels in group for order in orders])
        chi2 = fit(beacon.positions_m[list(seen)], px).reshape(len(group), len(orders))
        for (at, _), costs in zip(group, chi2, strict=True):
            margin[at] = float(np.sqrt(costs.min() / (2 * len(seen))))
    diameters = [led.diameter_m for led in beacon.leds if led.diameter_m is not None]
    largest = max(diameters) if diameters else float("nan")
    return AccuracyMap(
        range_m, tilt_rad, azimuth_rad, position, attitude, margin, separation, lens.fx_px * largest / range_m
    )


def relabelings(count: int) -> list[list[int]]:
    """Wrong orders of LEDs: all of them up to five LEDs, swaps of two beyond."""
    if count <= _MAX_ENUMERATED:
        return [list(order) for order in permutations(range(count))][1:]
    out = []
    for i, j in combinations(range(count), 2):
        order = list(range(count))
        order[i], order[j] = j, i
        out.append(order)
    return out


def _visible(beacon: Beacon, R: FloatArray, t: FloatArray) -> tuple[int, ...]:
    out = []
    for i, led in enumerate(beacon.leds):
        p = R @ led.position_m + t
        if led.axis is not None and led.half_angle_rad is not None:
            cosine = -float((R @ led.axis) @ p) / float(np.linalg.norm(p))
            if cosine < np.cos(led.half_angle_rad):
                continue
        out.append(i)
    return tuple(out)


def _sigmas(lens: Lens, p: FloatArray, t: FloatArray, sigma_px: float) -> tuple[float, float]:
    """Deviations of position (root sum of squares, m) and attitude (rad), from J^T J of the reprojection."""
    _, by_point, _ = lens.project_with_jacobians(p)
    # About the beacon's own origin: the turn moves p - t, and v is then the shift of t itself.
    J = np.concatenate([np.cross((p - t)[:, None, :], by_point), by_point], axis=2).reshape(-1, 6)
    H = J.T @ J
    scale = 1.0 / np.sqrt(np.diag(H))
    scaled = scale[:, None] * H * scale
    if np.linalg.cond(scaled) > 1e14:
        return float("inf"), float("inf")
    covariance = sigma_px**2 * (scale[:, None] * np.linalg.inv(scaled) * scale)
    variance = np.diag(covariance)
    return float(np.sqrt(variance[3:].sum())), float(np.sqrt(variance[:3].sum()))


@dataclass(frozen=True, slots=True)
class Gain:
    """What moving one LED would bring at one range.

    Args:
        led: Its name.
        direction: ``+x``, ``-x`` and so on, beacon frame.
        attitude_ratio: New over old 90th percentile of the attitude deviation.
        position_ratio: The same for position.
        margin_px: New least margin, px.
    """

    led: str
    direction: str
    attitude_ratio: float
    position_ratio: float
    margin_px: float


def gains(
    beacon: Beacon, lens: Lens, fit: Fit, sigma_px: float, around: AccuracyMap, k: int, step_m: float
) -> tuple[Gain, ...]:
    """Move each LED by a step along each axis and look again at one range, at every third tilt and second azimuth.

    Args:
        beacon: The beacon.
        lens: The lens.
        fit: As for ``accuracy_map``.
        sigma_px: Deviation of a centroid per axis, px.
        around: The map of the beacon as it is.
        k: Number of the range.
        step_m: Step, m.

    Returns:
        Every move, best attitude first.
    """
    at = around.range_m[k : k + 1]
    tilts, azimuths = around.tilt_rad[::3], around.azimuth_rad[::2]
    old_attitude = float(np.nanpercentile(around.attitude_sigma_rad[k, ::3, ::2], 90))
    old_position = float(np.nanpercentile(around.position_sigma_m[k, ::3, ::2], 90))
    out = []
    for i, led in enumerate(beacon.leds):
        for axis in range(3):
            for sign in (1.0, -1.0):
                moved = list(beacon.leds)
                moved[i] = replace(led, position_m=led.position_m + sign * step_m * np.eye(3)[axis])
                new = accuracy_map(
                    Beacon(beacon.name, tuple(moved), beacon.hue), lens, fit, sigma_px, at, tilts, azimuths,
                )  # fmt: skip
                if np.isnan(new.attitude_sigma_rad).all():
                    continue
                out.append(Gain(
                    led.name, "+-"[int(sign < 0)] + "xyz"[axis],
                    float(np.nanpercentile(new.attitude_sigma_rad, 90)) / old_attitude,
                    float(np.nanpercentile(new.position_sigma_m, 90)) / old_position,
                    float(np.nanmin(new.margin_px)),
                ))  # fmt: skip
    return tuple(sorted(out, key=lambda gain: gain.attitude_ratio))
