"""Stage 4: which blob is which LED.

``scored`` tries every labeling: P3P on triples, the other LEDs by prediction, refinement, emission cones; it answers
the best, the best that is truly different, and how far apart they are. ``paper`` sorts by the longest edge and signs
(section 2.4); it holds only while the longest projected edge is the longest edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, permutations
from math import cos, inf

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import rotation_angle
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.correspondence_kernels import HOPELESS_COST, KEPT, search_labelings
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.units import rad_from_deg

# Two poses nearer than this are one answer: no user acts differently on them.
_SAME_TURN_RAD = 0.05
_SAME_SHIFT = 0.03
# Emission test of an unrefined P3P start: its attitude may be off by this much.
_START_SLACK_RAD = 0.35
_DEGENERATE_SINE = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class LedMatch:
    """Which blob is which LED.

    Args:
        blob_of_led: Index of the blob of each LED, -1 if unseen, shape (n,).
        start: Pose near the optimum.
        margin: Ratio of the costs of runner-up and best, each with its degrees of freedom added; inf without runner-up.
        runner_up: The best truly different pose, or None.
    """

    blob_of_led: NDArray[np.int64]
    start: Pose
    margin: float
    runner_up: Pose | None


@dataclass(frozen=True, slots=True)
class NoMatch:
    """Why no labeling is believed.

    Args:
        reason: Stable word.
        detail: One line with the numbers.
    """

    reason: str
    detail: str


@dataclass(frozen=True, slots=True, eq=False)
class LedTable:
    """The beacon as the kernels want it; made once.

    Args:
        positions_m: Shape (n, 3), m.
        axes: Emission axes, shape (n, 3).
        cos_limit: Cosine of the widest visible angle, shape (n,); -2 for LEDs that shine everywhere.
        cos_loose: The same with room for an unrefined start.
        triples: LED triples to start from, shape (k, 3).
        longest_m: Longest edge, m.
    """

    positions_m: FloatArray
    axes: FloatArray
    cos_limit: FloatArray
    cos_loose: FloatArray
    triples: NDArray[np.int64]
    longest_m: float

    @classmethod
    def of(cls, beacon: Beacon, config: UvgsConfig) -> LedTable:
        """Tabulate a beacon."""
        n = len(beacon.leds)
        positions = beacon.positions_m.copy()
        axes = np.zeros((n, 3))
        limit = np.full(n, -2.0)
        loose = np.full(n, -2.0)
        for i, led in enumerate(beacon.leds):
            if led.axis is not None and led.half_angle_rad is not None:
                axes[i] = led.axis
                widest = led.half_angle_rad + rad_from_deg(config.emission_slack_deg)
                limit[i] = cos(min(widest, np.pi))
                loose[i] = cos(min(widest + _START_SLACK_RAD, np.pi))
        triples = sorted(combinations(range(n), 3), key=lambda k: -_triangle_area(positions[list(k)]))
        # With four LEDs all must be seen, so the widest triangle alone meets every labeling once.
        if n == 4:
            triples = triples[:1]
        longest = float(np.linalg.norm(positions[:, None] - positions[None], axis=2).max())
        return cls(positions, axes, limit, loose, np.array(triples, dtype=np.int64), longest)


def _triangle_area(p: FloatArray) -> float:
    return 0.5 * float(np.linalg.norm(np.cross(p[1] - p[0], p[2] - p[0])))


def match_leds(
    centroid_px: FloatArray,
    sigma_px: FloatArray,
    lens: Lens,
    leds: LedTable,
    config: UvgsConfig,
    prior: PoseEstimate | None = None,
) -> LedMatch | NoMatch:
    """Name the blobs.

    Args:
        centroid_px: Candidates, shape (m, 2), m >= 4, raw px.
        sigma_px: Their deviations for judging, shape (m,), px.
        lens: The lens.
        leds: The tabulated beacon.
        config: Which method, least margin, ranges.
        prior: The last pose; it may decide between two poses that fit, never against the better fit alone.

    Returns:
        The match, or why there is none: ``degenerate``, ``no_labeling``, ``chance_fit``,
        ``ambiguous``.
    """
    if config.correspondence == "paper":
        return _sort_as_paper(centroid_px, sigma_px, lens, leds, config)
    candidates, passed = _search(centroid_px, sigma_px, lens, leds, config)
    if not candidates:
        return NoMatch("no_labeling", f"no labeling of {len(centroid_px)} blobs fits the beacon")
    cost, dof = candidates[0][:2]
    chance = chance_fits(cost, dof, passed)
    if chance > config.max_chance_fits:
        return NoMatch(
            "chance_fit",
            f"cost {cost:.1f} among {passed} labelings of {len(centroid_px)} blobs: {chance:.2f} such fits are "
            f"expected by chance, at most {config.max_chance_fits:.2f}",
        )
    return _decide(candidates, config, prior)


_Candidate = tuple[float, int, Pose, NDArray[np.int64]]


def chance_fits(cost: float, dof: int, passed: int) -> float:
    """How many labelings would fit this well if all lights were strewn at random.

    Of the labelings that come within ``HOPELESS_COST`` per redundant LED, errors fill that ball evenly, so the share
    within a smaller cost is the ratio of the volumes.

    Args:
        cost: Cost of the fit.
        dof: Its degrees of freedom, two for each redundant LED.
        passed: How many labelings came within the larger cost.

    Returns:
        Their expected number.
    """
    redundant = dof / 2
    return float(passed * ((cost + 1.0) / (HOPELESS_COST * redundant)) ** redundant)


def _search(
    px: FloatArray, sigma: FloatArray, lens: Lens, leds: LedTable, config: UvgsConfig, everything: bool = False
) -> tuple[list[_Candidate], int]:
    """Refined labelings as (cost, dof, pose, assignment), best first: up to the first truly different one, or all.

    With them the number of labelings that were worth refining.
    """
    rays = lens.unproject(px)
    seen = np.flatnonzero(np.isfinite(rays[:, 0]))
    if len(seen) < 4:
        return [], 0
    costs, chi2s = np.empty(KEPT), np.empty(KEPT)
    Rs, ts = np.empty((KEPT, 3, 3)), np.empty((KEPT, 3))
    n = len(leds.positions_m)
    assignments = np.empty((KEPT, n), dtype=np.int64)
    reach = max(lens.fx_px, lens.fy_px) * leds.longest_m / config.min_range_m
    count, passed = search_labelings(
        lens.model_id, lens.kernel_parameters, rays[seen], px[seen], sigma[seen], leds.positions_m, leds.axes,
        leds.cos_limit, leds.cos_loose, leds.triples, reach, config.min_range_m, config.max_range_m,
        costs, chi2s, Rs, ts, assignments,
    )  # fmt: skip
    order = np.argsort(costs[:count], kind="stable")
    out: list[_Candidate] = []
    for i in order:
        assignment = np.where(assignments[i] >= 0, seen[assignments[i]], -1)
        dof = 2 * int((assignment >= 0).sum()) - 6
        out.append((float(costs[i]), dof, Pose(Rs[i], ts[i], "camera", "beacon"), assignment))
        if not everything and len(out) > 1 and _is_different(out[0][2], out[-1][2]):
            break
    return out, passed


def _is_different(a: Pose, b: Pose) -> bool:
    shift = float(np.linalg.norm(a.t_m - b.t_m)) / float(np.linalg.norm(a.t_m))
    return shift > _SAME_SHIFT or rotation_angle(a.R.T @ b.R) > _SAME_TURN_RAD


def _decide(candidates: list[_Candidate], config: UvgsConfig, prior: PoseEstimate | None) -> LedMatch | NoMatch:
    cost, dof, pose, assignment = candidates[0]
    rivals = [c for c in candidates[1:] if _is_different(pose, c[2])]
    if not rivals:
        return LedMatch(assignment, pose, inf, None)
    rival = rivals[0]
    margin = (rival[0] + rival[1]) / (cost + dof)
    if margin >= config.min_margin:
        return LedMatch(assignment, pose, margin, rival[2])
    if prior is not None:
        near = not _is_far(prior.camera_from_beacon, pose)
        if near and _is_far(prior.camera_from_beacon, rival[2]):
            return LedMatch(assignment, pose, margin, rival[2])
    angle = np.degrees(rotation_angle(pose.R.T @ rival[2].R))
    return NoMatch(
        "ambiguous",
        f"two poses {angle:.1f} deg apart fit almost alike: margin {margin:.2f}, needs {config.min_margin:.2f}",
    )


def _is_far(a: Pose, b: Pose) -> bool:
    """Too far apart for one step between two pictures."""
    shift = float(np.linalg.norm(a.t_m - b.t_m)) / float(np.linalg.norm(a.t_m))
    return shift > 0.15 or rotation_angle(a.R.T @ b.R) > 0.2


def _sort_as_paper(
    px: FloatArray, sigma: FloatArray, lens: Lens, leds: LedTable, config: UvgsConfig
) -> LedMatch | NoMatch:
    """Section 2.4: longest edge, distance to its middle, sign of the cross product; the beacon is sorted alike."""
    if len(leds.positions_m) != 4:
        return NoMatch("no_subset", f"the paper's sort needs a beacon of 4 LEDs, this one has {len(leds.positions_m)}")
    if len(px) != 4:
        return NoMatch("no_subset", f"the paper's sort needs exactly 4 candidates, got {len(px)}")
    blob_order = _sort_four(px)
    # The beacon as seen from the front: the view along +z of its own frame.
    led_order = _sort_four(leds.positions_m[:, :2])
    if blob_order is None or led_order is None:
        return NoMatch("degenerate", "three of the four points are nearly on a line, or two coincide")
    assignment = np.empty(4, dtype=np.int64)
    assignment[led_order] = blob_order
    candidates = [c for c in _search(px, sigma, lens, leds, config, everything=True)[0] if (c[3] == assignment).all()]
    if not candidates:
        return NoMatch("no_labeling", "the sorted labeling fits no pose in front of the camera")
    return LedMatch(assignment, candidates[0][2], inf, None)


def _sort_four(p: FloatArray) -> NDArray[np.int64] | None:
    """Order of four points in the plane: baseline start, baseline end, nearer, farther; None when degenerate."""
    distance = np.linalg.norm(p[:, None] - p[None], axis=2)
    i, j = (int(v) for v in np.unravel_index(int(distance.argmax()), distance.shape))
    longest = float(distance[i, j])
    if float(distance[np.triu_indices(4, 1)].min()) < _DEGENERATE_SINE * longest:
        return None
    for a, b, c in permutations(range(4), 3):
        u, v = p[b] - p[a], p[c] - p[a]
        if abs(float(u[0] * v[1] - u[1] * v[0])) < _DEGENERATE_SINE * float(np.linalg.norm(u) * np.linalg.norm(v)):
            return None
    middle = 0.5 * (p[i] + p[j])
    rest = sorted((k for k in range(4) if k not in (i, j)), key=lambda k: float(np.linalg.norm(p[k] - middle)))
    base, far = p[j] - p[i], p[rest[1]] - p[i]
    if base[0] * far[1] - base[1] * far[0] < 0.0:
        i, j = j, i
    return np.array([i, j, *rest], dtype=np.int64)
