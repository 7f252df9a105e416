"""Bundle adjustment of one lens and many board poses: sparse normal equations, Levenberg-Marquardt, covariance.

The board poses are eliminated (Schur complement), so the cost grows linearly with the number of views. One code serves
all lenses; it needs only ``Lens.project_with_jacobians``.

Source: B. Triggs et al., Bundle adjustment - a modern synthesis (2000), sections 6.1 and 9; K. Madsen et al., Methods
for non-linear least squares problems (2004), section 3.2, for the damping.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.boards import BoardView
from uvgs_bench.camera.lens import Lens
from uvgs_bench.errors import CalibrationError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.se3 import se3_exp

_MAX_ITERATIONS = 200


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """Corners of all views in one list, view after view.

    Args:
        points_m: Board points, shape (N, 3), m.
        px: Observed pixels, shape (N, 2).
        view: Number of the view of each corner, shape (N,), rising from 0.
        view_count: Number of views; each has at least three corners.
    """

    points_m: FloatArray
    px: FloatArray
    view: NDArray[np.intp]
    view_count: int

    @classmethod
    def of(cls, views: Sequence[BoardView]) -> Corners:
        """Pack views."""
        sizes = [len(view.px) for view in views]
        return cls(
            np.concatenate([view.board_m for view in views]),
            np.concatenate([view.px for view in views]),
            np.repeat(np.arange(len(views)), sizes),
            len(views),
        )

    def kept(self, mask: NDArray[np.bool_]) -> Corners:
        """Only the corners of a mask, shape (N,); every view must keep some."""
        return Corners(self.points_m[mask], self.px[mask], self.view[mask], self.view_count)

    def only(self, wanted: Sequence[int]) -> Corners:
        """Only some views, renumbered in the order given (which must rise)."""
        chosen = np.isin(self.view, wanted)
        renumber = np.searchsorted(np.asarray(wanted), self.view[chosen])
        return Corners(self.points_m[chosen], self.px[chosen], renumber, len(wanted))

    def per_view(self, values: FloatArray) -> FloatArray:
        """Sum values over the corners of each view, shape (V, ...)."""
        starts = np.searchsorted(self.view, np.arange(self.view_count))
        result: FloatArray = np.add.reduceat(values, starts, axis=0)
        return result


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """A lens with the poses of all views.

    Args:
        lens: The lens.
        R_cb: Rotations camera from board, shape (V, 3, 3).
        t_cb: Translations, shape (V, 3), m.
    """

    lens: Lens
    R_cb: FloatArray
    t_cb: FloatArray

    def points_in_camera(self, corners: Corners) -> FloatArray:
        """Corners in camera axes, shape (N, 3), m."""
        turned = np.einsum("nij,nj->ni", self.R_cb[corners.view], corners.points_m)
        result: FloatArray = turned + self.t_cb[corners.view]
        return result

    def residuals_px(self, corners: Corners) -> FloatArray:
        """Observed minus projected, shape (N, 2), px; NaN where the lens sees nothing."""
        return corners.px - self.lens.project(self.points_in_camera(corners))

    def moved(self, twists: FloatArray, parameters: FloatArray | None = None) -> Bundle:
        """Left update of every pose by its twist (V, 6), and new lens parameters. Raises CalibrationError."""
        R, t = np.empty_like(self.R_cb), np.empty_like(self.t_cb)
        for i, twist in enumerate(np.ascontiguousarray(twists)):
            dR, dt = se3_exp(twist)
            R[i], t[i] = dR @ self.R_cb[i], dR @ self.t_cb[i] + dt
        return Bundle(self.lens if parameters is None else self.lens.with_parameters(parameters), R, t)


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations: pose blocks (V, 6, 6), mixed blocks (V, 6, P), lens block (P, P), and the gradients."""

    poses: FloatArray
    mixed: FloatArray
    lens: FloatArray
    gradient_poses: FloatArray
    gradient_lens: FloatArray
    cost_of_view: FloatArray


def _normal(bundle: Bundle, corners: Corners) -> _Normal:
    p = bundle.points_in_camera(corners)
    px, by_point, by_lens = bundle.lens.project_with_jacobians(p)
    e = corners.px - px
    # d p' / d xi = [-[p']^ | I] for the left update; a row a of d px / d p' times -[p']^ is p' x a.
    by_pose = np.concatenate([np.cross(p[:, None, :], by_point), by_point], axis=2)
    add = corners.per_view
    return _Normal(
        add(by_pose.swapaxes(1, 2) @ by_pose),
        add(by_pose.swapaxes(1, 2) @ by_lens),
        np.tensordot(by_lens, by_lens, axes=((0, 1), (0, 1))),
        add(np.einsum("nij,ni->nj", by_pose, e)),
        np.einsum("nij,ni->j", by_lens, e),
        add(np.einsum("ni,ni->n", e, e)),
    )


def _damped(blocks: FloatArray, damping: FloatArray | float) -> FloatArray:
    """Blocks with their diagonals enlarged by a factor 1 + damping (one for all or one each)."""
    out = blocks.copy()
    i = np.arange(blocks.shape[-1])
    out[..., i, i] *= 1.0 + np.reshape(damping, (-1, 1)) if blocks.ndim == 3 else 1.0 + np.asarray(damping)
    return out


def adjust(bundle: Bundle, corners: Corners) -> Bundle:
    """Least squares over the lens and all poses.

    Args:
        bundle: Start; every corner must be in the valid field.
        corners: What was seen.

    Returns:
        The minimum.

    Raises:
        CalibrationError: The start does not see its corners, or nothing moves the cost.
    """
    normal = _normal(bundle, corners)
    cost = float(normal.cost_of_view.sum())
    if not np.isfinite(cost):
        raise CalibrationError("the start of the adjustment does not see all corners")
    damping, growth, quiet = 1e-3, 2.0, 0
    for _ in range(_MAX_ITERATIONS):
        try:
            inverse = np.linalg.inv(_damped(normal.poses, damping))
            eliminated = inverse @ normal.mixed
            S = _damped(normal.lens, damping) - np.tensordot(normal.mixed, eliminated, axes=((0, 1), (0, 1)))
            rhs = normal.gradient_lens - np.einsum("vij,vi->j", eliminated, normal.gradient_poses)
            scale = 1.0 / np.sqrt(np.diag(normal.lens))
            step = scale * np.linalg.solve(scale[:, None] * S * scale, scale * rhs)
            twists = np.einsum("vij,vj->vi", inverse, normal.gradient_poses - normal.mixed @ step)
            candidate = bundle.moved(twists, bundle.lens.parameters + step)
            new_cost = float((candidate.residuals_px(corners) ** 2).sum())
        except (np.linalg.LinAlgError, CalibrationError, ValueError):
            new_cost = np.inf
        if new_cost <= cost:
            gain = (cost - new_cost) / max(cost, 1e-300)
            bundle, cost = candidate, new_cost
            damping, growth = max(damping / 10.0, 1e-12), 2.0
            # Two steps in a row without gain: the digits are used up.
            quiet = quiet + 1 if gain < 1e-14 else 0
            if quiet >= 2 or cost < 1e-18 * len(corners.px):
                return bundle
            normal = _normal(bundle, corners)
        else:
            damping, growth = damping * growth, growth * 2.0
            if damping > 1e10:
                return bundle
    return bundle


def refine_poses(bundle: Bundle, corners: Corners, iterations: int = 50) -> Bundle:
    """Least squares over the poses alone, each view with its own damping.

    Args:
        bundle: Start; views whose corners are not all visible stay as they are.
        corners: What was seen.
        iterations: At most so many steps.

    Returns:
        The lens with better poses.
    """
    damping = np.full(corners.view_count, 1e-3)
    normal = _normal(bundle, corners)
    for _ in range(iterations):
        blocks = np.where(np.isfinite(normal.poses), normal.poses, 0.0) + 1e-12 * np.eye(6)
        gradient = np.where(np.isfinite(normal.gradient_poses), normal.gradient_poses, 0.0)
        twists = np.asarray(np.linalg.solve(_damped(blocks, damping), gradient[:, :, None])[:, :, 0], dtype=np.float64)
        # Half a turn is the most a step can mean.
        twists[np.linalg.norm(twists[:, :3], axis=1) > 1.0] *= 0.3
        moved = bundle.moved(twists)
        new = _normal(moved, corners)
        is_better = new.cost_of_view < normal.cost_of_view
        gain = (normal.cost_of_view - new.cost_of_view) / np.maximum(normal.cost_of_view, 1e-300)
        bundle = Bundle(
            bundle.lens,
            np.where(is_better[:, None, None], moved.R_cb, bundle.R_cb),
            np.where(is_better[:, None], moved.t_cb, bundle.t_cb),
        )
        if is_better.all():
            normal = new
        elif is_better.any():
            normal = _normal(bundle, corners)
        damping = np.where(is_better, damping * 0.1, damping * 8.0)
        if (is_better & (gain < 1e-12)).all() or (damping > 1e3).all():
            break
    return bundle


def lens_information(bundle: Bundle, corners: Corners) -> FloatArray:
    """Information about the lens with all poses free: the Schur complement of the normal equations, (P, P), 1/px^2."""
    normal = _normal(bundle, corners)
    eliminated = np.linalg.solve(normal.poses, normal.mixed)
    S = normal.lens - np.tensordot(normal.mixed, eliminated, axes=((0, 1), (0, 1)))
    result: FloatArray = 0.5 * (S + S.T)
    return result
