"""Bundle adjustment of one lens and many board poses: sparse normal equations, Levenberg-Marquardt, covariance.

The board poses are eliminated (Schur complement), so the cost grows linearly with the number of views. One code serves
all lenses; it needs only ``Lens.project_with_jacobians``.

Source: B. Triggs et al., Bundle adjustment - a modern synthesis (2000), sections 6.1 and 9; K. Madsen et al., Methods
for non-linear least squares problems (2004), section 3.2, for the damping.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.boards import BoardView
from uvgs_bench.camera.bundle_kernels import gram_of_views, moved_poses
from uvgs_bench.camera.lens import Lens
from uvgs_bench.errors import CalibrationError
from uvgs_bench.geometry import FloatArray

_MAX_ITERATIONS = 200
# Relative gain and damping at which a minimum is reached.
_DONE, _UNDAMPED = 1e-12, 1e-5

SHAPE_NAMES = ("bow_x_m", "bow_y_m", "stretch_y")
"""The shape of a printed board: height of its middle over its edges by a parabola along x and along y (m), and how much
longer its y is printed than its x (a share). A common scale cannot be told from distance."""


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """Corners of all views in one list, view after view.

    Args:
        points_m: Board points, shape (N, 3), m.
        px: Observed pixels, shape (N, 2).
        view: Number of the view of each corner, shape (N,), rising from 0.
        view_count: Number of views; each has at least three corners.
        by_shape: Derivative of the board points by ``SHAPE_NAMES``, shape (N, 3, 3).
    """

    points_m: FloatArray
    px: FloatArray
    view: NDArray[np.intp]
    view_count: int
    by_shape: FloatArray

    @classmethod
    def of(cls, views: Sequence[BoardView]) -> Corners:
        """Pack views."""
        sizes = [len(view.px) for view in views]
        points_m = np.concatenate([view.board_m for view in views])
        low, high = points_m.min(axis=0), points_m.max(axis=0)
        middle, half = 0.5 * (low + high), np.maximum(0.5 * (high - low), 1e-12)
        offset = points_m - middle
        by_shape = np.zeros((len(points_m), 3, 3))
        by_shape[:, 2, 0] = 1.0 - (offset[:, 0] / half[0]) ** 2
        by_shape[:, 2, 1] = 1.0 - (offset[:, 1] / half[1]) ** 2
        by_shape[:, 1, 2] = offset[:, 1]
        return cls(
            points_m,
            np.concatenate([view.px for view in views]),
            np.repeat(np.arange(len(views)), sizes),
            len(views),
            by_shape,
        )

    def kept(self, mask: NDArray[np.bool_]) -> Corners:
        """Only the corners of a mask, shape (N,); every view must keep some."""
        return Corners(self.points_m[mask], self.px[mask], self.view[mask], self.view_count, self.by_shape[mask])

    def only(self, wanted: Sequence[int]) -> Corners:
        """Only some views, renumbered in the order given (which must rise)."""
        chosen = np.isin(self.view, wanted)
        renumber = np.searchsorted(np.asarray(wanted), self.view[chosen])
        return Corners(self.points_m[chosen], self.px[chosen], renumber, len(wanted), self.by_shape[chosen])

    def per_view(self, values: FloatArray) -> FloatArray:
        """Sum values over the corners of each view, shape (V, ...)."""
        result: FloatArray = np.add.reduceat(values, self.bounds()[:-1], axis=0)
        return result

    def bounds(self) -> NDArray[np.intp]:
        """Where each view begins, and the end, shape (V + 1,)."""
        return np.searchsorted(self.view, np.arange(self.view_count + 1))


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """A lens with the poses of all views.

    Args:
        lens: The lens.
        R_cb: Rotations camera from board, shape (V, 3, 3).
        t_cb: Translations, shape (V, 3), m.
        shape: Shape of the board by ``SHAPE_NAMES``, shape (3,), or None when the board is taken as declared.
    """

    lens: Lens
    R_cb: FloatArray
    t_cb: FloatArray
    shape: FloatArray | None = None

    @property
    def common(self) -> FloatArray:
        """Lens parameters, then the board's shape when it is free, shape (G,)."""
        parameters = self.lens.parameters
        return parameters if self.shape is None else np.concatenate([parameters, self.shape])

    def points_in_camera(self, corners: Corners) -> FloatArray:
        """Corners in camera axes, shape (N, 3), m."""
        board_m = corners.points_m
        if self.shape is not None:
            board_m = board_m + corners.by_shape @ self.shape
        turned = (self.R_cb[corners.view] @ board_m[:, :, None])[:, :, 0]
        result: FloatArray = turned + self.t_cb[corners.view]
        return result

    def residuals_px(self, corners: Corners) -> FloatArray:
        """Observed minus projected, shape (N, 2), px; NaN where the lens sees nothing."""
        return corners.px - self.lens.project(self.points_in_camera(corners))

    def only(self, wanted: Sequence[int]) -> Bundle:
        """The same with the poses of some views."""
        chosen = np.asarray(wanted)
        return Bundle(self.lens, self.R_cb[chosen], self.t_cb[chosen], self.shape)

    def moved(self, twists: FloatArray, common: FloatArray | None = None) -> Bundle:
        """Left update of every pose by its twist (V, 6), and new common parameters. Raises CalibrationError."""
        R, t = moved_poses(_same_kind(self.R_cb), _same_kind(self.t_cb), _same_kind(twists))
        if common is None:
            return Bundle(self.lens, R, t, self.shape)
        size = self.lens.parameters.size
        return Bundle(self.lens.with_parameters(common[:size]), R, t, None if self.shape is None else common[size:])


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """Normal equations of each view.

    Args:
        poses: Pose blocks, shape (V, 6, 6).
        mixed: Pose by common, shape (V, 6, G).
        common: Common blocks, shape (V, G, G).
        gradient_poses: Residuals carried to the poses, shape (V, 6).
        gradient_common: The same to the common parameters, shape (V, G).
        cost_of_view: Sum of squared residuals, shape (V,), px^2.
    """

    poses: FloatArray
    mixed: FloatArray
    common: FloatArray
    gradient_poses: FloatArray
    gradient_common: FloatArray
    cost_of_view: FloatArray


def normal_of_views(bundle: Bundle, corners: Corners, *, with_common: bool = True) -> NormalEquations:
    """Linearise the projection of every corner.

    Args:
        bundle: Where.
        corners: What was seen.
        with_common: Whether the common parameters have columns too; without, those blocks are empty.

    Returns:
        The equations; NaN for a view with a corner outside the valid field.
    """
    points_m = corners.points_m if bundle.shape is None else corners.points_m + corners.by_shape @ bundle.shape
    gram = gram_of_views(
        bundle.lens.model_id,
        bundle.lens.kernel_parameters,
        _same_kind(bundle.R_cb),
        _same_kind(bundle.t_cb),
        _same_kind(points_m),
        _same_kind(corners.px),
        corners.bounds(),
        _same_kind(corners.by_shape),
        bundle.lens.parameters.size if with_common else 0,
        len(SHAPE_NAMES) if with_common and bundle.shape is not None else 0,
    )
    return NormalEquations(
        gram[:, :6, :6], gram[:, :6, 6:-1], gram[:, 6:-1, 6:-1], gram[:, :6, -1], gram[:, 6:-1, -1], gram[:, -1, -1]
    )


def _same_kind(array: FloatArray) -> FloatArray:
    """Contiguous and writable: each other kind of array would be compiled anew."""
    array = np.ascontiguousarray(array, dtype=np.float64)
    return array if array.flags.writeable else array.copy()


def _damped(blocks: FloatArray, damping: FloatArray | float) -> FloatArray:
    """Blocks with their diagonals enlarged by a factor 1 + damping (one for all or one each)."""
    out = blocks.copy()
    i = np.arange(blocks.shape[-1])
    out[..., i, i] *= 1.0 + np.reshape(damping, (-1, 1)) if blocks.ndim == 3 else 1.0 + np.asarray(damping)
    return out


def adjust(bundle: Bundle, corners: Corners, prior: FloatArray | None = None) -> Bundle:
    """Least squares over the common parameters and all poses.

    Args:
        bundle: Start; every corner must be in the valid field.
        corners: What was seen.
        prior: Weights of the squares of the common parameters in the cost, shape (G,), px^2 per squared unit: how
            strongly each is drawn to zero. None draws nothing.

    Returns:
        The minimum.

    Raises:
        CalibrationError: The start does not see its corners, or nothing moves the cost.
    """
    weights = np.zeros(bundle.common.size) if prior is None else prior
    normal = normal_of_views(bundle, corners)
    cost = float(normal.cost_of_view.sum() + weights @ bundle.common**2)
    if not np.isfinite(cost):
        raise CalibrationError("the start of the adjustment does not see all corners")
    damping, growth, quiet = 1e-3, 2.0, 0
    for _ in range(_MAX_ITERATIONS):
        common = normal.common.sum(axis=0)
        common[np.diag_indices_from(common)] += weights
        try:
            inverse = np.linalg.inv(_damped(normal.poses, damping))
            eliminated = inverse @ normal.mixed
            S = _damped(common, damping) - (normal.mixed.swapaxes(1, 2) @ eliminated).sum(axis=0)
            gradient = normal.gradient_common.sum(axis=0) - weights * bundle.common
            rhs = gradient - np.einsum("vij,vi->j", eliminated, normal.gradient_poses)
            scale = 1.0 / np.sqrt(np.diag(common))
            step = scale * np.linalg.solve(scale[:, None] * S * scale, scale * rhs)
            twists = (inverse @ (normal.gradient_poses - normal.mixed @ step)[:, :, None])[:, :, 0]
            candidate = bundle.moved(twists, bundle.common + step)
            new = normal_of_views(candidate, corners)
            new_cost = float(new.cost_of_view.sum() + weights @ candidate.common**2)
        except (np.linalg.LinAlgError, CalibrationError, ValueError):
            new_cost = np.inf
        if new_cost <= cost:
            gain = (cost - new_cost) / max(cost, 1e-300)
            bundle, cost, normal = candidate, new_cost, new
            # After a failure the next step is tried nearly as short: in a bent valley long ones fail time and again.
            damping, growth = max(damping / (10.0 if growth == 2.0 else 3.0), 1e-12), 2.0
            # A nearly undamped step squares the distance to the minimum: this gain is about a hundred thousandth of a
            # deviation, the next step would be lost in rounding.
            quiet = quiet + 1 if gain < 1e-14 else 0
            if (gain < _DONE and damping < _UNDAMPED) or quiet >= 2 or cost < 1e-18 * len(corners.px):
                return bundle
        elif new_cost <= cost * (1.0 + _DONE) and damping < _UNDAMPED:
            return bundle
        else:
            damping, growth = damping * growth, growth * 2.0
            if damping > 1e10:
                return bundle
    return bundle


def relative_decrement(bundle: Bundle, corners: Corners, prior: FloatArray | None = None) -> float:
    """How much lower, as a share of the cost, the cost would be after one more undamped step: 0 at a minimum.

    Args:
        bundle: Where the adjustment ended.
        corners: What was seen.
        prior: As in ``adjust``.

    Returns:
        The share; infinite where no step can be computed.
    """
    normal = normal_of_views(bundle, corners)
    weights = np.zeros(bundle.common.size) if prior is None else prior
    cost = float(normal.cost_of_view.sum() + weights @ bundle.common**2)
    common = normal.common.sum(axis=0) + np.diag(weights)
    try:
        eliminated = np.linalg.solve(normal.poses, normal.mixed)
        own = np.linalg.solve(normal.poses, normal.gradient_poses[:, :, None])[:, :, 0]
        S = common - (normal.mixed.swapaxes(1, 2) @ eliminated).sum(axis=0)
        rhs = normal.gradient_common.sum(axis=0) - weights * bundle.common
        rhs = rhs - np.einsum("vij,vi->j", eliminated, normal.gradient_poses)
        scale = 1.0 / np.sqrt(np.diag(common))
        scaled = scale * rhs
        gain = float(scaled @ np.linalg.solve(scale[:, None] * S * scale, scaled))
        gain += float(np.einsum("vi,vi->", normal.gradient_poses, own))
    except np.linalg.LinAlgError:
        return inf
    return gain / max(cost, 1e-300) if np.isfinite(gain) else inf


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
    normal = normal_of_views(bundle, corners, with_common=False)
    for _ in range(iterations):
        blocks = np.where(np.isfinite(normal.poses), normal.poses, 0.0) + 1e-12 * np.eye(6)
        gradient = np.where(np.isfinite(normal.gradient_poses), normal.gradient_poses, 0.0)
        twists = np.asarray(np.linalg.solve(_damped(blocks, damping), gradient[:, :, None])[:, :, 0], dtype=np.float64)
        # Half a turn is the most a step can mean.
        twists[np.linalg.norm(twists[:, :3], axis=1) > 1.0] *= 0.3
        moved = bundle.moved(twists)
        new = normal_of_views(moved, corners, with_common=False)
        is_better = new.cost_of_view < normal.cost_of_view
        gain = (normal.cost_of_view - new.cost_of_view) / np.maximum(normal.cost_of_view, 1e-300)
        bundle = Bundle(
            bundle.lens,
            np.where(is_better[:, None, None], moved.R_cb, bundle.R_cb),
            np.where(is_better[:, None], moved.t_cb, bundle.t_cb),
            bundle.shape,
        )
        if is_better.all():
            normal = new
        elif is_better.any():
            normal = normal_of_views(bundle, corners, with_common=False)
        damping = np.where(is_better, damping * 0.1, damping * 8.0)
        if (is_better & (gain < 1e-12)).all() or (damping > 1e3).all():
            break
    return bundle


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """What each view says about the common parameters once its pose is free, and how its pose follows them.

    Args:
        reduced: Schur complement of each view, shape (V, G, G), 1/px^2.
        pose_inverse: Inverse information of each pose at fixed common parameters, shape (V, 6, 6), px^2.
        pose_by_common: Change of each pose's twist with the common parameters, shape (V, 6, G).
    """

    reduced: FloatArray
    pose_inverse: FloatArray
    pose_by_common: FloatArray


def information(bundle: Bundle, corners: Corners) -> Information:
    """Information at a minimum, view by view. Raises LinAlgError when a view does not fix its own pose."""
    normal = normal_of_views(bundle, corners)
    inverse = np.asarray(np.linalg.inv(normal.poses), dtype=np.float64)
    eliminated: FloatArray = inverse @ normal.mixed
    S = normal.common - normal.mixed.swapaxes(1, 2) @ eliminated
    reduced: FloatArray = 0.5 * (S + S.swapaxes(1, 2))
    return Information(reduced, inverse, -eliminated)
