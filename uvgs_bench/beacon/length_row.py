"""Statements about distances between LEDs: calipers, or the nominal geometry where it gives the scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LengthRow:
    """One statement about inter-LED distances, without gauge: the mean logarithm of distance over stated distance is 0.

    Args:
        first: Numbers of one LED of each pair, shape (k,).
        second: Numbers of the other, shape (k,).
        stated_m: Stated distances, shape (k,), m.
        sigma: Deviation of the mean logarithm.
    """

    first: NDArray[np.intp]
    second: NDArray[np.intp]
    stated_m: FloatArray
    sigma: float

    def residual(self, leds_m: FloatArray) -> float:
        """Stated minus found."""
        found = np.linalg.norm(leds_m[self.first] - leds_m[self.second], axis=1)
        return -float(np.mean(np.log(found / self.stated_m)))

    def gradient(self, leds_m: FloatArray) -> FloatArray:
        """Derivative of what is found by the LEDs, shape (3n,), 1/m."""
        edge = leds_m[self.first] - leds_m[self.second]
        part = edge / (edge**2).sum(axis=1)[:, None] / len(edge)
        out = np.zeros_like(leds_m)
        np.add.at(out, self.first, part)
        np.add.at(out, self.second, -part)
        result: FloatArray = out.ravel()
        return result
