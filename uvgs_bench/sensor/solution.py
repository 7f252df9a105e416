"""What every solver answers, and the table of solvers.

To add a solver: 1. write ``solve(lens, points_m, px, sigma_px, start, max_iterations) -> Solution`` in a file of its
own in ``solvers/``; 2. add one line to ``SOLVERS``; 3. the contract tests of ``tests/unit/sensor`` then run over it.

Contract: given right labels and a start in the right basin, the answer is a pose that explains the centroids, with
``converged`` False when it could not be found; nothing is raised for unlucky numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module

import numpy as np

from uvgs_bench.camera.lens import Lens
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.sensor.pose_kernels import normal_equations

SOLVERS: dict[str, str] = {
    "uvgs_lm": "uvgs_bench.sensor.solvers.uvgs_lm:solve",
    "uvgs_dogleg": "uvgs_bench.sensor.solvers.uvgs_dogleg:solve",
    "opencv_iterative": "uvgs_bench.sensor.solvers.opencv_pnp:solve_iterative",
    "opencv_sqpnp": "uvgs_bench.sensor.solvers.opencv_pnp:solve_sqpnp",
    "opencv_epnp": "uvgs_bench.sensor.solvers.opencv_pnp:solve_epnp",
    "svgs_numeric": "uvgs_bench.sensor.solvers.svgs_numeric:solve",
    "lambda_twist": "uvgs_bench.sensor.batch:solve_lambda_twist",
    "p4pf": "uvgs_bench.sensor.solvers.p4pf:solve",
    "opencv_ap3p": "uvgs_bench.sensor.solvers.opencv_p3p:solve_ap3p",
    "opencv_p3p": "uvgs_bench.sensor.solvers.opencv_p3p:solve_p3p",
}


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """A pose and how it fits.

    Args:
        camera_from_beacon: The pose.
        information: J^T W J of the left tangent (omega, v), shape (6, 6).
        residual_px: Observed minus projected, shape (n, 2), px.
        chi2: Whitened sum of squares; inf when a point cannot be projected.
        iterations: Steps taken.
        converged: Whether the solver says it arrived.
    """

    camera_from_beacon: Pose
    information: FloatArray
    residual_px: FloatArray
    chi2: float
    iterations: int
    converged: bool

    @classmethod
    def at(
        cls,
        lens: Lens,
        points_m: FloatArray,
        px: FloatArray,
        sigma_px: FloatArray,
        pose: Pose,
        iterations: int,
        converged: bool,
    ) -> Solution:
        """Residuals and information at a pose; arguments as the contract's, plus the pose and how it was reached."""
        H, g, residual = np.zeros((6, 6)), np.zeros(6), np.full((len(points_m), 2), np.nan)
        R, t = pose.R.copy(), pose.t_m.copy()
        chi2 = normal_equations(
            lens.model_id, lens.kernel_parameters, points_m, px, sigma_px, R, t, np.zeros(3), H, g, residual
        )
        return cls(pose, H, residual, chi2, iterations, converged and bool(np.isfinite(chi2)))


Solve = Callable[[Lens, FloatArray, FloatArray, FloatArray, Pose, int], Solution]


def refining(refine: Callable[..., tuple[float, int, bool]], *more: float) -> Solve:
    """Make a solver of a kernel that refines a pose in place.

    Args:
        refine: Kernel of model_id, lens, points, px, sigma, R, t, max_iterations and ``more``; answers chi-square,
            steps and whether it converged.
        more: Further arguments of the kernel.

    Returns:
        The solver.
    """

    def solve(
        lens: Lens, points_m: FloatArray, px: FloatArray, sigma_px: FloatArray, start: Pose, max_iterations: int
    ) -> Solution:
        R, t = start.R.copy(), start.t_m.copy()
        _, steps, converged = refine(
            lens.model_id, lens.kernel_parameters, points_m, px, sigma_px, R, t, max_iterations, *more
        )
        return Solution.at(lens, points_m, px, sigma_px, Pose(R, t, "camera", "beacon"), steps, converged)

    return solve


def solver(name: str) -> Solve:
    """Look up a solver.

    Args:
        name: Key of ``SOLVERS``.

    Returns:
        Its function.

    Raises:
        ConfigError: No such solver.
    """
    if name not in SOLVERS:
        raise ConfigError(f"unknown solver '{name}', expected one of: {', '.join(SOLVERS)}", key="solver")
    module, function = SOLVERS[name].split(":")
    found: Solve = getattr(import_module(module), function)
    return found
