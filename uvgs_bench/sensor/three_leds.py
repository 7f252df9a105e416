"""Three LEDs and a prior: what is left when all but three LEDs of a beacon are hidden, or the others are not believed.

Three centroids leave no redundancy: each labeling fits up to four poses exactly. The prior chooses among them and is
fused as six more observations, widened by how far a beacon moves between two pictures. The covariance is that of the
fusion, so it is larger than with four LEDs and never smaller than three centroids and that prior allow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import se3_exp, se3_log
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.correspondence import LedMatch, NoMatch, match_leds
from uvgs_bench.sensor.evidence_kernels import appearance_cost, is_lit
from uvgs_bench.sensor.labelings import PRIOR_REACH2, STEP_SHIFT, STEP_TURN_RAD, is_near
from uvgs_bench.sensor.led_table import LedTable
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.sensor.solution import Solution
from uvgs_bench.sensor.solvers.lambda_twist import solve_p3p

# More lights than this make chance triples near the prior too likely to be worth a search.
_MOST_BLOBS = 8
_FUSION_STEPS = 40
# Poses beyond the reach of a prior still count as rivals up to here.
_RIVAL_REACH2 = 40.0
# So many starts, the likeliest first, are followed to their minima.
_MOST_STARTS = 16
# The directions in which three LEDs know least, where two roots can run into one another.
_WEAK_DIRECTIONS = 3
# Nothing checks the choice of a root, so it needs this many times the margin four LEDs need.
_STRICTER = 2.0


def step_covariance(prior: PoseEstimate) -> FloatArray:
    """Covariance of the next pose seen from the last one, left tangent (omega, v), shape (6, 6).

    The prior's own, plus a turn about the beacon and a shift of the size expected between two pictures.
    """
    x, y, z = prior.camera_from_beacon.t_m
    A = np.eye(6)
    # A turn about the beacon leaves its place: v = shift - omega x t.
    A[3:, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    shift_m = STEP_SHIFT * float(np.linalg.norm(prior.camera_from_beacon.t_m))
    step = np.repeat([STEP_TURN_RAD**2, shift_m**2], 3)
    result: FloatArray = prior.covariance + (A * step) @ A.T
    return result


def _information(prior: PoseEstimate) -> FloatArray:
    """Inverse of ``step_covariance``."""
    return np.asarray(np.linalg.inv(step_covariance(prior)), dtype=np.float64)


def match_with_prior(
    centroid_px: FloatArray,
    sigma_px: FloatArray,
    lens: Lens,
    leds: LedTable,
    config: UvgsConfig,
    prior: PoseEstimate | None = None,
    looks: FloatArray | None = None,
) -> LedMatch | NoMatch:
    """Name the blobs, with three of them if need be and a prior is there.

    A labeling of four that chance could explain, far from the prior, is not published while three LEDs near the prior
    explain the picture too.

    Args:
        centroid_px: Candidates, shape (m, 2), m >= 3, raw px.
        sigma_px: Their deviations, shape (m,), px.
        lens: The lens.
        leds: The tabulated beacon.
        config: Parameters.
        prior: The last pose, or None.
        looks: As for ``match_leds``.

    Returns:
        As ``match_leds``, or a match that ``needs_prior``.
    """
    match: LedMatch | NoMatch = NoMatch("too_few_blobs", f"{len(centroid_px)} blobs, needs 4, or 3 and a prior")
    if len(centroid_px) >= 4:
        match = match_leds(centroid_px, sigma_px, lens, leds, config, prior, looks)
    if prior is None or config.correspondence == "paper" or "weak_evidence" in prior.flags:
        return match
    if isinstance(match, LedMatch) and (not match.is_weak or is_near(prior, match.start)):
        return match
    three = match_three(centroid_px, sigma_px, lens, leds, config, prior, looks)
    if isinstance(three, NoMatch):
        return match
    if isinstance(match, LedMatch):
        return NoMatch("ambiguous", "four LEDs far from the prior and three near it explain the picture alike")
    return three


def match_three(
    centroid_px: FloatArray,
    sigma_px: FloatArray,
    lens: Lens,
    leds: LedTable,
    config: UvgsConfig,
    prior: PoseEstimate,
    looks: FloatArray | None = None,
) -> LedMatch | NoMatch:
    """Name three blobs by a prior.

    Args:
        centroid_px: Candidates, shape (m, 2), m >= 3, raw px.
        sigma_px: Their deviations, shape (m,), px.
        lens: The lens.
        leds: The tabulated beacon.
        config: Least margin.
        prior: The last pose.
        looks: As for ``match_leds``.

    Returns:
        The match, or ``no_labeling`` when no pose lies near the prior, or ``ambiguous`` when two do
        or when two run into one another.
    """
    m, n = len(centroid_px), len(leds.positions_m)
    if m > _MOST_BLOBS:
        return NoMatch("no_labeling", f"{m} blobs are too many to name three of them by a prior")
    rays = lens.unproject(centroid_px)
    information = _information(prior)
    known = np.full((m, 2), np.nan) if looks is None else looks
    last = prior.camera_from_beacon
    predicted = lens.project(last.apply(leds.positions_m))
    Rs, ts = np.empty((4, 3, 3)), np.empty((4, 3))
    starts: list[tuple[float, Pose, NDArray[np.int64], NDArray[np.int64]]] = []
    for blobs, names in _near_pairs(centroid_px, predicted, sigma_px, lens, last, leds):
        points = np.ascontiguousarray(leds.positions_m[names])
        poses = [
            Pose(Rs[i], ts[i], "camera", "beacon")
            for i in range(solve_p3p(np.ascontiguousarray(rays[blobs]), points, Rs, ts))
        ]
        costs = [_cost(pose, last, information) for pose in poses]
        # Noise can make two roots vanish together; the pose between them is then found from the prior.
        poses.append(last)
        costs.append(_innovation(lens, points, centroid_px[blobs], sigma_px[blobs], last, information))
        starts += [(c, p, blobs, names) for c, p in zip(costs, poses, strict=True) if c <= _RIVAL_REACH2]
    starts.sort(key=lambda item: item[0])
    modes: list[_Mode] = []
    unresolved = np.inf
    for first_order, pose, blobs, names in starts[:_MOST_STARTS]:
        points = leds.positions_m[names]
        at = fuse(lens, points, centroid_px[blobs], sigma_px[blobs], pose, prior)
        end = at.camera_from_beacon
        R, t = end.R.copy(), end.t_m.copy()
        if not at.converged:
            unresolved = min(unresolved, first_order)
            continue
        if not all(is_lit(R, t, leds.positions_m[k], leds.axes[k], leds.cos_limit[k]) for k in names):
            continue
        assignment = np.full(n, -1, dtype=np.int64)
        assignment[names] = blobs
        if any(
            (mode.blob_of_led == assignment).all() and _cost(end, mode.pose, at.information) < 1.0 for mode in modes
        ):
            continue
        geometric = at.chi2 + _cost(end, last, information)
        looks_cost = appearance_cost(
            R, t, leds.positions_m, leds.axes, assignment, known, leds.look_sigma, leds.exponent
        )
        modes.append(_Mode(geometric + looks_cost, geometric, end, assignment, at.information))
    modes.sort(key=lambda mode: mode.cost)
    if not modes or modes[0].geometric > PRIOR_REACH2:
        return NoMatch("no_labeling", f"no pose from three of {m} blobs lies near the prior")
    best = modes[0]
    margin, needed = np.inf, _STRICTER * config.min_margin
    if len(modes) > 1:
        margin = 1.0 + 0.5 * (modes[1].cost - best.cost)
    # A start that finds no minimum lies between two that run into one another.
    if min(margin, 1.0 + 0.5 * (unresolved - best.geometric)) < needed:
        return NoMatch(
            "ambiguous", f"two poses from three LEDs lie near the prior: margin {margin:.2f}, needs {needed:.2f}"
        )
    named = np.flatnonzero(best.blob_of_led >= 0)
    blobs = best.blob_of_led[named]
    if not _is_well(lens, leds.positions_m[named], centroid_px[blobs], sigma_px[blobs], best, last, information):
        return NoMatch("ambiguous", "two poses from three LEDs run into one another: no covariance describes both")
    return LedMatch(best.blob_of_led, best.pose, margin, modes[1].pose if len(modes) > 1 else None, needs_prior=True)


@dataclass(frozen=True, slots=True, eq=False)
class _Mode:
    """A minimum of centroids and prior together: its cost with and without looks, and the information there."""

    cost: float
    geometric: float
    pose: Pose
    blob_of_led: NDArray[np.int64]
    information: FloatArray


def _cost(pose: Pose, last: Pose, information: FloatArray) -> float:
    xi = _step(pose, last)
    return float(xi @ information @ xi)


def _innovation(
    lens: Lens, points_m: FloatArray, px: FloatArray, sigma_px: FloatArray, last: Pose, information: FloatArray
) -> float:
    """Least cost of centroids and prior together, to first order at the prior; inf where it cannot be seen."""
    p = last.apply(points_m)
    seen, by_point, _ = lens.project_with_jacobians(p)
    residual = (px - seen).ravel()
    if not np.isfinite(residual).all():
        return float(np.inf)
    J = np.concatenate([np.cross(p[:, None, :], by_point), by_point], axis=2).reshape(-1, 6)
    spread = J @ np.linalg.solve(information, J.T) + np.diag(np.repeat(sigma_px**2, 2))
    return float(residual @ np.linalg.solve(spread, residual))


def _is_well(
    lens: Lens,
    points_m: FloatArray,
    px: FloatArray,
    sigma_px: FloatArray,
    best: _Mode,
    last: Pose,
    information: FloatArray,
) -> bool:
    """Whether the cost about a minimum rises as its information says: at two deviations by at least half of that."""
    values, vectors = np.linalg.eigh(best.information)
    for value, vector in zip(values[:_WEAK_DIRECTIONS], vectors.T[:_WEAK_DIRECTIONS], strict=True):
        for sign in (-2.0, 2.0):
            R, t = se3_exp(np.ascontiguousarray(vector) * (sign / np.sqrt(value)))
            pose = Pose(R @ best.pose.R, R @ best.pose.t_m + t, "camera", "beacon")
            residual = lens.project(pose.apply(points_m)) - px
            cost = float(((residual / sigma_px[:, None]) ** 2).sum()) + _cost(pose, last, information)
            if not cost - best.geometric > 2.0:
                return False
    return True


def _near_pairs(
    px: FloatArray, predicted: FloatArray, sigma_px: FloatArray, lens: Lens, last: Pose, leds: LedTable
) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Triples of blobs and LEDs that a step from the prior can explain, each set of three pairs once."""
    # A step shifts all LEDs alike and turns them about the beacon: three deviations of both.
    range_m = float(np.linalg.norm(last.t_m))
    reach_px = 4.0 * lens.fx_px * (STEP_SHIFT + STEP_TURN_RAD * leds.longest_m / range_m) + 4.0 * sigma_px.max()
    near = np.linalg.norm(px[None] - predicted[:, None], axis=2) <= reach_px
    pairs = [(int(led), int(blob)) for led, blob in zip(*np.nonzero(near), strict=True)]
    out = []
    for i, a in enumerate(pairs):
        for j, b in enumerate(pairs[i + 1 :], i + 1):
            if a[0] == b[0] or a[1] == b[1]:
                continue
            out += [
                (np.array([a[1], b[1], c[1]]), np.array([a[0], b[0], c[0]]))
                for c in pairs[j + 1 :]
                if c[0] not in (a[0], b[0]) and c[1] not in (a[1], b[1])
            ]
    return out


def _step(pose: Pose, last: Pose) -> FloatArray:
    R = np.ascontiguousarray(pose.R @ last.R.T)
    result: FloatArray = se3_log(R, pose.t_m - R @ last.t_m)
    return result


def fuse(
    lens: Lens, points_m: FloatArray, px: FloatArray, sigma_px: FloatArray, start: Pose, prior: PoseEstimate
) -> Solution:
    """The pose of least cost of centroids and prior together, with the information of both.

    Args:
        lens: The lens.
        points_m: Three LEDs, shape (3, 3), m.
        px: Their centroids, shape (3, 2), raw px.
        sigma_px: Their deviations, shape (3,), px.
        start: A pose near it.
        prior: The last pose.

    Returns:
        The solution; ``information`` is J^T W J plus the inverse of ``step_covariance``.
    """
    information = _information(prior)
    last = prior.camera_from_beacon
    pose, damping, cost = start, 0.0, np.inf
    best = Solution.at(lens, points_m, px, sigma_px, start, 0, True)
    xi = np.zeros(6)
    for step in range(_FUSION_STEPS):
        R, t = se3_exp(xi)
        trial = Pose(R @ pose.R, R @ pose.t_m + t, "camera", "beacon")
        at = Solution.at(lens, points_m, px, sigma_px, trial, step, True)
        trial_cost = at.chi2 + _cost(trial, last, information)
        if trial_cost <= cost + 1e-9:
            pose, cost, best = trial, trial_cost, at
            damping *= 0.1
        else:
            damping = max(10.0 * damping, 1e-3)
        if not np.isfinite(cost):
            break
        total, gradient = _normal_equations(lens, points_m, sigma_px, best, last, information)
        xi = np.asarray(np.linalg.solve(total + damping * np.diag(np.diag(total)), gradient), dtype=np.float64)
        if float(gradient @ np.linalg.solve(total, gradient)) < 1e-10:
            return Solution(pose, total, best.residual_px, best.chi2, step + 1, True)
    return Solution(pose, information, np.full_like(px, np.nan), np.inf, _FUSION_STEPS, False)


def _normal_equations(
    lens: Lens, points_m: FloatArray, sigma_px: FloatArray, at: Solution, last: Pose, information: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Information and gradient of centroids and prior together."""
    p = at.camera_from_beacon.apply(points_m)
    _, by_point, _ = lens.project_with_jacobians(p)
    gradient = -information @ _step(at.camera_from_beacon, last)
    J = np.concatenate([np.cross(p[:, None, :], by_point), by_point], axis=2)
    gradient = gradient + np.einsum("nij,ni->j", J, at.residual_px / sigma_px[:, None] ** 2)
    return at.information + information, gradient
