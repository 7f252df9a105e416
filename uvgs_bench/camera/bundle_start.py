"""Where the bundle adjustment starts: several focal lengths, and a planar pose for every view under each.

No guess by the user is needed, wide lenses included: the pictures choose the focal length.

Source: Z. Zhang, A flexible new technique for camera calibration (2000), section 3.1, for the pose from a homography.
"""

from __future__ import annotations

import numpy as np

from uvgs_bench.camera.bundle import Bundle, Corners, adjust, refine_poses
from uvgs_bench.camera.lens import LENSES, Lens
from uvgs_bench.errors import CalibrationError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.se3 import nearest_rotation

# Focal lengths in picture widths: fisheyes of 180 degrees to telephoto.
_FOCAL_WIDTHS = (0.2, 0.28, 0.38, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 4.5)
# The best starts are adjusted fully; the lowest minimum wins.
_FULL_STARTS = 3


def start(model: str, corners: Corners, width_px: int, height_px: int) -> Bundle:
    """Adjust from several focal lengths and keep the lowest minimum.

    The polynomial lenses with more coefficients grow from ``plumb_bob``: started from nothing, their numerator and
    denominator run away together.

    Args:
        model: Key of ``LENSES``.
        corners: What was seen.
        width_px: Picture width, px.
        height_px: Picture height, px.

    Returns:
        Lens and poses at the lowest minimum found.

    Raises:
        CalibrationError: No start sees the boards.
    """
    if model in ("rational_polynomial", "thin_prism"):
        smaller = start("plumb_bob", corners, width_px, height_px)
        missing = len(LENSES[model].parameter_names) - smaller.lens.parameters.size
        grown = Lens(model, width_px, height_px, np.concatenate([smaller.lens.parameters, np.zeros(missing)]))
        return adjust(Bundle(grown, smaller.R_cb, smaller.t_cb), corners)
    ranked: list[tuple[float, int, Bundle]] = []
    for i, focal in enumerate(_FOCAL_WIDTHS):
        lens = _plain_lens(model, focal * width_px, width_px, height_px)
        try:
            bundle = refine_poses(planar_poses(lens, corners), corners, iterations=12)
        except (CalibrationError, np.linalg.LinAlgError, ValueError):
            continue
        distance = np.linalg.norm(bundle.residuals_px(corners), axis=1)
        if np.isfinite(distance).all():
            ranked.append((float(np.mean(distance)), i, bundle))
    best: Bundle | None = None
    best_cost = np.inf
    for _, _, bundle in sorted(ranked, key=lambda entry: entry[:2])[:_FULL_STARTS]:
        try:
            adjusted = adjust(bundle, corners)
        except CalibrationError:
            continue
        cost = float((adjusted.residuals_px(corners) ** 2).sum())
        if cost < 0.999999 * best_cost:
            best, best_cost = adjusted, cost
    if best is None:
        raise CalibrationError(
            f"a {model} lens does not see these boards from any start: is the board declared as it is?"
        )
    return best


def _plain_lens(model: str, focal_px: float, width_px: int, height_px: int) -> Lens:
    parameters = np.zeros(len(LENSES[model].parameter_names))
    parameters[:4] = focal_px, focal_px, 0.5 * (width_px - 1), 0.5 * (height_px - 1)
    if model == "fov":
        parameters[4] = 0.9
    return Lens(model, width_px, height_px, parameters)


def planar_poses(lens: Lens, corners: Corners) -> Bundle:
    """A pose for every view by its homography to the plane z = 1.

    Args:
        lens: The lens; its rays must point forward for at least four corners of every view.
        corners: What was seen.

    Returns:
        The lens with the poses.

    Raises:
        CalibrationError: The forward rays of a view are too few or see one line of the board.
    """
    rays = lens.unproject(corners.px)
    forward = rays[:, 2] > 0.1
    R, t = np.empty((corners.view_count, 3, 3)), np.empty((corners.view_count, 3))
    for i in range(corners.view_count):
        chosen = (corners.view == i) & forward
        if int(chosen.sum()) < 4:
            raise CalibrationError("too few corners in front of the lens")
        spread = np.linalg.svd(corners.points_m[chosen] - corners.points_m[chosen].mean(axis=0), compute_uv=False)
        if spread[1] < 0.02 * spread[0]:
            # Under a focal length far too short only one line of corners may lie ahead; that fixes no plane.
            raise CalibrationError("the corners in front of the lens lie on one line")
        R[i], t[i] = _planar_pose(corners.points_m[chosen, :2], rays[chosen, :2] / rays[chosen, 2:])
    return Bundle(lens, R, t)


def _planar_pose(board_m: FloatArray, plane: FloatArray) -> tuple[FloatArray, FloatArray]:
    A, B = _normaliser(board_m), _normaliser(plane)
    x, y, one = (np.column_stack([board_m, np.ones(len(board_m))]) @ A.T).T
    u, v, _ = (np.column_stack([plane, np.ones(len(plane))]) @ B.T).T
    zero = np.zeros_like(x)
    rows = np.concatenate(
        [
            np.column_stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u]),
            np.column_stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v]),
        ]
    )
    # The squared system loses half the digits, which a start can spare.
    H = np.linalg.inv(B) @ np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 3) @ A
    H *= np.sign(H[2, 2]) / np.sqrt(np.linalg.norm(H[:, 0]) * np.linalg.norm(H[:, 1]))
    R = nearest_rotation(np.column_stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])]))
    return R, H[:, 2]


def _normaliser(points: FloatArray) -> FloatArray:
    """Similarity that centres points and gives them unit spread, shape (3, 3)."""
    centre = points.mean(axis=0)
    scale = np.sqrt(2.0) / max(float(np.linalg.norm(points - centre, axis=1).mean()), 1e-12)
    return np.array([[scale, 0.0, -scale * centre[0]], [0.0, scale, -scale * centre[1]], [0.0, 0.0, 1.0]])
