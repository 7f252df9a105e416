"""Whether an existing calibration still describes its camera, judged on new views of a board.

The lens is held as it is in the file and only the poses are fitted, each from half of its corners and scored on the
other half. Then focal lengths and principal point are set free, the other coefficients held: how far they move, and
how far they may move by chance, says what has changed. The chance counts the noise of the new corners (or, where that
is larger, how much the views disagree among themselves) and the covariance of the file.

Rules: a quantity is ``ok`` when its 95 % interval lies within its limit, ``degraded`` when it lies outside, and
``inconclusive`` when it reaches across. One degraded quantity is enough; one inconclusive stops an OK.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from uvgs_bench.camera.boards import BoardView
from uvgs_bench.camera.bundle import Bundle, Corners, refine_poses
from uvgs_bench.camera.bundle_start import planar_poses
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.difference import LensDifference, difference
from uvgs_bench.errors import CalibrationError, TooFewViews
from uvgs_bench.geometry import FloatArray

Word = Literal["ok", "degraded", "inconclusive"]
MIN_VIEWS = 3
_FREE = 4
_BOOTSTRAPS = 2000
_OUTLIER_SIGMAS = 4.0
_MAX_OUTLIER_SHARE = 0.1


@dataclass(frozen=True, slots=True)
class ValidityLimits:
    """How much may have changed.

    Args:
        residual_ratio: Held-out residual on the new views over that of the file.
        focal_shift_percent: Change of the focal length; as much as the change of every measured distance.
        centre_shift_px: Change of the principal point along either axis, px.
    """

    residual_ratio: float = 1.5
    focal_shift_percent: float = 0.5
    centre_shift_px: float = 5.0


@dataclass(frozen=True, slots=True)
class ValidityFigure:
    """One judged quantity.

    Args:
        name: What it is.
        value: Estimate, in ``unit``.
        low: Lower end of the 95 % interval.
        high: Upper end.
        limit: Largest allowed size.
        unit: Its unit.
        verdict: ``ok``, ``degraded`` or ``inconclusive``.
    """

    name: str
    value: float
    low: float
    high: float
    limit: float
    unit: str
    verdict: Word


@dataclass(frozen=True, slots=True, eq=False)
class Validity:
    """The answer with its numbers.

    Args:
        verdict: The worst of all figures.
        figures: What was judged.
        held_out_rms_px: Held-out RMS of the residual lengths on the new views with the lens of the file, px.
        file_rms_px: The same figure of the file (its RMS where it has no held-out one), px; None when unknown.
        view_rms_px: Held-out RMS of each new view, shape (V,), px.
        view_names: Names of the views.
        corner_count: Corners used.
        rejected_count: Corners set aside as outliers.
        moved: The lens with focal lengths and centre of the new views, against that of the file.
        reasons: Sentences for people.
    """

    verdict: Word
    figures: tuple[ValidityFigure, ...]
    held_out_rms_px: float
    file_rms_px: float | None
    view_rms_px: FloatArray
    view_names: tuple[str, ...]
    corner_count: int
    rejected_count: int
    moved: LensDifference
    reasons: tuple[str, ...]


def check_validity(
    calibration: Calibration,
    views: Sequence[BoardView],
    rng: np.random.Generator,
    limits: ValidityLimits | None = None,
) -> Validity:
    """Judge a calibration on new views.

    Args:
        calibration: The calibration as it is in the file.
        views: Board views it was not fitted to.
        rng: For the intervals over the views.
        limits: How much may have changed; the defaults of ``ValidityLimits`` when None.

    Returns:
        Verdict, figures and reasons.

    Raises:
        CalibrationError: The pictures have another size than the calibration.
        TooFewViews: Fewer than three views, or views whose boards the lens cannot see.
    """
    limits = limits or ValidityLimits()
    if len(views) < MIN_VIEWS:
        raise TooFewViews(f"{len(views)} usable views of the board, need at least {MIN_VIEWS}")
    for view in views:
        calibration.check_size(view.width_px, view.height_px, view.name or "a picture")
    corners = Corners.of(views)
    try:
        bundle = refine_poses(planar_poses(calibration.lens, corners), corners)
    except (CalibrationError, np.linalg.LinAlgError) as error:
        raise TooFewViews(f"the lens of the file cannot see these boards: {error}") from None
    if not np.isfinite(bundle.residuals_px(corners)).all():
        raise TooFewViews("corners of these boards lie where the lens of the file has no rays")
    keep = _inliers(bundle, corners)
    kept = corners.kept(keep)
    bundle = refine_poses(bundle, kept)
    squares, counts = _held_out(bundle, kept)
    new_rms = float(np.sqrt(squares.sum() / counts.sum()))
    file_rms = calibration.held_out_rms_px if calibration.held_out_rms_px is not None else calibration.rms_px
    figures, reasons = [], []
    if file_rms:
        draws = rng.integers(0, len(views), (_BOOTSTRAPS, len(views)))
        ratios = np.sqrt(squares[draws].sum(axis=1) / counts[draws].sum(axis=1)) / file_rms
        low, high = np.quantile(ratios, [0.025, 0.975])
        # Better than the file is never a fault: only the upper side is judged.
        word: Word = "ok" if high <= limits.residual_ratio else "inconclusive"
        word = "degraded" if low > limits.residual_ratio else word
        figures.append(
            ValidityFigure(
                "residual ratio", new_rms / file_rms, float(low), float(high), limits.residual_ratio, "", word
            )
        )
    else:
        reasons.append("the file does not say its residual, so the new one cannot be compared")
    if calibration.covariance is None:
        reasons.append("the file does not say its covariance: its numbers are taken as exact")
    moved, shift, covariance = _freed(calibration, bundle, kept)
    figures += _shifts(calibration, shift, covariance, len(views), limits)
    for figure in figures:
        if figure.verdict != "ok":
            said = "is beyond" if figure.verdict == "degraded" else "may or may not be beyond"
            reasons.append(
                f"{figure.name} {figure.value:.3g}{figure.unit} (95 %: {figure.low:.3g} to {figure.high:.3g}) "
                f"{said} {figure.limit:g}{figure.unit}"
            )
    words = {figure.verdict for figure in figures}
    verdict: Word = "degraded" if "degraded" in words else "inconclusive" if "inconclusive" in words else "ok"
    if verdict == "inconclusive":
        reasons.append("take more views, tilted up to 40 degrees and reaching into the corners of the picture")
    return Validity(
        verdict,
        tuple(figures),
        new_rms,
        file_rms,
        np.sqrt(squares / counts),
        tuple(view.name for view in views),
        len(kept.px),
        int((~keep).sum()),
        difference(Calibration(calibration.lens), Calibration(moved.lens)),
        tuple(reasons),
    )


def _inliers(bundle: Bundle, corners: Corners) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """As when calibrating: corners farther than four robust deviations, at most a tenth, never half of a view."""
    residuals = bundle.residuals_px(corners)
    worst = np.abs(residuals).max(axis=1)
    limit = max(_OUTLIER_SIGMAS * 1.4826 * float(np.median(np.abs(residuals))), 1e-9)
    at_most = int(_MAX_OUTLIER_SHARE * len(worst))
    limit = max(limit, float(np.sort(worst)[-at_most - 1]))
    keep: np.ndarray[tuple[int], np.dtype[np.bool_]] = worst <= limit
    lost = corners.per_view((~keep).astype(np.float64)) > 0.5 * corners.per_view(np.ones(len(keep)))
    keep |= lost[corners.view]
    return keep


def _held_out(bundle: Bundle, corners: Corners) -> tuple[FloatArray, FloatArray]:
    """Squared errors and numbers of corners of each view, each half scored under the pose of the other."""
    first = np.searchsorted(corners.view, np.arange(corners.view_count))
    is_even = (np.arange(len(corners.view)) - first[corners.view]) % 2 == 0
    squares = np.zeros(corners.view_count)
    for half in (is_even, ~is_even):
        refined = refine_poses(bundle, corners.kept(half))
        scored = corners.kept(~half)
        squares += scored.per_view((refined.residuals_px(scored) ** 2).sum(axis=1))
    return squares, corners.per_view(np.ones(len(corners.px)))


def _reduced(bundle: Bundle, corners: Corners) -> tuple[FloatArray, FloatArray]:
    """Normal equations of the lens with the poses eliminated: gradient of each view (V, P), information (P, P)."""
    points = bundle.points_in_camera(corners)
    px, by_point, by_lens = bundle.lens.project_with_jacobians(points)
    e = corners.px - px
    by_pose = np.concatenate([np.cross(points[:, None, :], by_point), by_point], axis=2)
    poses = corners.per_view(by_pose.swapaxes(1, 2) @ by_pose)
    mixed = corners.per_view(by_pose.swapaxes(1, 2) @ by_lens)
    eliminated = np.linalg.solve(poses, mixed)
    g_pose = corners.per_view(np.einsum("nij,ni->nj", by_pose, e))
    g_lens = corners.per_view(np.einsum("nij,ni->nj", by_lens, e))
    S = corners.per_view(by_lens.swapaxes(1, 2) @ by_lens) - mixed.swapaxes(1, 2) @ eliminated
    return g_lens - np.einsum("vij,vi->vj", eliminated, g_pose), S.sum(axis=0)


def _freed(calibration: Calibration, bundle: Bundle, corners: Corners) -> tuple[Bundle, FloatArray, FloatArray]:
    """Fit fx, fy, cx, cy and the poses; their shift from the file and its covariance, the file's own included."""
    start = bundle.lens.parameters
    for _ in range(20):
        scores, information = _reduced(bundle, corners)
        step = np.zeros(start.size)
        try:
            step[:_FREE] = np.linalg.solve(information[:_FREE, :_FREE], scores.sum(axis=0)[:_FREE])
            lens = bundle.lens.with_parameters(bundle.lens.parameters + step)
        except (CalibrationError, np.linalg.LinAlgError):
            raise TooFewViews("the new views do not determine focal length and centre: tilt the board") from None
        bundle = refine_poses(Bundle(lens, bundle.R_cb, bundle.t_cb), corners)
        if float(np.abs(step).max()) < 1e-6:
            break
    scores, information = _reduced(bundle, corners)
    H = information[:_FREE, :_FREE]
    if not np.isfinite(H).all() or np.linalg.cond(H) > 1e12:
        raise TooFewViews("the new views do not determine focal length and centre: tilt the board")
    residuals = bundle.residuals_px(corners)
    variance = float((residuals**2).sum()) / max(residuals.size - _FREE - 6 * corners.view_count, 1)
    inverse = np.linalg.inv(H)
    formal = variance * inverse
    scores = scores[:, :_FREE]
    # Views that disagree among themselves by more than the noise of their corners say more than the corners do.
    views = corners.view_count
    between = inverse @ (scores.T @ scores) @ inverse * views / (views - 1.0)
    inflation = np.sqrt(np.maximum(1.0, np.diag(between) / np.diag(formal)))
    covariance = inflation[:, None] * formal * inflation
    if calibration.covariance is not None:
        # Errors of the held coefficients move what is free, too.
        G = np.column_stack([np.eye(_FREE), inverse @ information[:_FREE, _FREE:]])
        covariance = covariance + G @ calibration.covariance @ G.T
    return bundle, bundle.lens.parameters[:_FREE] - start[:_FREE], covariance


def _shifts(
    calibration: Calibration, shift: FloatArray, covariance: FloatArray, views: int, limits: ValidityLimits
) -> list[ValidityFigure]:
    from scipy.special import stdtrit

    fx, fy = calibration.lens.fx_px, calibration.lens.fy_px
    rows = {
        ("focal length", " %", limits.focal_shift_percent): np.array([50.0 / fx, 50.0 / fy, 0.0, 0.0]),
        ("centre, column", " px", limits.centre_shift_px): np.array([0.0, 0.0, 1.0, 0.0]),
        ("centre, row", " px", limits.centre_shift_px): np.array([0.0, 0.0, 0.0, 1.0]),
    }
    factor = float(stdtrit(max(views - 1, 1), 0.975))
    figures = []
    for (name, unit, limit), row in rows.items():
        value, half = float(row @ shift), factor * float(np.sqrt(row @ covariance @ row))
        low, high = value - half, value + half
        word: Word = "inconclusive"
        if -limit <= low and high <= limit:
            word = "ok"
        elif low > limit or high < -limit:
            word = "degraded"
        figures.append(ValidityFigure(name, value, low, high, limit, unit, word))
    return figures
