"""OpenCV's solvers behind the same door, for comparison. Distortion enters by exactly undistorted normalised points."""

from __future__ import annotations

import numpy as np

from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import so3_log
from uvgs_bench.sensor.solution import Solution


def solve_iterative(
    lens: Lens, points_m: FloatArray, px: FloatArray, sigma_px: FloatArray, start: Pose, max_iterations: int
) -> Solution:
    """``SOLVEPNP_ITERATIVE`` from the given start; arguments as the contract's."""
    return _solve("SOLVEPNP_ITERATIVE", True, lens, points_m, px, sigma_px, start)


def solve_sqpnp(
    lens: Lens, points_m: FloatArray, px: FloatArray, sigma_px: FloatArray, start: Pose, max_iterations: int
) -> Solution:
    """``SOLVEPNP_SQPNP``; arguments as the contract's, the start is not used."""
    return _solve("SOLVEPNP_SQPNP", False, lens, points_m, px, sigma_px, start)


def solve_epnp(
    lens: Lens, points_m: FloatArray, px: FloatArray, sigma_px: FloatArray, start: Pose, max_iterations: int
) -> Solution:
    """``SOLVEPNP_EPNP``; arguments as the contract's, the start is not used."""
    return _solve("SOLVEPNP_EPNP", False, lens, points_m, px, sigma_px, start)


def _solve(
    method: str,
    uses_start: bool,
    lens: Lens,
    points_m: FloatArray,
    px: FloatArray,
    sigma_px: FloatArray,
    start: Pose,
) -> Solution:
    import cv2

    rays = lens.unproject(px)
    normal = np.ascontiguousarray(rays[:, :2] / rays[:, 2:])
    # Column vectors: OpenCV 5 reads a 1-D array as a row.
    rvec = so3_log(start.R.copy()).reshape(3, 1).copy()
    tvec = start.t_m.reshape(3, 1).copy()
    try:
        ok, rvec, tvec = cv2.solvePnP(
            points_m, normal, np.eye(3), None, rvec, tvec, useExtrinsicGuess=uses_start, flags=getattr(cv2, method)
        )
    except cv2.error:
        ok = False
    if not ok or not (np.isfinite(rvec).all() and np.isfinite(tvec).all()):
        return Solution.at(lens, points_m, px, sigma_px, start, 0, False)
    R, _ = cv2.Rodrigues(np.asarray(rvec, dtype=np.float64).reshape(3, 1))
    pose = Pose(R, np.asarray(tvec, dtype=np.float64).reshape(3), "camera", "beacon")
    return Solution.at(lens, points_m, px, sigma_px, pose, 0, True)
