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
from uvgs_bench.units import rad_from_deg

# Poses with LEDs this far outside their cones are still scored, so that a true one just outside is seen as a rival.
_LOOSE_RAD = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class LedTable:
    """The beacon as the kernels want it; made once.

    Args:
        positions_m: Shape (n, 3), m.
        axes: Emission axes, shape (n, 3).
        cos_limit: Cosine of the widest visible angle, shape (n,); -2 for LEDs that shine everywhere.
        cos_loose: The same with room beyond it.
        triples: Ordered LED triples to start from, shape (k, 3).
        longest_m: Longest edge, m.
        look_sigma: Deviations of the logarithms of brightness and width between good LEDs, shape (2,).
        exponent: An LED shines as the cosine to its axis to this power.
    """

    positions_m: FloatArray
    axes: FloatArray
    cos_limit: FloatArray
    cos_loose: FloatArray
    triples: NDArray[np.int64]
    longest_m: float
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
        triples = _led_triples(positions, axes, loose, longest)
        return cls(positions, axes, limit, loose, triples, longest, looks, config.emission_exponent)


def _led_triples(positions: FloatArray, axes: FloatArray, loose: FloatArray, longest_m: float) -> NDArray[np.int64]:
    """Ordered triples worth starting from: not nearly on a line, and visible together."""
    n = len(positions)
    if n == 4:
        # All four must be seen, so the widest triangle alone meets every labeling once.
        widest = max(combinations(range(4), 3), key=lambda k: _triangle_area(positions[list(k)]))
        return np.array(list(permutations(widest)), dtype=np.int64)
    widest_rad = np.arccos(np.clip(loose, -1.0, 1.0))
    apart = np.arccos(np.clip(axes @ axes.T, -1.0, 1.0))
    has_cone = loose > -1.0
    together = ~(has_cone[:, None] & has_cone[None]) | (apart <= widest_rad[:, None] + widest_rad[None])
    out = []
    for k in combinations(range(n), 3):
        if together[np.ix_(k, k)].all() and _triangle_area(positions[list(k)]) > 0.01 * longest_m**2:
            out += list(permutations(k))
    return np.array(out, dtype=np.int64).reshape(-1, 3)


def _triangle_area(p: FloatArray) -> float:
    return 0.5 * float(np.linalg.norm(np.cross(p[1] - p[0], p[2] - p[0])))
