"""Where the bundle adjustment starts: several focal lengths, and a planar pose for every view under each.

No guess by the user is needed, wide lenses included: the pictures choose the focal length.

Source: Z. Zhang, A flexible new technique for camera calibration (2000), section 3.1, for the pose from a homography.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from uvgs_bench.camera.bundle import Bundle, Corners, adjust, refine_poses, relative_decrement
from uvgs_bench.camera.lens import LENSES, Lens
from uvgs_bench.errors import CalibrationError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.se3 import nearest_rotation

# Focal lengths in picture widths: fisheyes of 180 degrees to telephoto.
_FOCAL_WIDTHS = (0.2, 0.28, 0.38, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 4.5)
# Lenses whose pictures need not be near those of a pinhole, on which the homographies rest.
_WIDE = ("equidistant", "fov")
# The best starts are adjusted fully until one convinces; else the lowest minimum wins.
_FULL_STARTS = 3
# Steps of the poses before focal lengths are ranked.
_RANKING_STEPS = 5
# The polynomials in tan(angle) end before 90 degrees.
_WIDEST_RAD = 1.4
# Typical residual of a start that has found the minimum.
_CONVINCING_PX = 0.5
# Share of the cost one more step may still gain at a minimum: a hundredth of a deviation for a thousand corners. Where
# drawn corners fit exactly there is nothing left to share.
_AT_REST, _EXACT_PX2 = 1e-7, 1e-16


def start(model: str, corners: Corners, width_px: int, height_px: int) -> Bundle:
    """Adjust from the focal length of the homographies or, for wide lenses and when not convincing, from several.

    Args:
        model: Key of ``LENSES``; ``rational_polynomial`` and ``thin_prism`` rather grow from ``plumb_bob``.
        corners: What was seen.
        width_px: Picture width, px.
        height_px: Picture height, px.

    Returns:
        Lens and poses at the lowest minimum found.

    Raises:
        CalibrationError: No start sees the boards.
    """
    if model in _WIDE:
        return _from_many_focals(model, corners, width_px, height_px)
    try:
        focal_px = _focal_of_homographies(corners, width_px, height_px)
        lens = _plain_lens(model, focal_px, width_px, height_px)
        bundle = adjust(refine_poses(planar_poses(lens, corners), corners, iterations=2), corners)
        if is_convincing(bundle, corners) and is_at_rest(bundle, corners):
            return bundle
    except (CalibrationError, np.linalg.LinAlgError, ValueError):
        pass
    return _from_many_focals(model, corners, width_px, height_px)


def grown(model: str, corners: Corners, width_px: int, height_px: int) -> Iterator[Bundle]:
    """Starts of a lens whose numerator and denominator, started from nothing, run away together.

    From ``fov`` with the coefficients that follow its radial map, then from ``plumb_bob`` with the new coefficients
    zero. A wide ``plumb_bob`` often ends its valid field at the outermost corners, which no step may then leave, and
    takes long to find out.

    Args:
        model: ``rational_polynomial`` or ``thin_prism``.
        corners: What was seen.
        width_px: Picture width, px.
        height_px: Picture height, px.

    Yields:
        The starts, not adjusted, at least one; each is computed when it is asked for.

    Raises:
        CalibrationError: No start sees the boards.
    """
    count, failed = 0, CalibrationError(f"a {model} lens does not see these boards from any start")
    size = len(LENSES[model].parameter_names)
    for smaller in ("fov", "plumb_bob"):
        try:
            bundle = start(smaller, corners, width_px, height_px)
            parameters = bundle.lens.parameters
            if smaller == "fov":
                points = bundle.points_in_camera(corners)
                angle = float(np.arctan2(np.linalg.norm(points[:, :2], axis=1), points[:, 2]).max())
                parameters = _ratio_like_fov(parameters, min(angle + 0.2, _WIDEST_RAD))
            lens = Lens(model, width_px, height_px, np.pad(parameters, (0, size - parameters.size)))
            larger = Bundle(lens, bundle.R_cb, bundle.t_cb)
        except CalibrationError as error:
            failed = error
            continue
        if np.isfinite(larger.residuals_px(corners)).all():
            count += 1
            yield larger
    if count == 0:
        raise failed


def is_at_rest(bundle: Bundle, corners: Corners, prior: FloatArray | None = None) -> bool:
    """Whether the adjustment ended at a minimum: one more step would gain nothing that matters."""
    residual = bundle.residuals_px(corners)
    is_exact = float((residual * residual).mean()) < _EXACT_PX2
    return is_exact or relative_decrement(bundle, corners, prior) < _AT_REST


def is_convincing(bundle: Bundle, corners: Corners) -> bool:
    """Whether the typical residual is that of a corner finder: a wrong minimum costs pixels, not tenths."""
    return float(np.median(np.linalg.norm(bundle.residuals_px(corners), axis=1))) < _CONVINCING_PX


def _ratio_like_fov(fov: FloatArray, widest_rad: float) -> FloatArray:
    """Parameters fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6 of the ratio of polynomials nearest to a ``fov`` lens."""
    r = np.tan(np.linspace(0.02, widest_rad, 60))
    stretch = 2.0 * np.tan(0.5 * fov[4])
    ratio = np.arctan(r * stretch) / (r * stretch)
    powers = np.stack([r**2, r**4, r**6], axis=1)
    rows = np.concatenate([powers, -ratio[:, None] * powers], axis=1)
    # A little ridge: numerator and denominator are never told apart by themselves.
    normal = rows.T @ rows + 1e-6 * np.eye(6)
    k1, k2, k3, k4, k5, k6 = np.linalg.solve(normal, rows.T @ (ratio - 1.0))
    focal = fov[:2] * stretch / fov[4]
    return np.array([*focal, fov[2], fov[3], k1, k2, 0.0, 0.0, k3, k4, k5, k6])


def _from_many_focals(model: str, corners: Corners, width_px: int, height_px: int) -> Bundle:
    ranked: list[tuple[float, int, Bundle]] = []
    for i, focal in enumerate(_FOCAL_WIDTHS):
        lens = _plain_lens(model, focal * width_px, width_px, height_px)
        try:
            bundle = refine_poses(planar_poses(lens, corners), corners, iterations=_RANKING_STEPS)
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
        if is_convincing(adjusted, corners) and is_at_rest(adjusted, corners):
            return adjusted
        cost = float((adjusted.residuals_px(corners) ** 2).sum())
        if cost < 0.999999 * best_cost:
            best, best_cost = adjusted, cost
    if best is None:
        raise CalibrationError(
            f"a {model} lens does not see these boards from any start: is the board declared as it is?"
        )
    return best


def _focal_of_homographies(corners: Corners, width_px: int, height_px: int) -> float:
    """Focal length of a pinhole with its principal point in the middle, px.

    Source: Z. Zhang (2000), section 3.1, with the image of the absolute conic diag(1/f^2, 1/f^2, 1).
    """
    half = 0.5 * width_px
    middle = 0.5 * np.array([width_px - 1, height_px - 1])
    H = _homographies(corners.points_m[:, :2], (corners.px - middle) / half, corners)
    H = H / np.linalg.norm(H, axis=(1, 2), keepdims=True)
    a, b = H[:, :, 0], H[:, :, 1]
    flat = np.concatenate([(a * b)[:, :2].sum(axis=1), (a * a - b * b)[:, :2].sum(axis=1)])
    deep = np.concatenate([a[:, 2] * b[:, 2], a[:, 2] ** 2 - b[:, 2] ** 2])
    inverse_square = -float(flat @ deep) / float(flat @ flat)
    widest, longest = 2.0 * _FOCAL_WIDTHS[0], 2.0 * _FOCAL_WIDTHS[-1]
    focal = 1.0 / np.sqrt(inverse_square) if inverse_square > 0.0 else 2.0
    return half * float(np.clip(focal, widest, longest))


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
    count = corners.per_view(forward.astype(np.float64))
    if count.min() < 4:
        raise CalibrationError("too few corners in front of the lens")
    ahead = corners.kept(forward)
    centred = ahead.points_m - (ahead.per_view(ahead.points_m) / count[:, None])[ahead.view]
    spread = np.linalg.eigvalsh(ahead.per_view(centred[:, :, None] * centred[:, None, :]))
    if (spread[:, 1] < 0.02**2 * spread[:, 2]).any():
        # Under a focal length far too short only one line of corners may lie ahead; that fixes no plane.
        raise CalibrationError("the corners in front of the lens lie on one line")
    H = _homographies(ahead.points_m[:, :2], rays[forward, :2] / rays[forward, 2:], ahead)
    length = np.sqrt(np.linalg.norm(H[:, :, 0], axis=1) * np.linalg.norm(H[:, :, 1], axis=1))
    H = H * (np.sign(H[:, 2, 2]) / length)[:, None, None]
    turned = np.stack([H[:, :, 0], H[:, :, 1], np.cross(H[:, :, 0], H[:, :, 1])], axis=2)
    return Bundle(lens, np.stack([nearest_rotation(matrix) for matrix in turned]), H[:, :, 2])


def _homographies(board_m: FloatArray, plane: FloatArray, corners: Corners) -> FloatArray:
    """Homography plane from board of each view, shape (V, 3, 3), of free scale."""
    A, board = _normalised(board_m, corners)
    B, seen = _normalised(plane, corners)
    one, zero = np.ones((len(board), 1)), np.zeros((len(board), 3))
    point = np.concatenate([board, one], axis=1)
    by_u = np.concatenate([point, zero, -seen[:, :1] * point], axis=1)
    by_v = np.concatenate([zero, point, -seen[:, 1:] * point], axis=1)
    bounds = corners.bounds()
    # The squared system loses half the digits, which a start can spare.
    gram = np.stack([by_u[a:b].T @ by_u[a:b] + by_v[a:b].T @ by_v[a:b] for a, b in pairwise(bounds)])
    result: FloatArray = np.linalg.inv(B) @ np.linalg.eigh(gram)[1][:, :, 0].reshape(-1, 3, 3) @ A
    return result


def _normalised(points: FloatArray, corners: Corners) -> tuple[FloatArray, FloatArray]:
    """Similarities that centre the points of each view and give them unit spread, (V, 3, 3), and the points so."""
    count = corners.per_view(np.ones(len(points)))
    centre = corners.per_view(points) / count[:, None]
    centred = points - centre[corners.view]
    scale = np.sqrt(2.0) / np.maximum(corners.per_view(np.linalg.norm(centred, axis=1)) / count, 1e-12)
    T = np.zeros((len(count), 3, 3))
    T[:, 0, 0] = T[:, 1, 1] = scale
    T[:, :2, 2] = -scale[:, None] * centre
    T[:, 2, 2] = 1.0
    return T, centred * scale[corners.view, None]
