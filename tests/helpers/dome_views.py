"""Views of a dome of 34 LEDs that is nearly symmetric, without emission cones: LEDs hidden, other lights about."""

from __future__ import annotations

import numpy as np

from uvgs_bench.beacon import Beacon, Led
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.sessions.label_study import View

NOISE_PX = 0.3
_LEAST_COSINE = 0.3


def dome() -> Beacon:
    """Eight LEDs and their mirror images in both planes, 170 mm wide, and two on the crest.

    Half of them are 5.5 mm farther out, so that a turn by 180 degrees nearly fits.
    """
    rng = np.random.default_rng(34)
    quarter = []
    while len(quarter) < 8:
        p = rng.uniform([0.010, 0.006], [0.085, 0.052])
        if all(np.linalg.norm(p - q) > 0.013 for q in quarter):
            quarter.append(p)
    flat = np.vstack([np.array(quarter) * s for s in ([1, 1], [-1, 1], [1, -1], [-1, -1])] + [[[0, 0.02], [0, -0.015]]])
    flat[16:32, 1] += 0.0055
    height = 0.05 - 0.03 * (flat[:, 0] / 0.085) ** 2 - 0.015 * (flat[:, 1] / 0.052) ** 2
    points = np.column_stack([flat, height + rng.normal(size=34) * 0.001])
    return Beacon("dome", tuple(Led(f"l{i}", p) for i, p in enumerate(points)))


def lens() -> Lens:
    """A camera of 640 x 480 px."""
    return Lens("plumb_bob", 640, 480, np.array([700.0, 700.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0, 0.0]))


def draw_dome(beacon: Beacon, rng: np.random.Generator, hidden: float, strays: int) -> View:
    """One view: LEDs that face the camera but for a share hidden, in random order among stray lights."""
    p = beacon.positions_m
    normals = p - [0.0, 0.0, -0.04]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    while True:
        R = so3_exp(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])) @ so3_exp(np.array([0.0, np.pi, 0.0]))
        pose = Pose(
            R @ so3_exp(rng.normal(size=3) * 0.5),
            np.append(rng.uniform(-0.05, 0.05, 2), rng.uniform(0.25, 0.6)), "camera", "beacon",
        )  # fmt: skip
        q = pose.apply(p)
        facing = -((normals @ pose.R.T) * q).sum(axis=1) / np.linalg.norm(q, axis=1)
        lit = np.flatnonzero((facing > _LEAST_COSINE) & (rng.random(len(p)) > hidden))
        px = lens().project(q[lit])
        inside = lens().contains(px, 3.0)
        lit, px = lit[inside], px[inside]
        if len(lit) >= 4:
            break
    lights: FloatArray = np.vstack([
        px + rng.normal(size=px.shape) * NOISE_PX, rng.uniform([0.0, 0.0], [639.0, 479.0], (strays, 2)),
    ])  # fmt: skip
    order = rng.permutation(len(lights))
    names = np.append(lit, np.full(strays, -1))[order]
    at = np.ascontiguousarray(lights[order])
    return View(pose, at, np.full_like(at, np.nan), names)
