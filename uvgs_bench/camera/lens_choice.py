"""Which lens a camera needs: all of them fitted to the same corners, compared on pictures they have not seen.

The lens with the fewest coefficients wins whose held-out error is not clearly worse than the best one's. More
coefficients always fit better what they saw; only unseen pictures tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np

from uvgs_bench.camera.boards import BoardView
from uvgs_bench.camera.cross_validation import held_out
from uvgs_bench.camera.fitting import fit
from uvgs_bench.camera.lens import LENSES
from uvgs_bench.errors import CalibrationError, TooFewViews
from uvgs_bench.geometry import FloatArray, read_only

# A lens is clearly worse when its error exceeds the best one's by two standard errors of their ratio over the pictures,
# and by a share that somebody would miss.
_STANDARD_ERRORS = 2.0
_LEAST_SHARE = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class LensTrial:
    """One lens on the common pictures.

    Args:
        model: Key of ``LENSES``.
        rms_px: RMS of the residual lengths of the kept corners, px.
        held_out_rms_px: The same for pictures not fitted, px; infinite when they could not be seen.
        view_held_out_px: The same for each picture, shape (V,), px.
        remark: What speaks against the lens, or empty.
    """

    model: str
    rms_px: float
    held_out_rms_px: float
    view_held_out_px: FloatArray
    remark: str


@dataclass(frozen=True, slots=True, eq=False)
class LensChoice:
    """The comparison.

    Args:
        model: The lens to use.
        trials: All lenses, fewest coefficients first.
    """

    model: str
    trials: tuple[LensTrial, ...]


def choose_lens(views: Sequence[BoardView], models: Sequence[str] = tuple(LENSES)) -> LensChoice:
    """Compare lenses on held-out views.

    Args:
        views: Found corners, all from pictures of one size.
        models: Keys of ``LENSES``.

    Returns:
        The choice with what speaks against the others.

    Raises:
        TooFewViews: Too few views to hold any out.
        CalibrationError: No lens fits.
    """
    found = []
    failed: CalibrationError | None = None
    for model in sorted(models, key=lambda name: len(LENSES[name].parameter_names)):
        try:
            # Every corner: each lens would set aside what it describes worst.
            fitted = fit(views, model, reject_outliers=False)
        except CalibrationError as error:
            failed = error
            continue
        if not fitted.is_at_rest:
            failed = CalibrationError(f"the adjustment of a {model} lens did not come to rest")
            continue
        unseen = held_out(fitted.bundle, fitted.kept, fitted.prior)
        if unseen is None:
            raise TooFewViews(f"{len(views)} views are too few to compare lenses on unseen pictures")
        rms = float(np.sqrt(2.0 * (fitted.bundle.residuals_px(fitted.kept) ** 2).mean()))
        found.append(LensTrial(model, rms, unseen.rms_px, unseen.view_rms_px, ""))
    if not found:
        raise failed or CalibrationError("no lens to compare")
    best = min(found, key=lambda trial: trial.held_out_rms_px)
    chosen = next(trial for trial in found if not _is_worse(trial, best))
    return LensChoice(chosen.model, tuple(_remarked(trial, chosen) for trial in found))


def _is_worse(trial: LensTrial, than: LensTrial) -> bool:
    if not np.isfinite(trial.held_out_rms_px):
        return bool(np.isfinite(than.held_out_rms_px))
    if trial.held_out_rms_px <= (1.0 + _LEAST_SHARE) * than.held_out_rms_px:
        return False
    # Logarithms keep one bad picture from deciding alone.
    ratio = np.log(np.maximum(trial.view_held_out_px, 1e-9) / np.maximum(than.view_held_out_px, 1e-9))
    return bool(ratio.mean() > _STANDARD_ERRORS * ratio.std(ddof=1) / np.sqrt(len(ratio)))


def _remarked(trial: LensTrial, chosen: LensTrial) -> LensTrial:
    remark = ""
    if trial.model != chosen.model and _is_worse(trial, chosen):
        unseen = trial.held_out_rms_px
        error = f"{unseen:.3f} px" if unseen < inf else "some not even visible"
        if trial.rms_px > chosen.rms_px:
            remark = f"{trial.model} is not enough: unseen pictures {error} against {chosen.held_out_rms_px:.3f} px"
        else:
            remark = (
                f"{trial.model} over-fits: {trial.rms_px:.3f} px on its own pictures against {chosen.rms_px:.3f} px, "
                f"unseen {error} against {chosen.held_out_rms_px:.3f} px"
            )
    return LensTrial(trial.model, trial.rms_px, trial.held_out_rms_px, read_only(trial.view_held_out_px), remark)
