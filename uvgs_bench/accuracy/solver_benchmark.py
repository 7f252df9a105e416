"""Head to head of pose solvers on drawn problems: errors, failures, time, distance to the bound, wrong minima.

Definitions, printed with every table. Translation error: 100 |t - t_true| / |t_true|. Rotation error:
100 |q - q_true| / |q_true| of unit quaternions of equal sign, as the PnP literature has it (1 % is 1.15 degrees).
Failure: no pose, or more than 10 degrees off; failures are counted apart and not averaged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from uvgs_bench.accuracy.solver_problems import Problems, bounds_of
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.sensor.batch import solve_batch, solve_labelled, solve_lambda_twist
from uvgs_bench.sensor.solution import SOLVERS, solver
from uvgs_bench.sensor.solvers.svgs_numeric import refine_many_numerically
from uvgs_bench.units import deg_from_rad, rad_from_deg, us_from_s

Clock = Callable[[], float]

FAILURE_DEG = 10.0
DEFINITIONS = (
    "translation % = 100 |t - t_true| / |t_true|; rotation % = 100 |q - q_true| of sign-aligned unit quaternions "
    "(1 % = 1.15 deg)",
    f"failure: no pose, or more than {FAILURE_DEG:g} deg off; counted apart, not averaged",
    "opencv_epnp on four points is often wrong even without noise (its null space has four dimensions); opencv_sqpnp "
    "is the strong rival",
    "time: processor time of one call per pose, public door; the refining solvers start from the best P3P root",
)
# What answers the least squares question; these are refined from a P3P start.
_FROM_START = ("uvgs_dogleg", "svgs_numeric", "opencv_iterative")
_MOST_ITERATIONS = 200
# Two fits nearer than this are one minimum.
_SAME_CHI2 = 1e-6


@dataclass(frozen=True, slots=True)
class Spread:
    """Mean, standard deviation, median and 95th percentile of an error; NaN when nothing was solved."""

    mean: float
    sigma: float
    median: float
    p95: float

    @classmethod
    def of(cls, values: FloatArray) -> Spread:
        """Summarise values, shape (N,)."""
        if not len(values):
            return cls(np.nan, np.nan, np.nan, np.nan)
        median, p95 = np.percentile(values, [50.0, 95.0])
        return cls(float(values.mean()), float(values.std()), float(median), float(p95))


@dataclass(frozen=True, slots=True)
class SolverRow:
    """One line of the table.

    Args:
        solver: Name in ``SOLVERS``.
        poses: Problems given.
        failures: No pose, or more than 10 degrees off.
        translation_percent: Error without the failures, %.
        rotation_percent: The same of the attitude, %.
        rotation_deg: The same in degrees.
        time_us: Mean time of one pose, microseconds.
    """

    solver: str
    poses: int
    failures: int
    translation_percent: Spread
    rotation_percent: Spread
    rotation_deg: Spread
    time_us: float


@dataclass(frozen=True, slots=True)
class BoundStudy:
    """The uVGS-2 solver, in batch, against the Cramér-Rao bound.

    Args:
        poses: Problems given.
        position_ratio: Root of the mean of |position error|^2 over its bound, problem by problem.
        attitude_ratio: The same of the attitude.
        pose_ratio: Root of the mean of e^T B^-1 e / 6 with the whole error e and its bound B.
        standard_error: Standard deviation of ``pose_ratio`` from the number of problems.
        wrong_minima: Problems answered with a worse fit than the minimum next to the truth.
        misled: Problems where noise makes a pose more than 10 degrees off fit better than that minimum.
        unsolved: Problems without a converged answer.
    """

    poses: int
    position_ratio: float
    attitude_ratio: float
    pose_ratio: float
    standard_error: float
    wrong_minima: int
    misled: int
    unsolved: int


@dataclass(frozen=True, slots=True)
class SpeedStudy:
    """Microseconds per pose, one core.

    Args:
        batch_refine_us: Refinement from a P3P start, many poses in one call.
        batch_full_us: All P3P starts and refinement, many poses in one call.
        batch_numeric_us: The first with numeric Jacobian, many poses in one call.
        single_refine_us: One refinement through the public door.
        single_full_us: All P3P starts and refinement of one pose through the public door.
        peers_us: Bare call of each ``cv2.solvePnP`` method, without our wrapper.
    """

    batch_refine_us: float
    batch_full_us: float
    batch_numeric_us: float
    single_refine_us: float
    single_full_us: float
    peers_us: dict[str, float]

    @property
    def least_peer_ratio(self) -> float:
        """Fastest peer that fits all points over our batch refinement."""
        return min(self.peers_us[name] for name in _FITTING_PEERS) / self.batch_refine_us

    @property
    def jacobian_ratio(self) -> float:
        """Numeric over analytic Jacobian, both compiled, from the same starts to the same minimum."""
        return self.batch_numeric_us / self.batch_refine_us


_PEERS = ("AP3P", "P3P", "EPNP", "SQPNP", "ITERATIVE")
_FITTING_PEERS = ("EPNP", "SQPNP", "ITERATIVE")


def quaternions_of(R: FloatArray) -> FloatArray:
    """Unit quaternions (x, y, z, w), shape (N, 4), of rotations, shape (N, 3, 3), by the largest of four pivots."""
    trace = np.trace(R, axis1=1, axis2=2)
    K = np.empty((len(R), 4, 4))
    for i in range(3):
        for j in range(3):
            K[:, i, j] = R[:, i, j] + R[:, j, i] + (1.0 - trace if i == j else 0.0)
    K[:, 3, 3] = 1.0 + trace
    K[:, 0, 3] = K[:, 3, 0] = R[:, 2, 1] - R[:, 1, 2]
    K[:, 1, 3] = K[:, 3, 1] = R[:, 0, 2] - R[:, 2, 0]
    K[:, 2, 3] = K[:, 3, 2] = R[:, 1, 0] - R[:, 0, 1]
    pivot = np.argmax(np.einsum("nii->ni", K), axis=1)
    q = K[np.arange(len(R)), pivot]
    result: FloatArray = q / np.linalg.norm(q, axis=1, keepdims=True)
    return result


def rotation_vectors_of(R: FloatArray) -> FloatArray:
    """Rotation vectors, shape (N, 3), rad, angle in [0, pi], of rotations, shape (N, 3, 3)."""
    q = quaternions_of(R)
    q *= np.where(q[:, 3:] < 0.0, -1.0, 1.0)
    sine = np.linalg.norm(q[:, :3], axis=1)
    scale = np.where(sine > 1e-12, 2.0 * np.arctan2(sine, q[:, 3]) / np.maximum(sine, 1e-300), 2.0)
    result: FloatArray = q[:, :3] * scale[:, None]
    return result


def score(name: str, problems: Problems, R: FloatArray, t_m: FloatArray, time_us: float) -> SolverRow:
    """Judge answers against the truth.

    Args:
        name: Solver.
        problems: The problems.
        R: Answers, rotations, shape (N, 3, 3); NaN where there is none.
        t_m: Answers, translations, shape (N, 3), m; NaN where there is none.
        time_us: Mean time of one pose, microseconds.

    Returns:
        The row.
    """
    solved = np.isfinite(R).all(axis=(1, 2)) & np.isfinite(t_m).all(axis=1)
    R_true, t_true = problems.R_cb[solved], problems.t_cb_m[solved]
    translation = 100.0 * np.linalg.norm(t_m[solved] - t_true, axis=1) / np.linalg.norm(t_true, axis=1)
    q, q_true = quaternions_of(R[solved]), quaternions_of(R_true)
    gap = np.minimum(np.linalg.norm(q - q_true, axis=1), np.linalg.norm(q + q_true, axis=1))
    # |q - q_true| = 2 sin(angle / 4)
    angle_deg = deg_from_rad(4.0 * np.arcsin(np.minimum(0.5 * gap, 1.0)))
    good = angle_deg <= FAILURE_DEG
    return SolverRow(
        name,
        len(problems),
        len(problems) - int(good.sum()),
        Spread.of(translation[good]),
        Spread.of(100.0 * gap[good]),
        Spread.of(angle_deg[good]),
        time_us,
    )


def run_solver(name: str, problems: Problems, clock: Clock) -> SolverRow:
    """Give every problem to one solver, one call each, and judge the answers.

    Args:
        name: Key of ``SOLVERS``.
        problems: The problems.
        clock: Seconds of a monotonic clock.

    Returns:
        The row.

    Raises:
        ConfigError: No such solver.
    """
    solve = solver(name)
    lens, points, sigma = problems.protocol.lens, problems.protocol.points_m.copy(), problems.sigma_px
    anywhere = Pose(np.eye(3), np.array([0.0, 0.0, 1.0]), "camera", "beacon")
    needs_start = name in _FROM_START

    def answer(px: FloatArray) -> Pose | None:
        if name == "uvgs_lm":
            found = solve_labelled(lens, points, px, sigma)
            return None if found is None else found.camera_from_beacon
        start = anywhere
        if needs_start:
            first = solve_lambda_twist(lens, points, px, sigma, anywhere, 0)
            if not first.converged:
                return None
            start = first.camera_from_beacon
        solution = solve(lens, points, px, sigma, start, _MOST_ITERATIONS)
        # A refinement that ran out of steps still has its best pose; only closed forms can be without one.
        has_answer = solution.converged or (needs_start and np.isfinite(solution.chi2))
        return solution.camera_from_beacon if has_answer else None

    R, t = np.full((len(problems), 3, 3), np.nan), np.full((len(problems), 3), np.nan)
    answer(problems.px[0])
    start_s = clock()
    for i, px in enumerate(problems.px):
        pose = answer(px)
        if pose is not None:
            R[i], t[i] = pose.R, pose.t_m
    spent_s = clock() - start_s
    return score(name, problems, R, t, us_from_s(spent_s) / len(problems))


def compare_solvers(
    problems: Problems,
    clock: Clock,
    names: Sequence[str] = tuple(SOLVERS),
    report: Callable[[str], None] | None = None,
) -> tuple[SolverRow, ...]:
    """The whole table on the same problems.

    Args:
        problems: The problems.
        clock: Seconds of a monotonic clock.
        names: Keys of ``SOLVERS``.
        report: Called with each solver's name before it runs.

    Returns:
        One row a solver, in the given order.

    Raises:
        ConfigError: No such solver.
    """
    rows = []
    for name in names:
        if report is not None:
            report(name)
        rows.append(run_solver(name, problems, clock))
    return tuple(rows)


def study_bound(problems: Problems) -> BoundStudy:
    """Solve all problems in one batch and compare with the bound and with the minimum next to the truth.

    Args:
        problems: The problems.

    Returns:
        The study.
    """
    protocol, sigma = problems.protocol, problems.sigma_px
    found = solve_batch(protocol.lens, protocol.points_m, problems.px, sigma)
    near = solve_batch(protocol.lens, protocol.points_m, problems.px, sigma, (problems.R_cb, problems.t_cb_m))
    solved = found.converged & np.isfinite(found.chi2)
    room = _SAME_CHI2 * (1.0 + near.chi2)
    turn = rotation_vectors_of(found.R_cb[solved] @ problems.R_cb[solved].transpose(0, 2, 1))
    shift = found.t_cb_m[solved] - problems.t_cb_m[solved]
    is_off = np.zeros(len(problems), dtype=np.bool_)
    is_off[solved] = np.linalg.norm(turn, axis=1) > rad_from_deg(FAILURE_DEG)
    B = bounds_of(problems)[solved]
    e = np.concatenate([turn, shift], axis=1)
    whitened = np.einsum("ni,ni->n", e, np.linalg.solve(B, e[:, :, None])[:, :, 0]) / 6.0
    attitude = (turn**2).sum(axis=1) / np.trace(B[:, :3, :3], axis1=1, axis2=2)
    position = (shift**2).sum(axis=1) / np.trace(B[:, 3:, 3:], axis1=1, axis2=2)
    pose_ratio = float(np.sqrt(whitened.mean()))
    return BoundStudy(
        len(problems),
        float(np.sqrt(position.mean())),
        float(np.sqrt(attitude.mean())),
        pose_ratio,
        float(whitened.std() / np.sqrt(max(len(whitened), 1)) / (2.0 * pose_ratio)),
        int((solved & (found.chi2 > near.chi2 + room)).sum()),
        int((is_off & (found.chi2 < near.chi2 - room)).sum()),
        int((~solved).sum()),
    )


def study_speed(problems: Problems, clock: Clock) -> SpeedStudy:
    """Time the doors of the uVGS-2 solver and the bare calls of its peers, on the same problems.

    Args:
        problems: The problems; of a plumb_bob lens, which OpenCV takes as it is.
        clock: Seconds of a monotonic clock.

    Returns:
        Microseconds per pose; batches are the best of three passes.
    """
    import cv2

    protocol, sigma = problems.protocol, problems.sigma_px
    lens, points = protocol.lens, protocol.points_m.copy()
    anywhere = Pose(np.eye(3), np.array([0.0, 0.0, 1.0]), "camera", "beacon")
    firsts = [solve_lambda_twist(lens, points, px, sigma, anywhere, 0) for px in problems.px]
    keep = [i for i, first in enumerate(firsts) if first.converged]
    starts = [firsts[i].camera_from_beacon for i in keep]
    observed = np.ascontiguousarray(problems.px[keep])
    count = len(keep)

    def best_of(action: Callable[[], object]) -> float:
        action()
        times = []
        for _ in range(3):
            begin_s = clock()
            action()
            times.append(clock() - begin_s)
        return us_from_s(min(times)) / count

    R0, t0 = np.array([start.R for start in starts]), np.array([start.t_m for start in starts])
    analytic = solver("uvgs_lm")
    K, distortion = lens.camera_matrix().copy(), lens.coefficients.copy()
    guesses = [(cv2.Rodrigues(start.R)[0], start.t_m.reshape(3, 1).copy()) for start in starts]
    peers = {}
    for name in _PEERS:
        flag, uses_start = getattr(cv2, f"SOLVEPNP_{name}"), name == "ITERATIVE"

        def call(flag: int = flag, uses_start: bool = uses_start) -> None:
            for px, (rvec, tvec) in zip(observed, guesses, strict=True):
                cv2.solvePnP(points[:4], px[:4], K, distortion, rvec.copy(), tvec.copy(), uses_start, flag)

        peers[name] = best_of(call)

    def numeric() -> None:
        refine_many_numerically(
            lens.model_id, lens.kernel_parameters, points, observed, sigma, R0.copy(), t0.copy(), _MOST_ITERATIONS
        )

    pairs = list(zip(observed, starts, strict=True))
    return SpeedStudy(
        best_of(lambda: solve_batch(lens, points, observed, sigma, (R0, t0))),
        best_of(lambda: solve_batch(lens, points, observed, sigma)),
        best_of(numeric),
        best_of(lambda: [analytic(lens, points, px, sigma, start, _MOST_ITERATIONS) for px, start in pairs]),
        best_of(lambda: [solve_labelled(lens, points, px, sigma) for px in observed]),
        peers,
    )
