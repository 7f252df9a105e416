"""A beacon as the search for labels wants it: plain arrays, cones with room, and the triples worth starting from."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, permutations
from math import cos

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.beacon import Beacon
from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.look_alikes import find_look_alikes
from uvgs_bench.units import rad_from_deg

# Poses with LEDs this far outside their cones are still scored, so that a true one just outside is seen as a rival.
_LOOSE_RAD = 0.2
# Neighbours of an LED that may start a search with it when trying all LEDs is too much, and those asked to confirm.
_STARTING = 7
_ASKED = 8


@dataclass(frozen=True, slots=True, eq=False)
class LedTriples:
    """LED triples to lay on three blobs.

    Args:
        leds: Ordered triples, shape (k, 3).
        edges_m2: Squared edges 01, 02, 12, shape (k, 3), m^2.
        near: The LEDs asked to confirm, nearest first, by the first LED of a triple, shape (n, q).
    """

    leds: NDArray[np.int64]
    edges_m2: FloatArray
    near: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class LedTable:
    """The beacon as the kernels want it; made once.

    Args:
        positions_m: Shape (n, 3), m.
        axes: Emission axes, shape (n, 3).
        cos_limit: Cosine of the widest visible angle, shape (n,); -2 for LEDs that shine everywhere.
        cos_loose: The same with room beyond it.
        triples: All triples worth starting from; for four LEDs the orders of the widest.
        local: Those of neighbours, for beacons of many LEDs; ``triples`` when these are few.
        longest_m: Longest edge, m.
        turns: What lays the beacon nearly on itself, shape (q, 3, 3); none for four LEDs.
        shifts_m: The same, shape (q, 3), m.
        look_sigma: Deviations of the logarithms of brightness and width between good LEDs, shape (2,).
        exponent: An LED shines as the cosine to its axis to this power.
    """

    positions_m: FloatArray
    axes: FloatArray
    cos_limit: FloatArray
    cos_loose: FloatArray
    triples: LedTriples
    local: LedTriples
    longest_m: float
    turns: FloatArray
    shifts_m: FloatArray
    look_sigma: FloatArray
    exponent: float

    @classmethod
    def of(cls, beacon: Beacon, config: UvgsConfig) -> LedTable:
        """Tabulate a beacon."""
        n = len(beacon.leds)
        positions = beacon.positions_m.copy()
        axes = np.zeros((n, 3))
        limit = np.full(n, -2.0)
        loose = np.full(n, -2.0)
        for i, led in enumerate(beacon.leds):
            if led.axis is not None:
                axes[i] = led.axis
                if led.half_angle_rad is not None:
                    widest = led.half_angle_rad + rad_from_deg(config.emission_slack_deg)
                    limit[i] = cos(min(widest, np.pi))
                    loose[i] = cos(min(widest + _LOOSE_RAD, np.pi))
        looks = np.array([config.led_brightness_sigma, config.led_width_sigma])
        longest = float(np.linalg.norm(positions[:, None] - positions[None], axis=2).max())
        triples, local = _led_triples(positions, axes, loose, longest)
        turns, shifts = (np.empty((0, 3, 3)), np.empty((0, 3))) if n == 4 else find_look_alikes(positions)
        return cls(
            positions, axes, limit, loose, triples, local, longest, turns, shifts, looks, config.emission_exponent
        )


def _led_triples(
    positions: FloatArray, axes: FloatArray, loose: FloatArray, longest_m: float
) -> tuple[LedTriples, LedTriples]:
    """Triples not nearly on a line and visible together: all of them, and those of neighbours."""
    n = len(positions)
    apart_m = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    near = np.argsort(apart_m, axis=1, kind="stable")[:, 1:]
    sets = np.array(list(combinations(range(n), 3)), dtype=np.int64)
    a, b, c = (positions[sets[:, i]] for i in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if n == 4:
        # All four must be seen, so the widest triangle alone meets every labeling once.
        widest = _in_all_orders(sets[int(area.argmax())][None], apart_m, near)
        return widest, widest
    widest_rad = np.arccos(np.clip(loose, -1.0, 1.0))
    apart_rad = np.arccos(np.clip(axes @ axes.T, -1.0, 1.0))
    has_cone = loose > -1.0
    together = ~(has_cone[:, None] & has_cone[None]) | (apart_rad <= widest_rad[:, None] + widest_rad[None])
    good = (area > 0.01 * longest_m**2) & _all_pairs(together, sets)
    every = _in_all_orders(sets[good], apart_m, near)
    if n <= _STARTING + 1:
        return every, every
    is_near = np.zeros((n, n), dtype=bool)
    np.put_along_axis(is_near, near[:, :_STARTING], True, axis=1)
    i, j, k = sets.T
    neighbours = (is_near[i, j] & is_near[i, k]) | (is_near[j, i] & is_near[j, k]) | (is_near[k, i] & is_near[k, j])
    # Their triangles are small, so they are judged by their own size.
    longest = np.max([apart_m[i, j], apart_m[i, k], apart_m[j, k]], axis=0)
    neighbours &= (area > 0.1 * longest**2) & _all_pairs(together, sets)
    return every, _in_all_orders(sets[neighbours], apart_m, near[:, :_ASKED])


def _all_pairs(
    together: np.ndarray[tuple[int, int], np.dtype[np.bool_]], sets: NDArray[np.int64]
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    i, j, k = sets.T
    return np.asarray(together[i, j] & together[i, k] & together[j, k], dtype=bool)


def _in_all_orders(sets: NDArray[np.int64], apart_m: FloatArray, near: NDArray[np.int64]) -> LedTriples:
    leds = np.ascontiguousarray(sets[:, list(permutations(range(3)))].reshape(-1, 3))
    edges = np.column_stack([apart_m[leds[:, i], leds[:, j]] ** 2 for i, j in ((0, 1), (0, 2), (1, 2))])
    return LedTriples(leds, np.ascontiguousarray(edges), np.ascontiguousarray(near))
