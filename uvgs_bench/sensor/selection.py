"""Stage 3: which blobs can be LEDs of this beacon: area, circularity, colour, distance to each other."""

from __future__ import annotations

from dataclasses import dataclass
from math import log, pi, sqrt

import numpy as np

from uvgs_bench.beacon import Beacon
from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor.blobs import Blobs, NoBlobs
from uvgs_bench.sensor.config import UvgsConfig

Mask = np.ndarray[tuple[int], np.dtype[np.bool_]]
HUES_DEG: dict[str, tuple[float, float]] = {"red": (330.0, 30.0), "green": (80.0, 160.0), "blue": (200.0, 270.0)}
_WHITE_SATURATION = 0.35
NEEDED = 4
# An LED may be this many times brighter than what fills the camera's range.
_OVEREXPOSED = 100.0
_LEAST_FLOOR = 0.01


@dataclass(frozen=True, slots=True)
class DistanceBounds:
    """What two blobs of one beacon may be apart.

    Args:
        low_px: Least distance, px.
        high_px: Greatest distance, px.
    """

    low_px: float
    high_px: float


def distance_bounds(positions_m: FloatArray, focal_px: float, config: UvgsConfig) -> DistanceBounds:
    """Bounds from the beacon's longest edge at the nearest range.

    Args:
        positions_m: LED positions, shape (n, 3), m.
        focal_px: Focal length, px.
        config: Ranges and least separation.

    Returns:
        The bounds. The lower one is the resolving power, because any two LEDs can line up with the camera.
    """
    longest = float(np.linalg.norm(positions_m[:, None] - positions_m[None], axis=2).max())
    return DistanceBounds(config.min_separation_px, focal_px * longest / config.min_range_m)


def largest_area_px2(beacon: Beacon, focal_px: float, range_m: float, config: UvgsConfig) -> float:
    """The largest blob an LED of a beacon can make from a range on, even far out of focus and far overexposed.

    Its disc, seen face on at that range, grown on all sides by as far as its light stands above the threshold.

    Args:
        beacon: The beacon; where an LED's diameter is not known, the configured limit stands.
        focal_px: Focal length, px.
        range_m: Nearest range, m.
        config: Threshold, widest blur, and the limit that is never exceeded.

    Returns:
        Area, px^2.
    """
    diameters = [led.diameter_m for led in beacon.leds]
    if config.detection == "paper" or None in diameters:
        return config.max_area_px2
    widest_m = max(d for d in diameters if d is not None)
    reach_px = config.widest_blur_px * sqrt(2.0 * log(_OVEREXPOSED / max(config.threshold_floor, _LEAST_FLOOR)))
    return min(config.max_area_px2, 0.25 * pi * (focal_px * widest_m / range_m + 2.0 * reach_px) ** 2)


def gates(blobs: Blobs, beacon: Beacon, focal_px: float, config: UvgsConfig) -> dict[str, Mask]:
    """What each blob must pass by itself, in the order of asking.

    Args:
        blobs: All blobs.
        beacon: Its hue and the size of its LEDs.
        focal_px: Focal length, px.
        config: Limits.

    Returns:
        By name of the gate, which blobs pass it, shape (n,).
    """
    largest = largest_area_px2(beacon, focal_px, config.min_range_m, config)
    return {
        "area": (blobs.area_px2 >= config.min_area_px2) & (blobs.area_px2 <= largest),
        "shape": blobs.circularity >= config.min_circularity,
        "hue": _hue_gate(blobs, beacon, config),
        "picture border": ~blobs.on_edge,
    }


def select_blobs(
    blobs: Blobs, beacon: Beacon, focal_px: float, config: UvgsConfig, needed: int = NEEDED
) -> Blobs | NoBlobs:
    """Keep what can be an LED.

    Args:
        blobs: All blobs.
        beacon: Its hue and dimensions.
        focal_px: Focal length, px.
        config: Gates.
        needed: Fewest blobs worth going on with: 4, or 3 when there is a prior.

    Returns:
        The candidates, brightest first, or why there are too few or too many.

    Source: section 2.2 of the uVGS-2 paper.
    """
    keep = np.ones(len(blobs), dtype=bool)
    dropped = []
    for name, gate in gates(blobs, beacon, focal_px, config).items():
        lost = int((keep & ~gate).sum())
        if lost:
            dropped.append(f"{lost} by {name}")
        keep &= gate
    bounds = distance_bounds(beacon.positions_m, focal_px, config)
    kept = blobs.take(np.flatnonzero(keep))
    kept = kept.take(np.argsort(-kept.peak_dn * kept.area_px2, kind="stable"))
    if len(kept) < needed:
        return _too_few(kept, blobs, dropped, needed)
    near = _distance_gate(kept.centroid_px, bounds, needed)
    if not near.all():
        dropped.append(f"{int((~near).sum())} by distance")
        kept = kept.take(np.flatnonzero(near))
    if len(kept) < needed:
        return _too_few(kept, blobs, dropped, needed)
    if len(kept) > config.max_blobs:
        return NoBlobs("selection", "too_many_blobs", f"{len(kept)} candidates, at most {config.max_blobs}")
    return kept


def _too_few(kept: Blobs, blobs: Blobs, dropped: list[str], needed: int) -> NoBlobs:
    why = f" (dropped {', '.join(dropped)})" if dropped else ""
    return NoBlobs("selection", "too_few_blobs", f"{len(kept)} of {len(blobs)} blobs kept, needs {needed}{why}")


def _hue_gate(blobs: Blobs, beacon: Beacon, config: UvgsConfig) -> Mask:
    everything = np.ones(len(blobs), dtype=bool)
    if np.isnan(blobs.saturation).all():
        return everything
    wanted = config.hue_deg if config.hue_deg is not None else beacon.hue
    if isinstance(wanted, str):
        if wanted == "any":
            return everything
        if wanted == "white":
            return np.nan_to_num(blobs.saturation, nan=0.0) <= _WHITE_SATURATION
        wanted = HUES_DEG[wanted]
    low, high = wanted
    hue = np.nan_to_num(blobs.hue_deg, nan=-1.0)
    inside = (hue >= low) & (hue <= high) if low <= high else (hue >= low) | ((hue <= high) & (hue >= 0.0))
    return np.asarray(inside, dtype=bool)


def _distance_gate(centroid_px: FloatArray, bounds: DistanceBounds, needed: int) -> Mask:
    """Drop a blob too near to a brighter one, and one that has too few others within reach."""
    n = len(centroid_px)
    distance = np.linalg.norm(centroid_px[:, None] - centroid_px[None], axis=2)
    keep = np.ones(n, dtype=bool)
    for i in range(1, n):
        keep[i] = not (keep[:i] & (distance[i, :i] < bounds.low_px)).any()
    reach = (distance <= bounds.high_px) & keep[None]
    return np.asarray(keep & (reach.sum(axis=1) >= needed), dtype=bool)
