"""Whether a beacon can be told apart from itself: flat, too symmetric, or its own mirror image; with numbers."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations
from typing import Literal

import numpy as np

from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import mm_from_m

# Two LEDs nearer than this are one light.
COINCIDENT_M = 1e-3
# Below this thickness relative to size, pose is as weak as from a flat marker seen from the front.
FLAT_RATIO = 0.1
# A relabeling that fits this well relative to size is told apart only from near: a twentieth of a beacon 150 mm across
# is 1.5 px at 3 m and a focal length of 608 px, some eight deviations of a poor centroid.
SYMMETRIC_RATIO = 0.05
# Relabelings are enumerated exactly up to this many LEDs; beyond it no regular solid is likely by accident.
_MAX_ENUMERATED = 7


@dataclass(frozen=True, slots=True)
class BeaconWarning:
    """A weakness of a beacon.

    Args:
        kind: ``coplanar``, ``symmetric`` or ``mirrored``.
        value_m: The number that shows it, m: thickness, or RMS residual of the best relabeling.
        limit_m: What it should exceed, m.
        text: One line for people.
    """

    kind: Literal["coplanar", "symmetric", "mirrored"]
    value_m: float
    limit_m: float
    text: str


def size_m(beacon: Beacon) -> float:
    """Longest distance between two LEDs, m."""
    p = beacon.positions_m
    return float(np.linalg.norm(p[:, None] - p[None], axis=2).max())


def thickness_m(beacon: Beacon) -> float:
    """Spread across the best plane: twice the RMS distance of the LEDs from it, m."""
    p = beacon.positions_m - beacon.positions_m.mean(axis=0)
    return 2.0 * float(np.linalg.svd(p, compute_uv=False)[2]) / float(np.sqrt(len(p)))


def relabeling_residual_m(beacon: Beacon, mirrored: bool) -> tuple[float, tuple[int, ...]]:
    """How well the beacon (or its mirror image) fits onto itself with other names.

    Args:
        beacon: At most seven LEDs.
        mirrored: Fit the mirror image, all labelings; otherwise the beacon itself, all labelings but the right one.

    Returns:
        RMS distance after the best rigid motion, m, and the labeling: LED i lands on LED ``labeling[i]``.
    """
    p = beacon.positions_m - beacon.positions_m.mean(axis=0)
    n = len(p)
    best, labeling = float("inf"), tuple(range(n))
    for order in permutations(range(n)):
        if not mirrored and order == tuple(range(n)):
            continue
        residual = _fit_residual(p, p[list(order)], -1.0 if mirrored else 1.0)
        if residual < best:
            best, labeling = residual, order
    return best, labeling


def _fit_residual(a: FloatArray, b: FloatArray, determinant: float) -> float:
    """RMS distance of centred a from centred b after the best rotation of that determinant (Kabsch)."""
    U, s, Vt = np.linalg.svd(a.T @ b)
    sign = determinant * np.sign(np.linalg.det(U @ Vt))
    gain = s[0] + s[1] + sign * s[2]
    square = (a**2).sum() + (b**2).sum() - 2.0 * gain
    return float(np.sqrt(max(square, 0.0) / len(a)))


def check_beacon(beacon: Beacon) -> tuple[BeaconWarning, ...]:
    """Look for weaknesses.

    Args:
        beacon: The beacon.

    Returns:
        Warnings, worst kinds first; empty when there is nothing to say.

    Raises:
        ConfigError: Two LEDs coincide, or all lie on one line: no pose can be told.
    """
    p = beacon.positions_m
    n = len(p)
    for i in range(n):
        for j in range(i + 1, n):
            distance = float(np.linalg.norm(p[i] - p[j]))
            if distance < COINCIDENT_M:
                raise ConfigError(
                    f"LEDs {beacon.leds[i].name} and {beacon.leds[j].name} are {mm_from_m(distance):.3f} mm apart, "
                    f"at least {mm_from_m(COINCIDENT_M):.0f} mm are needed",
                    key="leds",
                )
    spread = np.linalg.svd(p - p.mean(axis=0), compute_uv=False)
    if spread[1] < 0.02 * spread[0]:
        raise ConfigError("all LEDs lie on one line: no pose can be told from them", key="leds")
    size = size_m(beacon)
    out = []
    thickness = thickness_m(beacon)
    if thickness < FLAT_RATIO * size:
        limit = FLAT_RATIO * size
        out.append(BeaconWarning("coplanar", thickness, limit, (
            f"nearly flat: {mm_from_m(thickness):.2f} mm thick for {mm_from_m(size):.1f} mm across, "
            f"should exceed {mm_from_m(limit):.2f} mm")))  # fmt: skip
    if n > _MAX_ENUMERATED:
        return tuple(out)
    limit = SYMMETRIC_RATIO * size
    residual, labeling = relabeling_residual_m(beacon, mirrored=False)
    if residual < limit:
        out.append(BeaconWarning("symmetric", residual, limit, (
            f"too symmetric: with names {_named(beacon, labeling)} it fits onto itself to "
            f"{mm_from_m(residual):.2f} mm, should exceed {mm_from_m(limit):.2f} mm")))  # fmt: skip
    residual, labeling = relabeling_residual_m(beacon, mirrored=True)
    if residual < limit and thickness >= FLAT_RATIO * size:
        out.append(BeaconWarning("mirrored", residual, limit, (
            f"nearly its own mirror image: with names {_named(beacon, labeling)} it fits to "
            f"{mm_from_m(residual):.2f} mm, should exceed {mm_from_m(limit):.2f} mm")))  # fmt: skip
    return tuple(out)


def _named(beacon: Beacon, labeling: tuple[int, ...]) -> str:
    return " ".join(f"{led.name}->{beacon.leds[j].name}" for led, j in zip(beacon.leds, labeling, strict=True))
