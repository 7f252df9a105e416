"""From found corners to a calibration with its doubt: outliers, covariance, held-out error, warnings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.boards import BoardMiss, BoardView
from uvgs_bench.camera.bundle import Bundle, Corners, adjust, information, refine_poses
from uvgs_bench.camera.bundle_start import start
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.lens import LENSES, Lens
from uvgs_bench.errors import CalibrationError, TooFewViews
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.units import deg_from_rad

MIN_VIEWS = 3
_WISHED_VIEWS = 8
_FOLDS = 5
_OUTLIER_SIGMAS = 4.0
_MAX_OUTLIER_SHARE = 0.1
_WISHED_TILT_RAD = 0.2
# Boards in parallel planes leave focal length and distance undetermined, however many there are.
_PARALLEL_RAD = 0.03
# Scaled condition number above which parameters only mean something together.
_MAX_CONDITION = 1e9


@dataclass(frozen=True, slots=True)
class RejectedCorner:
    """A corner set aside as an outlier.

    Args:
        view: Name of the picture.
        index: Number of the corner within the view.
        u_px: Where it was found, column, px.
        v_px: Row, px.
        residual_px: Its distance from the final projection, px.
    """

    view: str
    index: int
    u_px: float
    v_px: float
    residual_px: float


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """A calibration with all that led to it.

    Args:
        calibration: The lens and its doubt, fitted to the kept corners.
        all_corners: The same from every corner, before any was set aside.
        camera_from_board: Pose of each view.
        residuals_px: Observed minus projected, one (N, 2) per view, px; outliers included.
        rejected: Corners set aside, worst first.
        view_names: Names of the views.
        view_rms_px: RMS of the residual lengths of the kept corners of each view, shape (V,), px.
        fold_rms_px: Held-out RMS of each fold, px; empty with too few views.
        condition: Scaled condition number of the information about the lens.
        max_tilt_rad: Largest angle between a board and the picture plane, rad.
        covered_radius: Largest distance of a corner from the principal point, as a share of the picture's
            farthest corner.
        warnings: Sentences for people, with numbers.
        misses: Pictures without a usable board, added by whoever looked for them.
    """

    calibration: Calibration
    all_corners: Calibration
    camera_from_board: tuple[Pose, ...]
    residuals_px: tuple[FloatArray, ...]
    rejected: tuple[RejectedCorner, ...]
    view_names: tuple[str, ...]
    view_rms_px: FloatArray
    fold_rms_px: FloatArray
    condition: float
    max_tilt_rad: float
    covered_radius: float
    warnings: tuple[str, ...]
    misses: tuple[BoardMiss, ...] = ()


def calibrate(
    views: Sequence[BoardView],
    model: str,
    *,
    camera_name: str = "",
    reject_outliers: bool = True,
    notes: dict[str, str] | None = None,
) -> CalibrationResult:
    """Fit a lens to board views by bundle adjustment.

    Args:
        views: Found corners, all from pictures of one size.
        model: Key of ``LENSES``.
        camera_name: For people.
        reject_outliers: Whether corners farther than four robust standard deviations are set aside, at most 10 %.
        notes: Provenance to keep with the calibration.

    Returns:
        The calibration with residuals, outliers and warnings.

    Raises:
        TooFewViews: Fewer than three views, or views too alike to tell the parameters apart.
        CalibrationError: Unknown model, pictures of different sizes, or boards no lens of the model can have seen.
    """
    if model not in LENSES:
        raise CalibrationError(f"unknown lens model '{model}', expected one of {', '.join(LENSES)}")
    if len(views) < MIN_VIEWS:
        raise TooFewViews(f"{len(views)} usable views of the board, need at least {MIN_VIEWS}")
    first = views[0]
    for view in views:
        if (view.width_px, view.height_px) != (first.width_px, first.height_px):
            raise CalibrationError(
                f"pictures of different sizes: {first.name} is {first.width_px}x{first.height_px} px, "
                f"{view.name} is {view.width_px}x{view.height_px} px"
            )
    corners = Corners.of(views)
    unknowns = len(LENSES[model].parameter_names) + 6 * len(views)
    if 2 * len(corners.px) <= unknowns:
        raise TooFewViews(f"{len(corners.px)} corners do not determine {unknowns} unknowns")
    whole = start(model, corners, first.width_px, first.height_px)
    keep = np.ones(len(corners.px), dtype=np.bool_)
    bundle = whole
    if reject_outliers:
        bundle, keep = _without_outliers(whole, corners)
    kept = corners.kept(keep)
    normals = bundle.R_cb[:, :, 2]
    if float(np.linalg.norm(np.cross(normals, normals[0]), axis=1).max()) < _PARALLEL_RAD:
        raise TooFewViews(f"all {len(views)} views show the board in the same attitude: tilt it in several directions")
    fold_rms_px, held_out_rms_px = _held_out(bundle, kept)
    covariance, condition = _covariance(bundle, kept)
    calibration = _calibration(
        bundle, kept, covariance, camera_name, int((~keep).sum()), held_out_rms_px, dict(notes or {})
    )
    everything = calibration
    if not keep.all():
        everything = _calibration(whole, corners, _covariance(whole, corners)[0], camera_name, 0, None, {})
    residuals = bundle.residuals_px(corners)
    tilts = np.arccos(np.clip(np.abs(bundle.R_cb[:, 2, 2]), 0.0, 1.0))
    covered = _covered_radius(bundle.lens, kept)
    split = np.searchsorted(corners.view, np.arange(1, len(views)))
    squares = kept.per_view(_squared_length(bundle.residuals_px(kept)))
    result = CalibrationResult(
        calibration,
        everything,
        tuple(Pose(R, t, "camera", "board") for R, t in zip(bundle.R_cb, bundle.t_cb, strict=True)),
        tuple(read_only(part) for part in np.split(residuals, split)),
        _rejected(views, corners, keep, residuals),
        tuple(view.name for view in views),
        read_only(np.sqrt(squares / kept.per_view(np.ones(len(kept.px))))),
        fold_rms_px,
        condition,
        float(tilts.max()),
        covered,
        (),
    )
    return replace(result, warnings=_warnings(result))


def _squared_length(residuals: FloatArray) -> FloatArray:
    result: FloatArray = np.einsum("ni,ni->n", residuals, residuals)
    return result


def _without_outliers(bundle: Bundle, corners: Corners) -> tuple[Bundle, NDArray[np.bool_]]:
    """Set aside and adjust again until the set no longer changes."""
    keep = np.ones(len(corners.px), dtype=np.bool_)
    at_most = int(_MAX_OUTLIER_SHARE * len(corners.px))
    for _ in range(10):
        residuals = bundle.residuals_px(corners)
        # Median absolute deviation of what is kept, as a standard deviation of a normal distribution.
        sigma = 1.4826 * float(np.median(np.abs(residuals[keep])))
        worst = np.nan_to_num(np.abs(residuals).max(axis=1), nan=np.inf)
        limit = max(_OUTLIER_SIGMAS * sigma, 1e-9)
        if at_most < int((worst > limit).sum()):
            limit = float(np.sort(worst)[-at_most - 1])
        new = worst <= limit
        # A view that lost most of its corners keeps them: it is the pose that is wrong, and its RMS will say so.
        lost = corners.per_view((~new).astype(np.float64)) > 0.5 * corners.per_view(np.ones(len(new)))
        new |= lost[corners.view]
        if (new == keep).all():
            break
        keep = new
        bundle = adjust(bundle, corners.kept(keep))
    return bundle, keep


def _covariance(bundle: Bundle, corners: Corners) -> tuple[FloatArray, float]:
    """Covariance of the lens parameters with all poses free, with N - p degrees of freedom, and the condition."""
    residuals = bundle.residuals_px(corners)
    unknowns = bundle.lens.parameters.size + 6 * corners.view_count
    variance = float((residuals**2).sum()) / (residuals.size - unknowns)
    S = information(bundle, corners).reduced.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(S), 1e-300))
    scaled = scale[:, None] * S * scale
    eigenvalues, vectors = np.linalg.eigh(scaled)
    if not eigenvalues[0] > 1e-15 * eigenvalues[-1]:
        raise TooFewViews(
            f"the views do not tell the parameters of a {bundle.lens.model} lens apart: tilt the board in several "
            "directions, at several distances, or choose a lens with fewer coefficients"
        )
    inverse = (vectors / eigenvalues) @ vectors.T
    covariance = variance * scale[:, None] * inverse * scale
    return 0.5 * (covariance + covariance.T), float(eigenvalues[-1] / eigenvalues[0])


def _calibration(
    bundle: Bundle,
    corners: Corners,
    covariance: FloatArray,
    camera_name: str,
    rejected_count: int,
    held_out_rms_px: float | None,
    notes: dict[str, str],
) -> Calibration:
    rms_px = float(np.sqrt(_squared_length(bundle.residuals_px(corners)).mean()))
    return Calibration(
        bundle.lens,
        camera_name,
        covariance,
        rms_px,
        held_out_rms_px,
        corners.view_count,
        len(corners.px),
        rejected_count,
        notes,
    )


def _held_out(bundle: Bundle, corners: Corners) -> tuple[FloatArray, float | None]:
    """K-fold by picture: pose from every other corner, error on the rest: a free pose must not hide a bad lens."""
    count = corners.view_count
    folds = min(_FOLDS, count)
    if count - -(-count // folds) < MIN_VIEWS:
        return read_only([]), None
    fold_rms, squares = [], []
    for fold in range(folds):
        out = [i for i in range(count) if i % folds == fold]
        rest = [i for i in range(count) if i % folds != fold]
        fitted = adjust(Bundle(bundle.lens, bundle.R_cb[rest], bundle.t_cb[rest]), corners.only(rest))
        unseen = corners.only(out)
        posed = Bundle(fitted.lens, bundle.R_cb[out], bundle.t_cb[out])
        is_even = _alternating(unseen)
        errors = []
        for half in (is_even, ~is_even):
            refined = refine_poses(posed, unseen.kept(half))
            errors.append(_squared_length(refined.residuals_px(unseen.kept(~half))))
        together = np.concatenate(errors)
        fold_rms.append(float(np.sqrt(together.mean())))
        squares.append(together)
    return read_only(fold_rms), float(np.sqrt(np.concatenate(squares).mean()))


def _alternating(corners: Corners) -> NDArray[np.bool_]:
    """Every other corner of each view."""
    first = np.searchsorted(corners.view, np.arange(corners.view_count))
    result: NDArray[np.bool_] = (np.arange(len(corners.view)) - first[corners.view]) % 2 == 0
    return result


def _rejected(
    views: Sequence[BoardView], corners: Corners, keep: NDArray[np.bool_], residuals: FloatArray
) -> tuple[RejectedCorner, ...]:
    first = np.searchsorted(corners.view, np.arange(corners.view_count))
    found = [
        RejectedCorner(
            views[corners.view[i]].name,
            int(i - first[corners.view[i]]),
            float(corners.px[i, 0]),
            float(corners.px[i, 1]),
            float(np.linalg.norm(residuals[i])),
        )
        for i in np.flatnonzero(~keep)
    ]
    return tuple(sorted(found, key=lambda corner: -corner.residual_px))


def _covered_radius(lens: Lens, corners: Corners) -> float:
    centre = lens.parameters[2:4]
    edges = np.array([[u, v] for u in (-0.5, lens.width_px - 0.5) for v in (-0.5, lens.height_px - 0.5)])
    seen = float(np.linalg.norm(corners.px - centre, axis=1).max())
    return seen / float(np.linalg.norm(edges - centre, axis=1).max())


def _warnings(result: CalibrationResult) -> tuple[str, ...]:
    """What a metrologist would want to know before signing."""
    calibration = result.calibration
    lens, sigmas = calibration.lens, calibration.sigmas
    assert sigmas is not None
    said = []
    if calibration.view_count < _WISHED_VIEWS:
        said.append(f"only {calibration.view_count} views: take at least {_WISHED_VIEWS}, better 20")
    relative = float((sigmas[:2] / lens.parameters[:2]).max())
    if relative > 0.02:
        said.append(f"the focal length is only known to {100 * relative:.1f} %: tilt the board more, come closer")
    if result.max_tilt_rad < _WISHED_TILT_RAD:
        tilt = float(deg_from_rad(result.max_tilt_rad))
        said.append(f"no board is tilted by more than {tilt:.0f} deg: focal length and distance cannot be told apart")
    if result.covered_radius < 0.7:
        said.append(
            f"corners reach only {100 * result.covered_radius:.0f} % of the way to the picture's corner: "
            "beyond that the lens is a guess"
        )
    if result.condition > _MAX_CONDITION:
        said.append(
            f"the coefficients of {lens.model} cancel each other (condition {result.condition:.0e}): "
            "their values mean nothing one by one; prefer plumb_bob"
        )
    held_out, rms = calibration.held_out_rms_px, calibration.rms_px
    if held_out is not None and rms is not None and held_out > 1.5 * rms and held_out > 0.02:
        said.append(f"held-out error {held_out:.3f} px against {rms:.3f} px: the lens fits these pictures, not others")
    share = calibration.rejected_count / max(calibration.rejected_count + calibration.corner_count, 1)
    if share > 0.9 * _MAX_OUTLIER_SHARE:
        said.append(
            f"{100 * share:.0f} % of the corners were set aside, the most that is allowed: look at the pictures"
        )
    typical = float(np.median(result.view_rms_px))
    bad = [name for name, rms_px in zip(result.view_names, result.view_rms_px, strict=True) if rms_px > 3.0 * typical]
    if bad:
        said.append(f"much worse than the others: {', '.join(bad[:5])}")
    edges = [[u, v] for u in (0.0, lens.width_px - 1.0) for v in (0.0, lens.height_px - 1.0)]
    if not np.isfinite(lens.unproject(edges)).all():
        said.append("the fitted lens has no rays for the corners of the picture")
    return tuple(said)
