"""OpenCV's P3P solvers behind the same door: three points, root picked by the fourth, no refinement."""

from __future__ import annotations

import numpy as np

from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.sensor.solution import Solution


def solve_ap3p(
    lens: Lens, points_m: FloatArray, px: FloatArray, sigma_px: FloatArray, start: Pose, max_iterations: int
) -> Solution:
    """``SOLVEPNP_AP3P`` on the first four points; arguments as the contract's, the start is not used."""
    return _solve("SOLVEPNP_AP3P", lens, points_m, px, sigma_px, start)


def solve_p3p(
    lens: Lens, points_m: FloatArray, px: FloatArray, sigma_px: FloatArray, start: Pose, max_iterations: int
) -> Solution:
    """``SOLVEPNP_P3P`` on the first four points; arguments as the contract's, the start is not used."""
    return _solve("SOLVEPNP_P3P", lens, points_m, px, sigma_px, start)


def _solve(
    method: str, lens: Lens, points_m: FloatArray, px: FloatArray, sigma_px: FloatArray, start: Pose
) -> Solution:
    import cv2

    rays = lens.unproject(px[:4])
    normal = np.ascontiguousarray(rays[:, :2] / rays[:, 2:])
    try:
        ok, rvec, tvec = cv2.solvePnP(
            np.ascontiguousarray(points_m[:4]), normal, np.eye(3), None, flags=getattr(cv2, method)
        )
    except cv2.error:
        ok = False
    if not ok or not (np.isfinite(rvec).all() and np.isfinite(tvec).all()):
        return Solution.at(lens, points_m, px, sigma_px, start, 0, False)
    R, _ = cv2.Rodrigues(np.asarray(rvec, dtype=np.float64).reshape(3, 1))
    pose = Pose(R, np.asarray(tvec, dtype=np.float64).reshape(3), "camera", "beacon")
    return Solution.at(lens, points_m, px, sigma_px, pose, 0, True)
