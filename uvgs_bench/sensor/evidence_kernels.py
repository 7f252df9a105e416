"""Compiled evidence beyond where a light is: who can shine towards the camera, and how bright and large it looks."""

from __future__ import annotations

from math import acos, log, sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled

# An LED leaves its cone softly: each of these steps beyond the limit counts as one deviation.
_LIMIT_SIGMA_RAD = 0.05
# Appearance never costs more than this: dust or half a hidden LED must not outvote four good centroids.
MOST_APPEARANCE_COST = 16.0
LEAST_COSINE = 0.05


@compiled
def emission_cosine(R: FloatArray, t: FloatArray, led: FloatArray, axis: FloatArray) -> tuple[float, float]:
    """Cosine between an LED's axis and its direction to the camera, and its distance, m."""
    dot = 0.0
    norm = 0.0
    for i in range(3):
        p = R[i, 0] * led[0] + R[i, 1] * led[1] + R[i, 2] * led[2] + t[i]
        d = R[i, 0] * axis[0] + R[i, 1] * axis[1] + R[i, 2] * axis[2]
        dot -= p * d
        norm += p * p
    distance = sqrt(norm)
    return dot / distance, distance


@compiled
def is_lit(R: FloatArray, t: FloatArray, led: FloatArray, axis: FloatArray, cos_limit: float) -> bool:
    """Whether the camera lies within a cone about an LED's axis; a limit of -1 or less is no cone."""
    if cos_limit <= -1.0:
        return True
    cosine, _ = emission_cosine(R, t, led, axis)
    return cosine >= cos_limit


@compiled
def cone_cost(R: FloatArray, t: FloatArray, led: FloatArray, axis: FloatArray, cos_limit: float) -> float:
    """Cost of seeing an LED from outside its cone: the square of the excess angle in deviations; 0 inside."""
    if cos_limit <= -1.0:
        return 0.0
    cosine, _ = emission_cosine(R, t, led, axis)
    if cosine >= cos_limit:
        return 0.0
    return float(((acos(max(cosine, -1.0)) - acos(cos_limit)) / _LIMIT_SIGMA_RAD) ** 2)


@compiled
def appearance_cost(
    R: FloatArray,
    t: FloatArray,
    leds: FloatArray,
    axes: FloatArray,
    assignment: NDArray[np.int64],
    looks: FloatArray,
    look_sigma: FloatArray,
    exponent: float,
) -> float:
    """How badly the lights of one labeling match in brightness and size, each up to one common factor.

    Args:
        R: Rotation camera_from_beacon, shape (3, 3).
        t: Translation, shape (3,), m.
        leds: LED positions, shape (n, 3), m.
        axes: Emission axes, zero when it shines everywhere, shape (n, 3).
        assignment: Blob of each LED or -1, shape (n,).
        looks: Natural logarithms of light and of width of each blob, shape (m, 2); NaN where not known.
        look_sigma: Their deviations between good LEDs, shape (2,); 0 leaves one out.
        exponent: An LED shines as the cosine to its axis to this power.

    Returns:
        Sum of squares in deviations after the best common factor, bounded.

    Source: brightness of a Lambertian-like source, I = I0 cos^m(theta) / r^2.
    """
    total = 0.0
    for column in range(2):
        if look_sigma[column] <= 0.0:
            continue
        count = 0
        mean = 0.0
        square = 0.0
        for led in range(leds.shape[0]):
            blob = assignment[led]
            if blob < 0 or np.isnan(looks[blob, column]):
                continue
            value = looks[blob, column]
            if column == 0:
                cosine, distance = emission_cosine(R, t, leds[led], axes[led])
                value += 2.0 * log(distance)
                if axes[led, 0] != 0.0 or axes[led, 1] != 0.0 or axes[led, 2] != 0.0:
                    value -= exponent * log(max(cosine, LEAST_COSINE))
            count += 1
            step = value - mean
            mean += step / count
            square += step * (value - mean)
        total += square / (look_sigma[column] * look_sigma[column])
    return min(total, MOST_APPEARANCE_COST)


@compiled
def look_of_a_stray(
    R: FloatArray,
    t: FloatArray,
    leds: FloatArray,
    axes: FloatArray,
    assignment: NDArray[np.int64],
    looks: FloatArray,
    look_sigma: FloatArray,
    exponent: float,
    column: int,
) -> float:
    """How much likelier one look is when any one of the lights named is a stray than when all are LEDs.

    Args:
        R: Rotation camera_from_beacon, shape (3, 3).
        t: Translation, shape (3,), m.
        leds: LED positions, shape (n, 3), m.
        axes: Emission axes, shape (n, 3).
        assignment: Blob of each LED or -1, shape (n,).
        looks: As for ``appearance_cost``.
        look_sigma: As for ``appearance_cost``.
        exponent: As for ``appearance_cost``.
        column: Which look: 0 light, 1 width.

    Returns:
        Mean over the LEDs of the likelihood without one of them over that with all; 1 when a look is not known.
    """
    if look_sigma[column] <= 0.0:
        return 1.0
    only = np.zeros(2)
    only[column] = look_sigma[column]
    others = assignment.copy()
    whole = appearance_cost(R, t, leds, axes, assignment, looks, only, exponent)
    total = 0.0
    count = 0
    for led in range(leds.shape[0]):
        blob = assignment[led]
        if blob < 0:
            continue
        if not np.isfinite(looks[blob, column]):
            return 1.0
        others[led] = -1
        total += np.exp(0.5 * (whole - appearance_cost(R, t, leds, axes, others, looks, only, exponent)))
        others[led] = blob
        count += 1
    return float(total / count)
