"""A robot's own localiser: known points on the walls of a room, seen by a camera, give its pose, until they starve.

A body near the beacon hides the points behind it, and the beacon's light washes out others and makes wrong matches
more frequent, the more the nearer it is. The localiser knows the map a little wrongly. Wrong matches are thrown out by
their residuals; with fewer points than it needs it gives nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.geometry.se3 import hat

_MAX_STEPS = 12
# Residuals beyond this many deviations are wrong matches.
_CUT_SIGMA = 4.0


@dataclass(frozen=True, slots=True)
class LandmarkTruth:
    """What is true of the map and of how its points are found.

    Args:
        count: Points on the walls.
        noise_px: Deviation of a found point per axis, px.
        map_sigma_m: Deviation of a point of the map from where it is, per axis, m; fixed for the whole mission.
        wrong_share: Share of wrong matches in undisturbed light.
        glare_m2: A point survives the beacon's light with the probability exp(-glare_m2 / range^2), m^2.
        needed: Fewest points for a pose.
        shade_radius_m: Radius of the body that carries the beacon, m.
        shade_depth_m: How far behind the beacon its centre stands, m.
    """

    count: int = 260
    noise_px: float = 0.7
    map_sigma_m: float = 0.004
    wrong_share: float = 0.02
    glare_m2: float = 0.45
    needed: int = 5
    shade_radius_m: float = 0.24
    shade_depth_m: float = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """An answer of the localiser.

    Args:
        count: How many points it found.
        world_from_camera: Its pose, or None when there were too few.
        covariance: What it believes about the left tangent (omega, v) in world axes, shape (6, 6), or None.
    """

    count: int
    world_from_camera: Pose | None = None
    covariance: FloatArray | None = None


def wall_points(count: int, rng: np.random.Generator) -> FloatArray:
    """Points on the front wall and on the walls beside it, world axes (x forward, y left, z up), shape (n, 3), m."""
    n = count // 4
    front = np.stack((rng.uniform(2.6, 2.8, count - 2 * n), rng.uniform(-2.2, 2.2, count - 2 * n)), axis=1)
    left = np.stack((rng.uniform(0.6, 2.7, n), np.full(n, 1.6)), axis=1)
    right = np.stack((rng.uniform(0.6, 2.7, n), np.full(n, -1.6)), axis=1)
    plan = np.concatenate((front, left, right))
    return read_only(np.column_stack((plan, rng.uniform(-1.1, 1.3, len(plan)))))


class MapLocaliser:
    """A localiser by known points.

    Args:
        lens: Lens of its camera.
        truth: What is true of its map.
        beacon_m: Where the beacon stands, world axes, shape (3,), m.
        away: Unit vector from the beacon into the body that carries it, world axes, shape (3,).
        seed: Seed of map and noise.
    """

    def __init__(self, lens: Lens, truth: LandmarkTruth, beacon_m: FloatArray, away: FloatArray, seed: int) -> None:
        rng = np.random.default_rng((seed, 11))
        self._lens, self._truth = lens, truth
        self._points_m = wall_points(truth.count, rng)
        self._map_m = self._points_m + truth.map_sigma_m * rng.standard_normal(self._points_m.shape)
        self._beacon_m = read_only(beacon_m)
        self._shade_m = read_only(beacon_m + truth.shade_depth_m * away)
        self._rng = rng

    def locate(self, world_from_camera: Pose) -> Fix:
        """Look from a true pose.

        Args:
            world_from_camera: Where the camera truly is.

        Returns:
            What the localiser says.
        """
        truth, rng = self._truth, self._rng
        seen, survival = self._visible(world_from_camera)
        if len(seen) < truth.needed:
            return Fix(len(seen))
        camera_from_world = world_from_camera.inverse()
        px = self._lens.project(camera_from_world.apply(self._points_m[seen]))
        px = px + truth.noise_px * rng.standard_normal(px.shape)
        wrong_share = truth.wrong_share + 0.3 * (1.0 - survival)
        wrong = rng.random(len(seen)) < wrong_share
        size = np.array([self._lens.width_px, self._lens.height_px])
        px[wrong] = rng.random((int(wrong.sum()), 2)) * size
        # It starts from where it believes to be: near the truth.
        guess = camera_from_world.perturbed(rng.standard_normal(6) * np.repeat((0.01, 0.02), 3))
        return self._solve(self._map_m[seen], px, guess)

    def _visible(self, world_from_camera: Pose) -> tuple[NDArray[np.int64], float]:
        truth, eye_m = self._truth, world_from_camera.t_m
        in_camera = world_from_camera.inverse().apply(self._points_m)
        px = self._lens.project(in_camera)
        is_seen = np.isfinite(px).all(axis=1) & self._lens.contains(np.nan_to_num(px, nan=-1.0))
        # A ray that passes the shading sphere nearer than its radius, in front of the point, is blocked.
        ray = self._points_m - eye_m
        length = np.linalg.norm(ray, axis=1)
        to_shade = self._shade_m - eye_m
        along = ray @ to_shade / length
        beside = np.sqrt(np.maximum(float(to_shade @ to_shade) - along**2, 0.0))
        is_seen &= ~((along > 0.0) & (along < length) & (beside < truth.shade_radius_m))
        range_m = float(np.linalg.norm(self._beacon_m - eye_m))
        survival = float(np.exp(-truth.glare_m2 / range_m**2))
        is_seen &= self._rng.random(len(px)) < survival
        return np.flatnonzero(is_seen), survival

    def _solve(self, map_m: FloatArray, px: FloatArray, guess: Pose) -> Fix:
        """Reweighted Gauss-Newton, the loosest cut first."""
        truth = self._truth
        pose, keep = guess, np.ones(len(px), dtype=bool)
        # The map's own doubt shows in the picture like noise.
        depth_m = float(np.median(guess.apply(map_m)[:, 2]))
        sigma_px = float(np.hypot(truth.noise_px, truth.map_sigma_m * self._lens.fx_px / max(depth_m, 0.3)))
        normal = np.eye(6)
        for step in range(_MAX_STEPS):
            points = pose.apply(map_m)
            expected, by_point, _ = self._lens.project_with_jacobians(points)
            e = px - expected
            size = np.linalg.norm(e, axis=1)
            size[~np.isfinite(size)] = np.inf
            cut_px = max(_CUT_SIGMA * sigma_px, 60.0 * 0.5**step)
            keep = size < cut_px
            if int(keep.sum()) < truth.needed:
                return Fix(int(keep.sum()))
            J = np.zeros((int(keep.sum()), 2, 6))
            for k, (p, D) in enumerate(zip(points[keep], by_point[keep], strict=True)):
                J[k, :, :3], J[k, :, 3:] = -D @ hat(p), D
            weight = np.minimum(1.0, 1.345 * sigma_px / np.maximum(size[keep], 1e-9))
            flat = J.reshape(-1, 6)
            w = np.repeat(weight, 2)
            normal = flat.T @ (w[:, None] * flat) / sigma_px**2
            if np.linalg.cond(normal) > 1e12:
                return Fix(int(keep.sum()))
            xi = np.linalg.solve(normal, flat.T @ (w * e[keep].reshape(-1))) / sigma_px**2
            pose = pose.perturbed(xi)
            if step > 6 and float(np.linalg.norm(xi)) < 1e-9:
                break
        world_from_camera = pose.inverse()
        Ad = world_from_camera.adjoint()
        return Fix(int(keep.sum()), world_from_camera, read_only(Ad @ np.linalg.inv(normal) @ Ad.T))
