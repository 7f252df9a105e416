"""From found corners to a calibration with its doubt: outliers, covariance, held-out error, verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.boards import BoardMiss, BoardView
from uvgs_bench.camera.bundle import SHAPE_NAMES, Bundle, Corners, adjust
from uvgs_bench.camera.bundle_start import grown, is_at_rest, is_convincing, start
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.cross_validation import MIN_VIEWS, HeldOut, SplitHalf, held_out, split_half
from uvgs_bench.camera.image_circle import ImageCircle
from uvgs_bench.camera.lens import LENSES
from uvgs_bench.camera.lens_covariance import Doubt, doubt_of, prior_of
from uvgs_bench.camera.residual_structure import Coverage, ResidualStructure, coverage, residual_structure
from uvgs_bench.camera.view_trends import ViewTrends, view_trends
from uvgs_bench.errors import CalibrationError, TooFewViews
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.units import deg_from_rad

if TYPE_CHECKING:
    from uvgs_bench.camera.lens_choice import LensTrial

__all__ = ["MIN_VIEWS", "CalibrationResult", "Fit", "RejectedCorner", "calibrate", "fit"]

_WISHED_VIEWS = 8
_OUTLIER_SIGMAS = 4.0
_MAX_OUTLIER_SHARE = 0.1
_WISHED_TILT_RAD = 0.2
# Boards in parallel planes leave focal length and distance undetermined, however many there are.
_PARALLEL_RAD = 0.03
# Scaled condition number above which parameters only mean something together.
_MAX_CONDITION = 1e9
# Of corner finders: a start far off must not draw its coefficients to zero the harder for it.
_EXPECTED_NOISE_PX = 0.2


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
class Fit:
    """A lens fitted to views, before anybody judges it.

    Args:
        bundle: Lens and poses, fitted to the kept corners.
        whole: The same fitted to every corner.
        corners: Every corner.
        keep: Which corners were kept, shape (N,).
        prior: Weights that drew the parameters to zero, as in ``adjust``, or None.
        doubt: Covariances.
        is_at_rest: Whether the adjustment ended at a minimum; where not, all the rest describes no minimum.
    """

    bundle: Bundle
    whole: Bundle
    corners: Corners
    keep: NDArray[np.bool_]
    prior: FloatArray | None
    doubt: Doubt
    is_at_rest: bool

    @property
    def kept(self) -> Corners:
        """The kept corners."""
        return self.corners.kept(self.keep)


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
        view_noise_px: Standard deviation of a residual component in each view, shape (V,), px.
        view_held_out_px: Held-out RMS of each view, shape (V,), px; empty with too few views.
        split_half: Two halves against each other; None with too few views.
        structure: Shape of the residuals.
        coverage: Where the boards were.
        board_shape: Shape of the printed board by ``SHAPE_NAMES`` with deviations, shape (2, 3), when it was free.
        views: The views themselves, in the order of ``view_names``.
        lens_trials: The lenses that were compared before this one was chosen, added by whoever compared them.
        is_at_rest: As in ``Fit``.
        trends: What changed from picture to picture; None where nobody looked.
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
    misses: tuple[BoardMiss, ...]
    view_noise_px: FloatArray
    view_held_out_px: FloatArray
    split_half: SplitHalf | None
    structure: ResidualStructure
    coverage: Coverage
    board_shape: FloatArray | None
    views: tuple[BoardView, ...]
    lens_trials: tuple[LensTrial, ...] = ()
    is_at_rest: bool = True
    trends: ViewTrends | None = None


def fit(views: Sequence[BoardView], model: str, *, reject_outliers: bool = True, is_board_free: bool = False) -> Fit:
    """Fit a lens to board views by bundle adjustment.

    Args:
        views: Found corners, all from pictures of one size.
        model: Key of ``LENSES``.
        reject_outliers: Whether corners farther than four robust standard deviations are set aside, at most 10 %, and
            each picture's noise is judged on its own. Otherwise plain least squares with one noise for all, as other
            programs do.
        is_board_free: Whether the bow and the stretch of the printed board are estimated too.

    Returns:
        The fit.

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
    whole, prior = _started(corners, model, first.width_px, first.height_px)
    if is_board_free:
        whole = Bundle(whole.lens, whole.R_cb, whole.t_cb, np.zeros(len(SHAPE_NAMES)))
        prior = prior_of(whole.lens.parameter_names, _noise_px(whole, corners), len(SHAPE_NAMES))
        whole = adjust(whole, corners, prior)
    keep = np.ones(len(corners.px), dtype=np.bool_)
    bundle = whole
    if reject_outliers:
        bundle, keep = _without_outliers(whole, corners, prior)
    normals = bundle.R_cb[:, :, 2]
    if float(np.linalg.norm(np.cross(normals, normals[0]), axis=1).max()) < _PARALLEL_RAD:
        raise TooFewViews(f"all {len(views)} views show the board in the same attitude: tilt it in several directions")
    kept = corners.kept(keep)
    doubt = doubt_of(bundle, kept, prior, is_noise_equal=not reject_outliers)
    return Fit(bundle, whole, corners, keep, prior, doubt, is_at_rest(bundle, kept, prior))


def calibrate(
    views: Sequence[BoardView],
    model: str,
    *,
    camera_name: str = "",
    reject_outliers: bool = True,
    is_board_free: bool = False,
    notes: dict[str, str] | None = None,
    circle: ImageCircle | None = None,
) -> CalibrationResult:
    """Fit a lens to board views and doubt it: held-out error, halves against each other, structure, coverage, verdict.

    Args:
        views: Found corners, all from pictures of one size.
        model: Key of ``LENSES``.
        camera_name: For people.
        reject_outliers: As in ``fit``.
        is_board_free: As in ``fit``.
        notes: Provenance to keep with the calibration.
        circle: Where the lens draws its picture, when that does not fill the sensor; coverage is judged by it.

    Returns:
        The calibration with residuals, outliers, verdict and warnings.

    Raises:
        TooFewViews: Fewer than three views, or views too alike to tell the parameters apart.
        CalibrationError: Unknown model, pictures of different sizes, or boards no lens of the model can have seen.
    """
    from uvgs_bench.camera.verdict import judge_calibration

    fitted = fit(views, model, reject_outliers=reject_outliers, is_board_free=is_board_free)
    bundle, corners, kept = fitted.bundle, fitted.corners, fitted.kept
    unseen = held_out(bundle, kept, fitted.prior)
    covered = coverage(bundle, kept, circle)
    calibration = _calibration(fitted, unseen, camera_name, dict(notes or {}))
    everything = calibration
    if not fitted.keep.all():
        plain = doubt_of(fitted.whole, corners, fitted.prior)
        all_kept = replace(fitted, bundle=fitted.whole, keep=np.ones_like(fitted.keep), doubt=plain)
        everything = _calibration(all_kept, None, camera_name, {})
    halves = split_half(bundle, kept, fitted.prior, covered.share_radius_px)
    if halves is not None:
        calibration = replace(calibration, halves_ratio=halves.ratio)
    residuals = bundle.residuals_px(corners)
    seen_px = float(np.linalg.norm(kept.px - bundle.lens.parameters[2:4], axis=1).max())
    squares = kept.per_view(_squared_length(bundle.residuals_px(kept)))
    shape = None
    if bundle.shape is not None and fitted.doubt.shape_covariance is not None:
        shape = read_only(np.stack([bundle.shape, np.sqrt(np.diag(fitted.doubt.shape_covariance))]))
    result = CalibrationResult(
        calibration,
        everything,
        tuple(Pose(R, t, "camera", "board") for R, t in zip(bundle.R_cb, bundle.t_cb, strict=True)),
        tuple(read_only(part) for part in np.split(residuals, corners.bounds()[1:-1])),
        _rejected(views, corners, fitted.keep, residuals),
        tuple(view.name for view in views),
        read_only(np.sqrt(squares / kept.per_view(np.ones(len(kept.px))))),
        read_only([]) if unseen is None else unseen.fold_rms_px,
        fitted.doubt.condition,
        float(covered.tilts_rad.max()),
        seen_px / covered.picture_radius_px,
        (),
        (),
        read_only(fitted.doubt.view_noise_px),
        read_only([]) if unseen is None else unseen.view_rms_px,
        halves,
        residual_structure(bundle, kept),
        covered,
        shape,
        tuple(views),
        is_at_rest=fitted.is_at_rest,
        trends=view_trends(bundle, kept, fitted.doubt.view_noise_px),
    )
    result = replace(result, warnings=_warnings(result))
    return replace(result, calibration=replace(calibration, verdict=judge_calibration(result)))


def _started(corners: Corners, model: str, width_px: int, height_px: int) -> tuple[Bundle, FloatArray | None]:
    """First minimum, with the prior of lenses that need one, in units of the noise."""
    names = LENSES[model].parameter_names
    if prior_of(names, 1.0) is None:
        return start(model, corners, width_px, height_px), None
    best: Bundle | None = None
    for bundle in grown(model, corners, width_px, height_px):
        adjusted = adjust(bundle, corners, prior_of(names, min(_noise_px(bundle, corners), _EXPECTED_NOISE_PX)))
        if best is None or _noise_px(adjusted, corners) < _noise_px(best, corners):
            best = adjusted
        if is_convincing(best, corners):
            break
    assert best is not None
    # Once more with the noise of the lens itself.
    prior = prior_of(names, _noise_px(best, corners))
    return adjust(best, corners, prior), prior


def _noise_px(bundle: Bundle, corners: Corners) -> float:
    """Standard deviation of a residual component, outliers apart, px."""
    return max(1.4826 * float(np.median(np.abs(bundle.residuals_px(corners)))), 1e-12)


def _squared_length(residuals: FloatArray) -> FloatArray:
    result: FloatArray = np.einsum("ni,ni->n", residuals, residuals)
    return result


def _without_outliers(bundle: Bundle, corners: Corners, prior: FloatArray | None) -> tuple[Bundle, NDArray[np.bool_]]:
    """Set aside and adjust again until the set no longer changes."""
    keep = np.ones(len(corners.px), dtype=np.bool_)
    at_most = int(_MAX_OUTLIER_SHARE * len(corners.px))
    for _ in range(10):
        residuals = bundle.residuals_px(corners)
        # Median absolute deviations as standard deviations of a normal distribution. A blurred picture is judged by
        # its own noise: cut at that of the others, it would look as sharp as they are.
        sigma = 1.4826 * float(np.median(np.abs(residuals[keep])))
        own = [1.4826 * float(np.nanmedian(np.abs(residuals[a:b]))) for a, b in pairwise(corners.bounds())]
        worst = np.nan_to_num(np.abs(residuals).max(axis=1), nan=np.inf)
        worst = worst / np.maximum(np.maximum(sigma, own), 1e-9)[corners.view]
        limit = _OUTLIER_SIGMAS
        if at_most < int((worst > limit).sum()):
            limit = float(np.sort(worst)[-at_most - 1])
        new = worst <= limit
        # A view that lost most of its corners keeps them: it is the pose that is wrong, and its RMS will say so.
        lost = corners.per_view((~new).astype(np.float64)) > 0.5 * corners.per_view(np.ones(len(new)))
        new |= lost[corners.view]
        if (new == keep).all():
            break
        keep = new
        bundle = adjust(bundle, corners.kept(keep), prior)
    return bundle, keep


def _calibration(fitted: Fit, unseen: HeldOut | None, camera_name: str, notes: dict[str, str]) -> Calibration:
    kept = fitted.kept
    return Calibration(
        fitted.bundle.lens,
        camera_name,
        fitted.doubt.covariance,
        float(np.sqrt(_squared_length(fitted.bundle.residuals_px(kept)).mean())),
        None if unseen is None else unseen.rms_px,
        kept.view_count,
        len(kept.px),
        int((~fitted.keep).sum()),
        notes,
        fitted.doubt.joint,
    )


def _rejected(
    views: Sequence[BoardView], corners: Corners, keep: NDArray[np.bool_], residuals: FloatArray
) -> tuple[RejectedCorner, ...]:
    first = corners.bounds()[:-1]
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
    if result.coverage.is_lit.all() and not np.isfinite(lens.unproject(edges)).all():
        said.append("the fitted lens has no rays for the corners of the picture")
    return tuple(said)
