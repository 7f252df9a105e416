"""How far two lenses disagree about one camera, and how well one model can stand in for another.

Two calibrations of one camera may describe the same optics in camera axes that are turned against each other: no
picture of a board can tell. So the rotation that best maps one to the other is taken out before they are compared.

Source: the idea of the implied rotation is mrcal's (D. Kogan, mrcal documentation, "Projection differences"); here it
minimises squared pixel differences over the whole picture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf, pi

import numpy as np

from uvgs_bench.camera import lens_kernels
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.lens import LENSES, Lens
from uvgs_bench.errors import CalibrationError
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.geometry.se3 import nearest_rotation, so3_exp

_GRID_COLUMNS = 40
_MAX_ITERATIONS = 100
# Fewer pixels than this do not hold a lens of sixteen parameters.
_LEAST_PIXELS = 50
# A fit this good is the same map; further steps only move rounding errors.
_EXACT_PX = 1e-9
_POLYNOMIALS = ("plumb_bob", "rational_polynomial", "thin_prism")
# A fraction of two polynomials has many minima; these focal lengths, as shares of that on the axis, find a good one.
_FOCAL_FACTORS = (1.0, 1.03, 0.97)
_GOOD_PX = 0.01
# Lenses other than ``equidistant`` see nothing at 90 degrees; close to it their pixels run away.
_AHEAD_RAD = 0.5 * pi - 0.05


@dataclass(frozen=True, slots=True, eq=False)
class LensDifference:
    """Where two lenses put the same rays, after the rotation between their axes is taken out.

    Args:
        grid_px: Pixels of the first lens, shape (H, W, 2).
        shift_px: Pixel of the second lens minus pixel of the first, shape (H, W, 2); NaN where either has no ray.
        sigma_px: Predicted root mean square length of the shift from the covariances of both, shape (H, W); None when
            one is unknown. It holds for calibrations from different pictures.
        R_ba: Rotation from the axes of the first to those of the second, shape (3, 3).
        rms_px: Root mean square length of the shift, px.
        max_px: Largest length, px.
        max_at_px: Pixel where that is, shape (2,).
        centre_px: Length of the shift at the middle of the picture, px; NaN where there is no ray.
        predicted_rms_px: Root mean square of ``sigma_px``, px, or None.
        compared_share: Share of the picture in which both lenses have rays.
    """

    grid_px: FloatArray
    shift_px: FloatArray
    sigma_px: FloatArray | None
    R_ba: FloatArray
    rms_px: float
    max_px: float
    max_at_px: FloatArray
    centre_px: float
    predicted_rms_px: float | None
    compared_share: float


def difference(a: Calibration, b: Calibration) -> LensDifference:
    """Compare two calibrations of one camera.

    Args:
        a: The first; its pixels are the places of the map.
        b: The second.

    Returns:
        The map and its figures.

    Raises:
        CalibrationError: The pictures differ in size, or no ray is seen by both.
    """
    b.check_size(a.lens.width_px, a.lens.height_px, "the first camera's picture")
    grid = _grid(a.lens)
    px = grid.reshape(-1, 2)
    rays_a, rays_b = a.lens.unproject(px), b.lens.unproject(px)
    both = np.isfinite(rays_a).all(axis=1) & np.isfinite(rays_b).all(axis=1)
    if int(both.sum()) < 3:
        raise CalibrationError("the two lenses have no rays in common")
    R = _implied_rotation(b.lens, rays_a[both], rays_b[both], px[both])
    shift = np.full_like(px, np.nan)
    shift[both] = b.lens.project(rays_a[both] @ R.T) - px[both]
    length = np.linalg.norm(shift, axis=1)
    worst = int(np.nanargmax(length))
    sigma = _predicted(a, b, rays_a, R, np.isfinite(length))
    middle = np.array([0.5 * (a.lens.width_px - 1), 0.5 * (a.lens.height_px - 1)])
    at_centre = b.lens.project(a.lens.unproject(middle) @ R.T)[0] - middle
    return LensDifference(
        read_only(grid),
        read_only(shift.reshape(grid.shape)),
        None if sigma is None else read_only(sigma.reshape(grid.shape[:2])),
        read_only(R),
        float(np.sqrt(np.nanmean(length**2))),
        float(length[worst]),
        read_only(px[worst]),
        float(np.linalg.norm(at_centre)),
        None if sigma is None else float(np.sqrt(np.nanmean(sigma**2))),
        float(np.isfinite(length).mean()),
    )


def _grid(lens: Lens, columns: int = _GRID_COLUMNS) -> FloatArray:
    """Pixels from edge to edge, about square cells, shape (H, W, 2)."""
    rows = max(3, round(columns * lens.height_px / lens.width_px))
    u, v = np.linspace(0.0, lens.width_px - 1.0, columns), np.linspace(0.0, lens.height_px - 1.0, rows)
    return np.stack(np.meshgrid(u, v), axis=-1)


def _turning(lens: Lens, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels of rays, and their derivative by a small rotation from the left, shape (N, 2, 3)."""
    projected, by_point, _ = lens.project_with_jacobians(rays)
    # d(R p) = w x p, and a . (w x p) = w . (p x a).
    return projected, np.cross(rays[:, None, :], by_point)


def _implied_rotation(lens: Lens, rays_a: FloatArray, rays_b: FloatArray, px: FloatArray) -> FloatArray:
    """The rotation that brings rays of one lens to the same pixels in the other, least squares in pixels."""
    R = nearest_rotation(rays_b.T @ rays_a)
    for _ in range(20):
        projected, by_turn = _turning(lens, np.ascontiguousarray(rays_a @ R.T))
        seen = np.isfinite(projected).all(axis=1) & np.isfinite(by_turn).all(axis=(1, 2))
        J, e = by_turn[seen].reshape(-1, 3), (px - projected)[seen].ravel()
        step = np.linalg.lstsq(J, e, rcond=None)[0]
        R = np.ascontiguousarray(so3_exp(np.ascontiguousarray(step)) @ R)
        if float(np.linalg.norm(step)) < 1e-13:
            break
    return R


def _predicted(
    a: Calibration, b: Calibration, rays_a: FloatArray, R: FloatArray, seen: FloatArray
) -> FloatArray | None:
    """Standard length of the shift that the covariances allow, with what the rotation takes out taken out here too."""
    if a.covariance is None or b.covariance is None:
        return None
    rays = np.ascontiguousarray(rays_a[seen])
    turned = np.ascontiguousarray(rays @ R.T)
    G = _turning(b.lens, turned)[1].reshape(-1, 3)
    variance = np.zeros(len(rays))
    for lens, at, covariance in ((a.lens, rays, a.covariance), (b.lens, turned, b.covariance)):
        by_lens = lens.project_with_jacobians(at)[2]
        J = by_lens.reshape(-1, by_lens.shape[2])
        J = J - G @ np.linalg.lstsq(G, J, rcond=None)[0]
        variance += np.einsum("ni,ij,nj->n", J, covariance, J).reshape(-1, 2).sum(axis=1)
    sigma = np.full(len(rays_a), np.nan)
    sigma[seen] = np.sqrt(np.maximum(variance, 0.0))
    return sigma


@dataclass(frozen=True, slots=True, eq=False)
class Refit:
    """A lens of another model in place of the first.

    Args:
        lens: The nearest lens of that model, in the same axes.
        rms_px: Root mean square pixel difference over the covered field, px.
        max_px: Largest difference there, px.
        covered_share: Share of the picture in which the first lens has rays.
    """

    lens: Lens
    rms_px: float
    max_px: float
    covered_share: float


def refit(lens: Lens, model: str, zeros: tuple[str, ...] = (), radius_px: float = inf) -> Refit:
    """Find the lens of another model that is nearest over the field the first lens covers.

    Args:
        lens: The lens to replace.
        model: Key of ``LENSES``.
        zeros: Coefficients that must stay zero.
        radius_px: Distance from the principal point up to which the first lens means anything, px.

    Returns:
        The new lens, and by how many pixels it is wrong.

    Raises:
        CalibrationError: Unknown model, or the lens looks so far off its axis that the model has no pixels there.
    """
    if model not in LENSES:
        raise CalibrationError(f"unknown lens model '{model}', expected one of {', '.join(LENSES)}")
    px = _grid(lens).reshape(-1, 2)
    rays = lens.unproject(px)
    covered = np.isfinite(rays).all(axis=1) & _near(lens, px, radius_px)
    if int(covered.sum()) < _LEAST_PIXELS:
        raise CalibrationError(f"the lens is known only within {radius_px:.0f} px: too little to refit it")
    rays, px = np.ascontiguousarray(rays[covered]), np.ascontiguousarray(px[covered])
    off_axis = np.arctan2(np.linalg.norm(rays[:, :2], axis=1), rays[:, 2])
    if model != "equidistant" and float(off_axis.max()) > _AHEAD_RAD:
        raise CalibrationError(f"the {lens.model} lens looks sideways or behind itself, where {model} has no pixels")
    if model in _POLYNOMIALS and lens.model in _POLYNOMIALS[: _POLYNOMIALS.index(model) + 1] and not zeros:
        # The same polynomials with more coefficients: nothing to search.
        padded = np.zeros(len(LENSES[model].parameter_names))
        padded[: lens.parameters.size] = lens.parameters
        return Refit(Lens(model, lens.width_px, lens.height_px, padded), 0.0, 0.0, float(covered.mean()))
    free = np.array([name not in zeros for name in LENSES[model].parameter_names])
    # Judged on other pixels than it was fitted to.
    fine = _grid(lens, 2 * _GRID_COLUMNS + 1).reshape(-1, 2)
    fine_rays = lens.unproject(fine)
    known = np.isfinite(fine_rays).all(axis=1) & _near(lens, fine, radius_px)
    best: Refit | None = None
    for begin in _starts(lens, model, rays, px, free):
        fitted = _fitted(begin, rays, px, free)
        error = np.linalg.norm(fitted.project(fine_rays[known]) - fine[known], axis=1)
        rms_px = float(np.sqrt(np.mean(error**2)))
        if np.isfinite(rms_px) and (best is None or rms_px < best.rms_px):
            best = Refit(fitted, rms_px, float(error.max()), float(known.mean()))
        if best is not None and best.rms_px < _GOOD_PX:
            break
    if best is None:
        raise CalibrationError(f"no {model} lens covers the field of this {lens.model} lens")
    return best


def _near(lens: Lens, px: FloatArray, radius_px: float) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    near: np.ndarray[tuple[int], np.dtype[np.bool_]] = np.linalg.norm(px - lens.parameters[2:4], axis=1) <= radius_px
    return near


def _starts(lens: Lens, model: str, rays: FloatArray, px: FloatArray, free: FloatArray) -> Iterator[Lens]:
    """Lenses to start from: the focal length near the axis, and for polynomials others beside it."""
    names = LENSES[model].parameter_names
    parameters = np.zeros(len(names))
    parameters[:4] = lens.parameters[:4]
    axis = np.array([0.0, 0.0, 1.0])
    by_point = lens.project_with_jacobians(axis)[1][0]
    parameters[:2] = by_point[0, 0], by_point[1, 1]
    if model == "fov":
        parameters[4] = 0.9
        parameters[:2] *= 0.45 / np.tan(0.45)
    yield Lens(model, lens.width_px, lens.height_px, parameters)
    if model not in _POLYNOMIALS:
        return
    for factor in _FOCAL_FACTORS:
        other = parameters.copy()
        other[:2] *= factor
        yield _radial_start(Lens(model, lens.width_px, lens.height_px, other), rays, px, free)


def _fitted(lens: Lens, rays: FloatArray, px: FloatArray, free: FloatArray) -> Lens:
    """Levenberg-Marquardt over the free parameters.

    The end of the valid field is ignored on the way: it moves with every step and would stop the search.
    """

    def linearised(at: Lens) -> tuple[float, FloatArray, FloatArray]:
        everywhere = at.kernel_parameters.copy()
        everywhere[lens_kernels.LIMIT] = np.inf
        projected, _, by_kernel = lens_kernels.project_points_with_jacobians(at.model_id, everywhere, rays)
        e = (px - projected).ravel()
        J = by_kernel[:, :, : at.parameters.size][:, :, free]
        return float(e @ e), e, np.ascontiguousarray(J).reshape(e.size, -1)

    cost, e, J = linearised(lens)
    damping, quiet = 1e-3, 0
    for _ in range(_MAX_ITERATIONS):
        scale = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
        # The damping as further equations: the squared system would lose the digits high coefficients need.
        A = np.concatenate([J / scale, np.sqrt(damping) * np.eye(len(scale))])
        step = np.linalg.lstsq(A, np.concatenate([e, np.zeros(len(scale))]), rcond=None)[0] / scale
        parameters = lens.parameters.copy()
        parameters[free] += step
        try:
            candidate = lens.with_parameters(parameters)
            new_cost, new_e, new_J = linearised(candidate)
        except CalibrationError:
            new_cost = np.inf
        if new_cost <= cost:
            quiet = quiet + 1 if cost - new_cost <= 1e-9 * cost else 0
            lens, cost, e, J = candidate, new_cost, new_e, new_J
            damping = max(0.1 * damping, 1e-15)
            if quiet >= 3 or cost < _EXACT_PX**2 * len(px):
                break
        else:
            damping *= 8.0
            if damping > 1e8:
                break
    return lens


def _radial_start(lens: Lens, rays: FloatArray, px: FloatArray, free: FloatArray) -> Lens:
    """Radial coefficients of a polynomial lens by linear equations, x_d D(r^2) = x N(r^2)."""
    x = rays[:, :2] / rays[:, 2:]
    s = np.einsum("ni,ni->n", x, x)[:, None]
    distorted = (px - lens.parameters[2:4]) / lens.parameters[:2]
    columns = {"k1": s * x, "k2": s**2 * x, "k3": s**3 * x}
    columns |= {"k4": -s * distorted, "k5": -(s**2) * distorted, "k6": -(s**3) * distorted}
    names = LENSES[lens.model].parameter_names
    used = [name for name in columns if name in names and free[names.index(name)]]
    # Near the edge the equations are large by the power of r alone; weighed back to pixels.
    weight = 1.0 / (1.0 + s if lens.model == "plumb_bob" else (1.0 + s) ** 2)
    A = np.column_stack([(weight * columns[name]).ravel() for name in used])
    scale = np.linalg.norm(A, axis=0)
    solved = np.linalg.lstsq(A / scale, (weight * (distorted - x)).ravel(), rcond=1e-9)[0] / scale
    parameters = lens.parameters.copy()
    parameters[[names.index(name) for name in used]] = solved
    return lens.with_parameters(parameters)
