"""From named centroids to poses without a start: many in one compiled call, or one through the same kernel.

The start is every P3P root of the triangle that is widest in the picture, each refined by the uVGS-2 solver; the least
cost wins. When that fit is implausible (near the danger cylinder noise removes the right root) the next triangles are
tried. So a wrong minimum needs two independent accidents.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.lens import Lens
from uvgs_bench.camera.lens_kernels import unproject_point
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.pose_kernels import normal_equations, solve_damped
from uvgs_bench.sensor.solution import Solution
from uvgs_bench.sensor.solvers.lambda_twist import solve_p3p
from uvgs_bench.sensor.solvers.uvgs_lm import refine_pose

# Where noise leaves a pose almost open, Gauss-Newton steps shrink slowly: 40 are too few once in 40000 poses.
_MAX_ITERATIONS = 200
# A fit worse than this per degree of freedom (chance 2e-6 with two) is not trusted to be the best one.
_PLAUSIBLE_CHI2_PER_DOF = 13.0
# A second start is dropped when it costs this many times a plausible fit.
_HOPELESS = 100.0
# Triangles tried at most; four LEDs have four.
_TRIANGLES = 4


@compiled
def widest_triangles(px: FloatArray, order: NDArray[np.int64]) -> int:
    """Triangles of points, the widest in the picture first.

    Args:
        px: Pixels, shape (n, 2), n >= 3.
        order: Output, indices, shape (k, 3): at most k triangles.

    Returns:
        Number of triangles written.
    """
    n = px.shape[0]
    limit = order.shape[0]
    areas = np.empty(limit)
    count = 0
    for i in range(n - 2):
        for j in range(i + 1, n - 1):
            for k in range(j + 1, n):
                area = abs(
                    (px[j, 0] - px[i, 0]) * (px[k, 1] - px[i, 1]) - (px[j, 1] - px[i, 1]) * (px[k, 0] - px[i, 0])
                )
                slot = min(count, limit)
                while slot > 0 and areas[slot - 1] < area:
                    slot -= 1
                if slot == limit:
                    continue
                for s in range(min(count, limit - 1), slot, -1):
                    areas[s] = areas[s - 1]
                    for c in range(3):
                        order[s, c] = order[s - 1, c]
                areas[slot] = area
                order[slot, 0], order[slot, 1], order[slot, 2] = i, j, k
                count = min(count + 1, limit)
    return count


@compiled
def solve_named(
    model_id: int,
    lens: FloatArray,
    points: FloatArray,
    px: FloatArray,
    sigma: FloatArray,
    max_iterations: int,
    R: FloatArray,
    t: FloatArray,
) -> tuple[float, int, bool]:
    """The least-cost pose over all P3P starts.

    Args:
        model_id: Lens model number.
        lens: Lens parameters for kernels.
        points: Beacon points, shape (n, 3), m, n >= 4.
        px: Observed centroids, shape (n, 2), raw px.
        sigma: Their deviations, shape (n,), px.
        max_iterations: Most steps from each start.
        R: Output, rotation camera_from_beacon, shape (3, 3); untouched when there is no pose.
        t: Output, translation, shape (3,), m.

    Returns:
        Chi-square (inf when no start exists), steps of the winner, whether it converged.
    """
    n = points.shape[0]
    plausible = _PLAUSIBLE_CHI2_PER_DOF * (2 * n - 6)
    order = np.empty((_TRIANGLES, 3), dtype=np.int64)
    rays = np.empty((3, 3))
    corners = np.empty((3, 3))
    Rs = np.empty((4, 3, 3))
    ts = np.empty((4, 3))
    costs = np.empty(4)
    H = np.empty((6, 6))
    g = np.empty(6)
    L = np.empty((6, 6))
    step = np.empty(6)
    residual = np.empty((n, 2))
    best = np.inf
    best_steps = 0
    has_converged = False
    for k in range(widest_triangles(px, order)):
        is_seen = True
        for c in range(3):
            i = order[k, c]
            rays[c, 0], rays[c, 1], rays[c, 2], is_valid = unproject_point(model_id, lens, px[i, 0], px[i, 1])
            for j in range(3):
                corners[c, j] = points[i, j]
            is_seen = is_seen and is_valid
        if not is_seen:
            continue
        count = solve_p3p(rays, corners, Rs, ts)
        for root in range(count):
            cost = normal_equations(model_id, lens, points, px, sigma, Rs[root], ts[root], ts[root], H, g, residual)
            # What one step promises tells the roots apart; before it, noise can make the right one look worse.
            if cost < np.inf and solve_damped(H, g, 1e-9, step, L):
                for i in range(6):
                    cost -= g[i] * step[i]
            costs[root] = cost
        for _ in range(count):
            root = 0
            for other in range(1, count):
                if costs[other] < costs[root]:
                    root = other
            # Beside a plausible fit, a start that costs far more by its promise, or after three steps, cannot win.
            give_up = _HOPELESS * plausible if best <= plausible else np.inf
            if costs[root] == np.inf or costs[root] > give_up:
                break
            costs[root] = np.inf
            chi2, steps, converged = refine_pose(
                model_id, lens, points, px, sigma, Rs[root], ts[root], max_iterations, give_up
            )
            if chi2 < best:
                best, best_steps, has_converged = chi2, steps, converged
                for i in range(3):
                    t[i] = ts[root, i]
                    for j in range(3):
                        R[i, j] = Rs[root, i, j]
        if best <= plausible and has_converged:
            break
    return best, best_steps, has_converged


@compiled
def _solve_many(
    model_id: int,
    lens: FloatArray,
    points: FloatArray,
    px: FloatArray,
    sigma: FloatArray,
    max_iterations: int,
    has_starts: bool,
    R: FloatArray,
    t: FloatArray,
    chi2: FloatArray,
    converged: NDArray[np.bool_],
) -> None:
    """Loop of ``solve_named`` (R, t output), or of the refinement alone (R, t in and out)."""
    for i in range(px.shape[0]):
        if has_starts:
            chi2[i], _, converged[i] = refine_pose(
                model_id, lens, points, px[i], sigma[i], R[i], t[i], max_iterations, np.inf
            )
        else:
            chi2[i], _, converged[i] = solve_named(model_id, lens, points, px[i], sigma[i], max_iterations, R[i], t[i])


@dataclass(frozen=True, slots=True, eq=False)
class BatchSolution:
    """Poses of a batch, one a row.

    Args:
        R_cb: Rotations camera_from_beacon, shape (N, 3, 3); NaN where no pose exists.
        t_cb_m: Translations, shape (N, 3), m; NaN where no pose exists.
        chi2: Whitened sums of squares, shape (N,); inf where no pose exists.
        converged: Whether the solver arrived, shape (N,).
    """

    R_cb: FloatArray
    t_cb_m: FloatArray
    chi2: FloatArray
    converged: NDArray[np.bool_]


def solve_batch(
    lens: Lens,
    points_m: FloatArray,
    px: FloatArray,
    sigma_px: FloatArray,
    starts: tuple[FloatArray, FloatArray] | None = None,
    max_iterations: int = _MAX_ITERATIONS,
) -> BatchSolution:
    """Solve many poses of one beacon in one compiled call, on one core.

    Args:
        lens: The lens.
        points_m: Beacon points in the order of the centroids, shape (n, 3), m, n >= 4.
        px: Observed centroids, shape (N, n, 2), raw px.
        sigma_px: Their deviations, shape (N, n) or (n,), px, positive.
        starts: R (N, 3, 3) and t (N, 3), m, to refine from; None searches all P3P starts.
        max_iterations: Most steps from each start.

    Returns:
        The poses.

    Raises:
        ValueError: Shapes that do not belong together, or a deviation that is not positive.
    """
    points = np.array(points_m, dtype=np.float64, order="C")
    observed = np.array(px, dtype=np.float64, order="C")
    n = len(points)
    if points.shape != (n, 3) or n < 4:
        raise ValueError(f"expected beacon points of shape (n, 3), n >= 4, got {points.shape}")
    if observed.ndim != 3 or observed.shape[1:] != (n, 2):
        raise ValueError(f"expected centroids of shape (N, {n}, 2), got {observed.shape}")
    count = len(observed)
    sigma = np.array(np.broadcast_to(sigma_px, (count, n)), dtype=np.float64, order="C")
    if not (sigma > 0.0).all():
        raise ValueError("centroid deviations must be positive")
    if starts is None:
        R, t = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
    else:
        R, t = (np.array(part, dtype=np.float64, order="C") for part in starts)
        if R.shape != (count, 3, 3) or t.shape != (count, 3):
            raise ValueError(f"expected starts of shapes ({count}, 3, 3) and ({count}, 3), got {R.shape} and {t.shape}")
    chi2, converged = np.full(count, np.inf), np.zeros(count, dtype=np.bool_)
    _solve_many(
        lens.model_id, lens.kernel_parameters, points, observed, sigma, max_iterations, starts is not None, R, t, chi2,
        converged,
    )  # fmt: skip
    return BatchSolution(R, t, chi2, converged)


def solve_labelled(lens: Lens, points_m: FloatArray, px: FloatArray, sigma_px: FloatArray) -> Solution | None:
    """Solve one pose from named centroids, without a start.

    Args:
        lens: The lens.
        points_m: Beacon points, shape (n, 3), m, n >= 4.
        px: Their centroids, shape (n, 2), raw px.
        sigma_px: Their deviations, shape (n,), px.

    Returns:
        The solution, or None when no P3P start exists.
    """
    R, t = np.empty((3, 3)), np.empty(3)
    chi2, steps, converged = solve_named(
        lens.model_id, lens.kernel_parameters, points_m, px, sigma_px, _MAX_ITERATIONS, R, t
    )
    if not np.isfinite(chi2):
        return None
    return Solution.at(lens, points_m, px, sigma_px, Pose(R, t, "camera", "beacon"), steps, converged)


@compiled
def pick_root(
    model_id: int, lens: FloatArray, points: FloatArray, px: FloatArray, sigma: FloatArray, R: FloatArray, t: FloatArray
) -> bool:
    """P3P on the first three points; the others only choose the root. Nothing is refined.

    Args:
        model_id: Lens model number.
        lens: Lens parameters for kernels.
        points: Beacon points, shape (n, 3), m, n >= 4.
        px: Observed centroids, shape (n, 2), raw px.
        sigma: Their deviations, shape (n,), px.
        R: Output, rotation camera_from_beacon, shape (3, 3).
        t: Output, translation, shape (3,), m.

    Returns:
        False when there is no root.
    """
    rays = np.empty((3, 3))
    for i in range(3):
        rays[i, 0], rays[i, 1], rays[i, 2], is_valid = unproject_point(model_id, lens, px[i, 0], px[i, 1])
        if not is_valid:
            return False
    Rs = np.empty((4, 3, 3))
    ts = np.empty((4, 3))
    H = np.empty((6, 6))
    g = np.empty(6)
    residual = np.empty((points.shape[0], 2))
    best = np.inf
    for root in range(solve_p3p(rays, points[:3], Rs, ts)):
        cost = normal_equations(model_id, lens, points, px, sigma, Rs[root], ts[root], ts[root], H, g, residual)
        if cost < best:
            best = cost
            for i in range(3):
                t[i] = ts[root, i]
                for j in range(3):
                    R[i, j] = Rs[root, i, j]
    return best < np.inf


def solve_lambda_twist(
    lens: Lens, points_m: FloatArray, px: FloatArray, sigma_px: FloatArray, start: Pose, max_iterations: int
) -> Solution:
    """Lambda Twist as the literature compares it: three points, root picked by the fourth, no refinement.

    Args:
        lens: The lens.
        points_m: Beacon points, shape (n, 3), m, n >= 4.
        px: Observed centroids, shape (n, 2), raw px.
        sigma_px: Their deviations, shape (n,), px.
        start: Answered, not converged, when there is no root; otherwise not used.
        max_iterations: Not used.

    Returns:
        The solution.
    """
    R, t = np.empty((3, 3)), np.empty(3)
    if not pick_root(lens.model_id, lens.kernel_parameters, points_m, px, sigma_px, R, t):
        return Solution.at(lens, points_m, px, sigma_px, start, 0, False)
    return Solution.at(lens, points_m, px, sigma_px, Pose(R, t, "camera", "beacon"), 0, True)
