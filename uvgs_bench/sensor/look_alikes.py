"""Where a beacon of many LEDs looks like itself: the motions and mirrorings that lay many of its LEDs on others.

A pose that explains a picture has rivals that explain it nearly as well: the beacon turned onto itself, and, as seen
from afar, its mirror image seen from behind. Chance knows nothing of them, so each is tried by name.
"""

from __future__ import annotations

from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray

# Two LEDs nearer than this share of the beacon's longest edge may stand for one another.
_TOLERANCE = 0.06
# A motion counts when it lays at least this share of the LEDs, and so many, on others.
_LEAST_SHARE = 0.3
_LEAST_COUNT = 4
_MOST = 32
_BASES = 24
_MOST_COMPARED = 800_000
_MOST_MOTIONS = 2000
_CHUNK = 500
# Motions nearer than this are one.
_SAME_ROTATION = 0.3
_STILL = 0.05
_SAME_SHIFT = 0.05


def find_look_alikes(positions_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Motions of a beacon, proper or mirroring, that lay many of its LEDs near others.

    Args:
        positions_m: LED positions, shape (n, 3), m, beacon frame.

    Returns:
        Orthogonal matrices, shape (k, 3, 3), with determinant 1 or -1, and shifts, shape (k, 3), m: LED p comes to
        ``S p + s``. Best first, the identity left out.
    """
    p = positions_m
    longest_m = float(np.linalg.norm(p[:, None] - p[None], axis=2).max())
    tolerance_m = _TOLERANCE * longest_m
    bases, targets = _congruent(p, tolerance_m)
    rotations, shifts = _motions(p[bases], p[targets])
    count = np.empty(len(rotations))
    merit = np.empty(len(rotations))
    square = (p**2).sum(axis=1)
    for i in range(0, len(rotations), _CHUNK):
        moved = p @ rotations[i : i + _CHUNK].transpose(0, 2, 1) + shifts[i : i + _CHUNK, None]
        distance2 = (moved**2).sum(axis=2)[:, :, None] + square - 2.0 * moved @ p.T
        nearness = np.maximum(1.0 - distance2.min(axis=2) / tolerance_m**2, 0.0)
        count[i : i + _CHUNK] = (nearness > 0.0).sum(axis=1)
        merit[i : i + _CHUNK] = nearness.sum(axis=1)
    stays = np.linalg.norm(rotations - np.eye(3), axis=(1, 2)) < _STILL
    stays &= np.linalg.norm(shifts, axis=1) < _SAME_SHIFT * longest_m
    enough = (count >= max(_LEAST_COUNT, _LEAST_SHARE * len(p))) & ~stays
    kept: list[int] = []
    for i in np.flatnonzero(enough)[np.argsort(-merit[enough], kind="stable")]:
        if all(
            np.linalg.norm(rotations[i] - rotations[j]) > _SAME_ROTATION
            or np.linalg.norm(shifts[i] - shifts[j]) > _SAME_SHIFT * longest_m
            for j in kept
        ):
            kept.append(int(i))
        if len(kept) == _MOST:
            break
    return np.ascontiguousarray(rotations[kept]), np.ascontiguousarray(shifts[kept])


def _congruent(p: FloatArray, tolerance_m: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triples spread over the beacon, and those of nearly the same edges, shapes (k, 3), the most alike first."""
    sets = np.array(list(combinations(range(len(p)), 3)), dtype=np.int64)
    a, b, c = (p[sets[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    wide = sets[area >= np.median(area)]
    every = np.ascontiguousarray(sets[area > 0.0][:, list(permutations(range(3)))].reshape(-1, 3))
    bases = max(4, min(_BASES, _MOST_COMPARED // len(every)))
    wide = wide[:: max(1, len(wide) // bases)]
    off = np.abs(_edges(p, every)[None] - _edges(p, wide)[:, None]).max(axis=2)
    base, target = np.nonzero(off < tolerance_m)
    order = np.argsort(off[base, target], kind="stable")[:_MOST_MOTIONS]
    return wide[base[order]], every[target[order]]


def _edges(p: FloatArray, triples: NDArray[np.int64]) -> FloatArray:
    return np.stack(
        [np.linalg.norm(p[triples[:, i]] - p[triples[:, j]], axis=1) for i, j in ((0, 1), (0, 2), (1, 2))], 1
    )


def _motions(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Motions that lay triangles a on triangles b, shape (k, 3, 3): all proper ones, then all mirroring ones."""
    first, second = _frames(a), _frames(b)
    mirrored = second * [1.0, 1.0, -1.0]
    rotations = np.concatenate([second, mirrored]) @ np.tile(first, (2, 1, 1)).transpose(0, 2, 1)
    middle = np.tile(a.mean(axis=1), (2, 1))
    shifts = np.tile(b.mean(axis=1), (2, 1)) - np.einsum("kij,kj->ki", rotations, middle)
    return rotations, shifts


def _frames(triangles: FloatArray) -> FloatArray:
    """Columns: along the first edge, across it in the plane, the normal."""
    x = triangles[:, 1] - triangles[:, 0]
    z = np.cross(x, triangles[:, 2] - triangles[:, 0])
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)
