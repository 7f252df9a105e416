"""The pose of a board in a picture, with the doubt its corners leave.

Source: T. Collins and A. Bartoli, Infinitesimal plane-based pose estimation (2014), for the two starts of a plane;
refined by least squares on SE(3) over all corners through the lens.
"""

from __future__ import annotations

import numpy as np

from uvgs_bench.accuracy.pose_sensitivity import pose_pixel_jacobian
from uvgs_bench.camera.boards import BoardView
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.geometry.se3 import so3_exp

_FEWEST_CORNERS = 6
_ITERATIONS = 20
_SETTLED = 1e-12
# A board whose other tilt explains the corners this much worse at least, in squares, has one pose.
_CLEAR = 1.5


def solve_board(view: BoardView, lens: Lens) -> tuple[Pose, FloatArray] | None:
    """Fit the pose of a board to its corners.

    Args:
        view: The board as it was found.
        lens: The lens.

    Returns:
        camera_from_board, and the covariance of its left tangent (6, 6), rad and m, from the corners' own scatter about
        the fit; None when there are too few corners, or two tilts explain them alike.
    """
    import cv2

    if len(view.px) < _FEWEST_CORNERS:
        return None
    rays = lens.unproject(view.px)
    if not np.isfinite(rays).all():
        return None
    plane = rays[:, :2] / rays[:, 2:]
    found = cv2.solvePnPGeneric(view.board_m, plane, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE)
    fits = []
    for turn, shift in zip(found[1], found[2], strict=True):
        fit = _refined(view, lens, so3_exp(np.asarray(turn, dtype=np.float64).reshape(3)), np.asarray(shift).reshape(3))
        if fit is not None:
            fits.append(fit)
    fits.sort(key=lambda fit: fit[0])
    if not fits:
        return None
    squares, pose, information = fits[0]
    others = [fit for fit in fits[1:] if float(np.abs((fit[1].inverse() @ pose).log()).max()) > 1e-6]
    if others and others[0][0] < _CLEAR * squares:
        return None
    variance_px2 = squares / (2 * len(view.px) - 6)
    return pose, read_only(variance_px2 * np.linalg.inv(information))


def _refined(view: BoardView, lens: Lens, R: FloatArray, t_m: FloatArray) -> tuple[float, Pose, FloatArray] | None:
    """Sum of squares, pose and information of the minimum next to a start; None when the steps run away."""
    if not (np.isfinite(R).all() and np.isfinite(t_m).all() and t_m[2] > 0.0):
        return None
    pose = Pose(R, np.asarray(t_m, dtype=np.float64), "camera", "board")
    for _ in range(_ITERATIONS):
        J, px = pose_pixel_jacobian(lens, view.board_m, pose.R[None], pose.t_m[None])
        flat, rest = J[0].reshape(-1, 6), (view.px - px[0]).reshape(-1)
        if not (np.isfinite(flat).all() and np.isfinite(rest).all()):
            return None
        information = flat.T @ flat
        step = np.linalg.solve(information, flat.T @ rest)
        pose = pose.perturbed(step)
        if float(np.abs(step).max()) < _SETTLED:
            break
    px = lens.project(pose.apply(view.board_m))
    return float(((view.px - px) ** 2).sum()), pose, information
