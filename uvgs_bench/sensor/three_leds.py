"""Three LEDs and a prior: what is left when all but three LEDs of a beacon are hidden, or the others are not believed.

Three centroids leave no redundancy: each labeling fits up to four poses exactly. The prior chooses among them and is
fused as six more observations, widened by how far a beacon moves between two pictures. The covariance is that of the
fusion, so it is larger than with four LEDs and never smaller than three centroids and that prior allow.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import se3_exp, se3_log
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.correspondence import LedMatch, NoMatch, match_leds
from uvgs_bench.sensor.evidence_kernels import appearance_cost, is_lit
from uvgs_bench.sensor.labelings import PRIOR_REACH2, STEP_SHIFT, STEP_TURN_RAD, is_different, is_near
from uvgs_bench.sensor.led_table import LedTable
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.sensor.solution import Solution
from uvgs_bench.sensor.solvers.lambda_twist import solve_p3p

# More lights than this make chance triples near the prior too likely to be worth a search.
_MOST_BLOBS = 8
_FUSION_STEPS = 10
# Poses beyond the reach of a prior still count as rivals up to here.
_RIVAL_REACH2 = 40.0
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
    if prior is None or config.correspondence == "paper":
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
        The match, or ``no_labeling`` when no pose lies near the prior, or ``ambiguous`` when two do.
    """
    m, n = len(centroid_px), len(leds.positions_m)
    if m > _MOST_BLOBS:
        return NoMatch("no_labeling", f"{m} blobs are too many to name three of them by a prior")
    rays = lens.unproject(centroid_px)
    information = np.linalg.inv(step_covariance(prior))
    known = np.full((m, 2), np.nan) if looks is None else looks
    last = prior.camera_from_beacon
    predicted = lens.project(last.apply(leds.positions_m))
    Rs, ts = np.empty((4, 3, 3)), np.empty((4, 3))
    found: list[tuple[float, Pose, NDArray[np.int64]]] = []
    for blobs, names in _near_pairs(centroid_px, predicted, sigma_px, lens, last, leds):
        count = solve_p3p(np.ascontiguousarray(rays[blobs]), np.ascontiguousarray(leds.positions_m[names]), Rs, ts)
        for i in range(count):
            if not all(is_lit(Rs[i], ts[i], leds.positions_m[k], leds.axes[k], leds.cos_limit[k]) for k in names):
                continue
            pose = Pose(Rs[i], ts[i], "camera", "beacon")
            xi = _step(pose, last)
            cost = float(xi @ information @ xi)
            if cost > _RIVAL_REACH2:
                continue
            assignment = np.full(n, -1, dtype=np.int64)
            assignment[names] = blobs
            cost += appearance_cost(
                pose.R.copy(), pose.t_m.copy(), leds.positions_m, leds.axes, assignment, known, leds.look_sigma,
                leds.exponent,
            )  # fmt: skip
            found.append((cost, pose, assignment))
    found.sort(key=lambda item: item[0])
    if not found or found[0][0] > PRIOR_REACH2:
        return NoMatch("no_labeling", f"no pose from three of {m} blobs lies near the prior")
    cost, pose, assignment = found[0]
    rival = next((item for item in found[1:] if is_different(pose, item[1])), None)
    if rival is None:
        return LedMatch(assignment, pose, np.inf, None, needs_prior=True)
    margin = 1.0 + 0.5 * (rival[0] - cost)
    if margin < _STRICTER * config.min_margin:
        return NoMatch(
            "ambiguous",
            f"two poses from three LEDs lie near the prior: margin {margin:.2f}, "
            f"needs {_STRICTER * config.min_margin:.2f}",
        )
    return LedMatch(assignment, pose, margin, rival[1], needs_prior=True)


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
    information = np.asarray(np.linalg.inv(step_covariance(prior)), dtype=np.float64)
    pose = start
    for step in range(_FUSION_STEPS):
        at = Solution.at(lens, points_m, px, sigma_px, pose, step, True)
        if not np.isfinite(at.chi2):
            break
        p = pose.apply(points_m)
        _, by_point, _ = lens.project_with_jacobians(p)
        gradient = -information @ _step(pose, prior.camera_from_beacon)
        for i, (x, y, z) in enumerate(p):
            turn = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
            J = np.hstack([by_point[i] @ turn, by_point[i]])
            gradient += J.T @ at.residual_px[i] / sigma_px[i] ** 2
        total = at.information + information
        xi = np.asarray(np.linalg.solve(total, gradient), dtype=np.float64)
        if float(xi @ total @ xi) < 1e-12:
            return Solution(pose, total, at.residual_px, at.chi2, step + 1, True)
        R, t = se3_exp(xi)
        pose = Pose(R @ pose.R, R @ pose.t_m + t, "camera", "beacon")
    return Solution(pose, information, np.full_like(px, np.nan), np.inf, _FUSION_STEPS, False)
