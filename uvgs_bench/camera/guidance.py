"""Which picture of a board to take next, and whether the one just seen says anything new.

A view is taken when it lowers the uncertainty of projection over the picture, or reaches a place, a tilt or a distance
nobody has shown yet; a copy of an earlier view is not. Enough is what the verdict wishes for, with tilts to all sides.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.boards import BoardView
from uvgs_bench.camera.bundle import Bundle, Corners, information, refine_poses
from uvgs_bench.camera.bundle_start import planar_poses
from uvgs_bench.camera.fitting import Fit, fit
from uvgs_bench.camera.lens import Lens
from uvgs_bench.camera.projection_uncertainty import picture_grid
from uvgs_bench.camera.residual_structure import GRID_COLUMNS, GRID_ROWS, Coverage, coverage
from uvgs_bench.camera.verdict import WISHED_REACH, next_pictures
from uvgs_bench.errors import CalibrationError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import rad_from_deg

# Corners of two views this near on average, as a share of the picture's width, are the same view again.
_SAME_SHARE = 0.03
# Least fall of the mean variance of projection for which a view is taken, relative.
_LEAST_GAIN = 0.03
# Cells of the coverage a view must fill for the first time, or cells of its own share, to be taken for its place.
_NEW_CELLS = 3
_TILTED_RAD = rad_from_deg(20.0)
_FIRST_VIEWS = 4
_GRID = (9, 7)
TILTS = ("left edge nearer", "right edge nearer", "top edge nearer", "bottom edge nearer")
"""Sides a board can lean to, as the camera sees it."""


@dataclass(frozen=True, slots=True, eq=False)
class Guidance:
    """Where the taking of pictures stands.

    Args:
        views: Views taken so far.
        fitted: Lens of the views so far; None while they do not determine one.
        coverage: Where the boards were; None without a lens.
        counts: Corners in each cell of the picture, shape (rows, columns).
        tilts: Which of ``TILTS`` was shown.
        wishes: What is missing, most useful first; empty when it is enough.
    """

    views: tuple[BoardView, ...]
    fitted: Fit | None
    coverage: Coverage | None
    counts: NDArray[np.intp]
    tilts: tuple[bool, ...]
    wishes: tuple[str, ...]

    @property
    def is_enough(self) -> bool:
        """Whether nothing is missing."""
        return not self.wishes


@dataclass(frozen=True, slots=True)
class Answer:
    """Whether a view is worth taking.

    Args:
        is_taken: Whether it is.
        reason: Why, or why not, in a few words.
    """

    is_taken: bool
    reason: str


def begin() -> Guidance:
    """Guidance before the first view."""
    return Guidance((), None, None, np.zeros((GRID_ROWS, GRID_COLUMNS), dtype=np.intp), (False,) * 4, ("a first view",))


def consider(guidance: Guidance, view: BoardView) -> Answer:
    """Say whether a view adds to those taken.

    Args:
        guidance: Where the taking stands.
        view: The view just seen, of the same picture size.

    Returns:
        The answer.
    """
    for earlier in guidance.views:
        if shared_distance_px(earlier, view) < _SAME_SHARE * view.width_px:
            return Answer(False, f"like {earlier.name}: move the board")
    if len(guidance.views) < _FIRST_VIEWS or guidance.fitted is None:
        return Answer(True, "one of the first")
    filled = int(((_cells(view) > 0) & (guidance.counts == 0)).sum())
    if filled >= _NEW_CELLS:
        return Answer(True, f"{filled} new places in the picture")
    posed = _posed(guidance.fitted.bundle.lens, view)
    if posed is None:
        return Answer(True, "the lens so far does not see this board")
    side = _side(posed.R_cb[0])
    if side is not None and not guidance.tilts[side]:
        return Answer(True, TILTS[side])
    assert guidance.coverage is not None
    middle = posed.points_in_camera(Corners.of([view])).mean(axis=0)
    distance_m, seen_m = float(np.linalg.norm(middle)), guidance.coverage.distances_m
    reach = max(distance_m, float(seen_m.max())) / min(distance_m, float(seen_m.min()))
    if float(seen_m.max() / seen_m.min()) < WISHED_REACH and reach > 1.1 * float(seen_m.max() / seen_m.min()):
        return Answer(True, "a new distance")
    gain = _gain(guidance.fitted, posed, view)
    if gain >= _LEAST_GAIN:
        return Answer(True, f"the lens is known {100.0 * gain:.0f} % better")
    return Answer(False, "says nothing new")


def take(guidance: Guidance, view: BoardView, model: str) -> Guidance:
    """Take a view.

    Args:
        guidance: Where the taking stands.
        view: The view.
        model: Key of ``LENSES``: the lens the views so far are fitted with.

    Returns:
        Where it stands now.
    """
    views = (*guidance.views, view)
    counts = guidance.counts + _cells(view)
    fitted: Fit | None = None
    if len(views) >= _FIRST_VIEWS:
        try:
            found = fit(views, model)
            fitted = found if found.is_at_rest else None
        except CalibrationError:
            fitted = None
    if fitted is None:
        return Guidance(views, None, None, counts, guidance.tilts, ("a few views, each tilted to another side",))
    covered = coverage(fitted.bundle, fitted.kept)
    shown = {_side(R) for R in fitted.bundle.R_cb}
    tilts = tuple(i in shown for i in range(len(TILTS)))
    missing = [name for name, is_shown in zip(TILTS, tilts, strict=True) if not is_shown]
    wishes = next_pictures(fitted.bundle.lens, covered, len(views))
    if missing:
        wishes = (f"the board tilted by 20 deg and more: {', '.join(missing)}", *wishes)
    return Guidance(views, fitted, covered, counts, tilts, wishes)


def shared_distance_px(a: BoardView, b: BoardView) -> float:
    """Mean distance between the pixels of the corners two views share.

    Args:
        a: One view.
        b: The other view of the same board.

    Returns:
        The distance, px; infinite when they share fewer than four.
    """
    index = {tuple(point): i for i, point in enumerate(a.board_m.tolist())}
    pairs = [(index[key], j) for j, key in enumerate(map(tuple, b.board_m.tolist())) if key in index]
    if len(pairs) < 4:
        return inf
    i, j = np.array(pairs).T
    return float(np.linalg.norm(a.px[i] - b.px[j], axis=1).mean())


def _cells(view: BoardView) -> NDArray[np.intp]:
    column = np.clip((view.px[:, 0] * GRID_COLUMNS / view.width_px).astype(int), 0, GRID_COLUMNS - 1)
    row = np.clip((view.px[:, 1] * GRID_ROWS / view.height_px).astype(int), 0, GRID_ROWS - 1)
    counts = np.zeros((GRID_ROWS, GRID_COLUMNS), dtype=np.intp)
    np.add.at(counts, (row, column), 1)
    return counts


def _posed(lens: Lens, view: BoardView) -> Bundle | None:
    corners = Corners.of([view])
    try:
        posed = refine_poses(planar_poses(lens, corners), corners)
    except (CalibrationError, np.linalg.LinAlgError, ValueError):
        return None
    return posed if np.isfinite(posed.residuals_px(corners)).all() else None


def _side(R_cb: FloatArray) -> int | None:
    """Which of ``TILTS`` an attitude shows, or None for one that faces the camera."""
    # A plane whose normal points away from the camera and to the right comes nearer towards the right.
    normal = R_cb[:, 2] * np.sign(R_cb[2, 2] or 1.0)
    if np.hypot(normal[0], normal[1]) < np.sin(_TILTED_RAD):
        return None
    if abs(normal[0]) > abs(normal[1]):
        return 1 if normal[0] > 0.0 else 0
    return 3 if normal[1] > 0.0 else 2


def _gain(fitted: Fit, posed: Bundle, view: BoardView) -> float:
    """Relative fall of the mean variance of projection over the picture if the view were taken."""
    corners = fitted.kept
    try:
        told = information(fitted.bundle, corners).reduced.sum(axis=0)
        new = information(posed, Corners.of([view])).reduced[0]
        before, after = (np.linalg.inv(S) for S in (told, told + new))
    except np.linalg.LinAlgError:
        return 1.0
    lens = fitted.bundle.lens
    rays = lens.unproject(picture_grid(lens, *_GRID))
    rays = rays[np.isfinite(rays).all(axis=1)]
    _, by_point, by_lens = lens.project_with_jacobians(rays)
    # What a rotation of the camera can follow is no error of projection.
    turned = np.linalg.qr(np.cross(rays[:, None, :], by_point).reshape(-1, 3))[0]
    flat = by_lens.reshape(-1, by_lens.shape[2])
    free = flat - turned @ (turned.T @ flat)
    old = float(np.einsum("ij,jk,ik->", free, before, free))
    return 1.0 - float(np.einsum("ij,jk,ik->", free, after, free)) / max(old, 1e-300)
