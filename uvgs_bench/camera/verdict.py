"""Whether a calibration may be used, by stated rules, and which pictures to take next.

The rules hold for every camera; none is tuned to a set of pictures. The error that counts at a pixel is

    total = sqrt((doubt * sigma)^2 + systematic^2)

with ``sigma`` the projection uncertainty at infinity along its worst direction, ``doubt`` how many times more two
halves of the pictures disagree than they predict (at least 1), and ``systematic`` the part of the residuals that
neighbouring corners share. A picture is usable where the total stays below ``LIMIT_PX`` and boards were seen.
"""

from __future__ import annotations

import numpy as np

from uvgs_bench.camera.calibration import Verdict
from uvgs_bench.camera.fitting import MIN_VIEWS, CalibrationResult
from uvgs_bench.camera.lens import Lens
from uvgs_bench.camera.projection_uncertainty import picture_grid, projection_uncertainty, worst_sigma
from uvgs_bench.camera.residual_structure import Coverage, cell_centres_px
from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import deg_from_rad, rad_from_deg

LIMIT_PX = 0.5
"""Largest total error, px: ten times the noise of an LED's centre, and the same in every picture, so that no averaging
helps."""

WHOLE_SHARE = 0.9
"""Share of the picture's radius that makes it usable as a whole: the rest are the tips of its corners, 5 % of it."""

LEAST_SHARE = 0.4
"""Share of the picture's radius below which a beacon has no room to move in: not usable."""

MAX_FOCAL_SIGMA = 0.005
"""Largest relative deviation of the focal length: distance errs by the same share, 10 mm at 2 m."""

MAX_HALVES_RATIO = 4.0
"""Two halves of honest pictures disagree as predicted, ratio 1; ordinary real sets reach 2 to 4. Beyond, whatever the
deviations say is too far from the truth to be mended by a factor."""

WARN_HALVES_RATIO = 2.0
"""Ratio from which the deviations are called too small."""

MAX_HELD_OUT_RATIO = 1.5
"""Largest held-out error over the RMS of the fit. Poses from half of 24 corners cost 1.2; beyond 1.5 the lens follows
the noise of its own pictures."""

MAX_FOCAL_DRIFT = 0.005
"""Largest change of the focal length from the first picture to the last, relative, if it stands out by
``DRIFT_SIGMAS``: the focus moved, and no one lens describes all pictures."""

DRIFT_SIGMAS = 4.0
"""Deviations from which a drift is no chance."""

MIN_TILT_RAD = 0.2
"""Tilt, rad, one board at least must exceed: under less, focal length and distance cannot be told apart."""

NOISE_FLOOR_PX = 0.02
"""Held-out errors below need no ratio: no corner finder is better."""

_GRID = (25, 19)
WISHED_VIEWS = 20
"""Number of views wished for."""
_WISHED_TILT_RAD = rad_from_deg(30.0)
_WISHED_TILTED = 4
WISHED_REACH = 1.5
"""Farthest distance of a board over the nearest one, wished for."""


def total_error_px(result: CalibrationResult, px: FloatArray) -> FloatArray:
    """The error the verdict looks at.

    Args:
        result: A calibration with its examination.
        px: Pixels, shape (N, 2), px.

    Returns:
        One-sigma error along the worst direction, shape (N,), px; NaN where the lens has no ray.
    """
    sigma = worst_sigma(projection_uncertainty(result.calibration, px))
    total: FloatArray = np.hypot(doubt_factor(result) * sigma, result.structure.systematic_px)
    return total


def judge_calibration(result: CalibrationResult) -> Verdict:
    """Apply the rules.

    Args:
        result: A calibration with its examination.

    Returns:
        The verdict; ``inconclusive`` when there are too few views to hold halves against each other.
    """
    lens = result.calibration.lens
    good_px = good_radius_px(result)
    covered_px, whole_px = result.coverage.radius_px, result.coverage.picture_radius_px
    radius_px = min(good_px, covered_px)
    refused = _refusals(result)
    wishes = next_pictures(lens, result.coverage, result.calibration.view_count)
    edge = "corner" if result.coverage.is_lit.all() else "image circle's edge"
    short = result.coverage.short_sides
    towards = f" towards the {short[0]}" if short else ""
    if radius_px < LEAST_SHARE * whole_px:
        what = (
            f"the error stays below {LIMIT_PX} px only within {good_px:.0f} px of the principal point"
            if good_px <= covered_px
            else f"boards covered the picture only within {covered_px:.0f} px of the principal point{towards}"
        )
        refused.append(f"{what}, less than {100 * LEAST_SHARE:.0f} % of the {whole_px:.0f} px to its {edge}")
    if result.split_half is None and result.calibration.view_count < 2 * MIN_VIEWS:
        few = f"{result.calibration.view_count} views are too few to hold one half against the other"
        return Verdict("inconclusive", 0.0, (few, *refused, *_remarks(result)), wishes)
    if result.split_half is None:
        alone = "halves of the pictures cannot be calibrated by themselves: nothing holds the deviations to account"
        word = "not_usable" if refused else "inconclusive"
        return Verdict(word, 0.0, (*refused, alone, *_remarks(result)), wishes)
    if refused:
        return Verdict("not_usable", 0.0, (*refused, *_remarks(result)), wishes)
    worst = float(np.nanmax(total_error_px(result, _within(result, radius_px))))
    if radius_px >= WHOLE_SHARE * whole_px:
        reason = f"total error at most {worst:.2f} px, limit {LIMIT_PX} px, over {lens.width_px}x{lens.height_px} px"
        return Verdict("usable", radius_px, (reason, *_remarks(result)), wishes)
    bound = (
        f"boards were seen no farther out{towards}"
        if covered_px < good_px
        else f"beyond, the error exceeds {LIMIT_PX} px"
    )
    reason = f"total error at most {worst:.2f} px within {radius_px:.0f} px of the principal point; {bound}"
    return Verdict("usable_within_radius", radius_px, (reason, *_remarks(result)), wishes)


def doubt_factor(result: CalibrationResult) -> float:
    """How many times the deviations are too small by the evidence of two halves, at least 1."""
    return result.calibration.doubt_factor


def good_radius_px(result: CalibrationResult) -> float:
    """Radius about the principal point within which no pixel's total error exceeds the limit, px."""
    px = picture_grid(result.calibration.lens, *_GRID)
    radius = np.linalg.norm(px - result.calibration.lens.parameters[2:4], axis=1)
    bad = ~(total_error_px(result, px) <= LIMIT_PX)
    return float(radius[bad].min()) if bad.any() else result.coverage.picture_radius_px


def _within(result: CalibrationResult, radius_px: float) -> FloatArray:
    px = picture_grid(result.calibration.lens, *_GRID)
    near = np.linalg.norm(px - result.calibration.lens.parameters[2:4], axis=1) < radius_px
    chosen: FloatArray = px[near] if near.any() else px[:1]
    return chosen


def _refusals(result: CalibrationResult) -> list[str]:
    calibration, structure, halves = result.calibration, result.structure, result.split_half
    assert calibration.sigmas is not None
    assert calibration.rms_px is not None
    said = []
    if not result.is_at_rest:
        said.append(
            f"the adjustment did not come to rest: a {calibration.lens.model} lens does not reach as far as these "
            "boards were seen, or the pictures do not determine it; none of the numbers is a minimum"
        )
    if structure.systematic_px > LIMIT_PX:
        said.append(
            f"the {calibration.lens.model} lens does not describe this camera: neighbouring residuals share "
            f"{structure.systematic_px:.2f} px (correlation {structure.neighbour_correlation:.2f})"
        )
    held_out = calibration.held_out_rms_px
    if held_out is not None and held_out > max(MAX_HELD_OUT_RATIO * calibration.rms_px, NOISE_FLOOR_PX):
        if np.isfinite(held_out):
            said.append(
                f"unseen pictures err by {held_out:.2f} px against {calibration.rms_px:.2f} px for the fitted ones: "
                f"the lens follows the noise of its pictures (limit {MAX_HELD_OUT_RATIO} times)"
            )
        else:
            said.append("lenses fitted without some pictures cannot see all corners of those pictures")
    relative = float((calibration.sigmas[:2] / calibration.lens.parameters[:2]).max()) * doubt_factor(result)
    if relative > MAX_FOCAL_SIGMA:
        said.append(
            f"the focal length is only known to {100 * relative:.1f} % (limit {100 * MAX_FOCAL_SIGMA:.1f} %), "
            "and every distance errs by as much"
        )
    drift = _drift(result)
    if drift and abs(drift[0]) > MAX_FOCAL_DRIFT:
        said.append(
            f"the focal length changes by {100 * drift[0]:+.2f} ± {100 * drift[1]:.2f} % from the first picture to the "
            "last: the focus moved, switch autofocus off and take all pictures again"
        )
    if result.max_tilt_rad < MIN_TILT_RAD:
        tilt, least = float(deg_from_rad(result.max_tilt_rad)), float(deg_from_rad(MIN_TILT_RAD))
        said.append(f"no board is tilted by more than {tilt:.0f} deg, at least one must exceed {least:.0f} deg")
    if halves is not None and halves.ratio > MAX_HALVES_RATIO:
        said.append(
            f"two halves of the pictures disagree {halves.ratio:.1f} times more than their deviations allow "
            f"({halves.difference_px:.2f} px, limit {MAX_HALVES_RATIO:.0f} times)"
        )
    return said


def _remarks(result: CalibrationResult) -> list[str]:
    """What does not decide but must be known."""
    said = []
    lens = result.calibration.lens
    if "k6" in lens.parameter_names:
        said.append(
            f"the coefficients of a {lens.model} lens are drawn to zero by a prior, so their intervals one by one were "
            "not shown to cover the truth as those of plumb_bob, equidistant and fov were: trust maps, not coefficients"
        )
    drift = _drift(result)
    if drift and abs(drift[0]) <= MAX_FOCAL_DRIFT:
        said.append(
            f"the focal length drifts by {100 * drift[0]:+.2f} ± {100 * drift[1]:.2f} % from the first picture to the "
            "last: focus or temperature"
        )
    streaks = () if result.trends is None else result.trends.streaks
    if streaks:
        worst = streaks[0]
        names = ", ".join(result.view_names[streak.view] for streak in streaks[:3])
        more = f" and {len(streaks) - 3} more" if len(streaks) > 3 else ""
        said.append(
            f"residuals of {names}{more} lie along one direction ({worst.ratio:.1f} times, at "
            f"{float(deg_from_rad(worst.direction_rad)):.0f} deg in {result.view_names[worst.view]}): board or camera "
            "moved during the exposure, or rolling shutter"
        )
    halves = result.split_half
    if halves is not None and WARN_HALVES_RATIO < halves.ratio <= MAX_HALVES_RATIO:
        said.append(
            f"two halves of the pictures disagree {halves.ratio:.1f} times more than their deviations say: the "
            "deviations are too small by about that factor, and the total error counts it"
        )
    if result.structure.neighbour_correlation > 0.3 and result.structure.systematic_px <= LIMIT_PX:
        said.append(
            f"neighbouring residuals share {result.structure.systematic_px:.2f} px (correlation "
            f"{result.structure.neighbour_correlation:.2f}): board not flat, blur, or lens model"
        )
    said.append("the size of the squares was not tested: no camera sees it, and the lens does not depend on it, but "
                "every pose of this board does")  # fmt: skip
    return said


def _drift(result: CalibrationResult) -> tuple[float, float] | None:
    """Relative drift of the focal length with its deviation, when it stands out."""
    trends = result.trends
    if trends is None or abs(trends.drift) <= DRIFT_SIGMAS * trends.drift_sigma:
        return None
    return trends.drift, trends.drift_sigma


def next_pictures(lens: Lens, covered: Coverage, view_count: int) -> tuple[str, ...]:
    """What to photograph next: what limits the result first.

    Args:
        lens: The lens so far.
        covered: Where the boards were.
        view_count: Number of views.

    Returns:
        Sentences for people; empty when nothing is missing.
    """
    said = []
    tilted = int((covered.tilts_rad > _WISHED_TILT_RAD).sum())
    if tilted < _WISHED_TILTED:
        wish = _WISHED_TILTED - tilted
        said.append(f"{wish} more with the board tilted by 30 to 45 deg, each about another axis")
    if covered.radius_px < WHOLE_SHARE * covered.picture_radius_px:
        empty = (covered.counts.ravel() == 0) & covered.is_lit.ravel()
        if empty.any():
            place = cell_centres_px(lens)[empty] / [lens.width_px, lens.height_px]
            words = [_place(u, v) for u, v in place]
            ranked = sorted(set(words) - set(covered.short_sides), key=lambda word: (-words.count(word), word))
            said.append(f"the board filling the {', '.join([*covered.short_sides, *ranked][:3])} of the picture")
    if float(covered.distances_m.max()) < WISHED_REACH * float(covered.distances_m.min()):
        near = 0.5 * float(np.median(covered.distances_m))
        said.append(f"some closer, about {near:.2f} m away: all boards were at nearly one distance")
    if view_count < WISHED_VIEWS:
        said.append(f"{WISHED_VIEWS - view_count} more in all, to make {WISHED_VIEWS}")
    return tuple(said)


def _place(u: float, v: float) -> str:
    column = ("left", "middle", "right")[min(int(3 * u), 2)]
    row = ("top", "middle", "bottom")[min(int(3 * v), 2)]
    if row == "middle":
        return "middle" if column == "middle" else f"{column} edge"
    return f"{row} edge" if column == "middle" else f"{row} {column} corner"
