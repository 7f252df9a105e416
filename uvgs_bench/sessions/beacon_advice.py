"""Advice about a beacon geometry: the map of what it can do with a camera, and its weakest places in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.beacon import Beacon
from uvgs_bench.beacon.accuracy_map import AccuracyMap, Gain, accuracy_map, gains
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.lens import Lens
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import deg_from_rad, m_from_mm, mm_from_m, rad_from_deg

STEP_M = m_from_mm(10.0)
"""By how much single LEDs are moved to see what it would bring, m."""

# Labels whose rival fits worse than this many centroid deviations are told apart.
SAFE_DEVIATIONS = 4.0
# A solver told that centroids are this poor takes the best start of the widest triangle for wrong labels, too, instead
# of trying all. Only the nearest of 23 wrong labels counts: over the maps of the example beacon it was found to 1e-4.
_SEARCH_SIGMA_PX, _SEARCH_STEPS = 30.0, 30
_TILTS = 7
_AZIMUTHS = 12
# Spots nearer than their width merge; the point spread adds some three pixels to the LED itself.
_SPREAD_PX = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class BeaconAdvice:
    """What a beacon can do with a camera.

    Args:
        map: The map.
        gains: What moving one LED would bring at the middle range, best first.
        sigma_px: Deviation of a centroid it was computed for, px.
        lines: The weakest places, for people.
        is_safe: Whether labels are told apart everywhere and no LEDs merge.
    """

    map: AccuracyMap
    gains: tuple[Gain, ...]
    sigma_px: float
    lines: tuple[str, ...]
    is_safe: bool


def advise(
    beacon: Beacon, calibration: Calibration, *, ranges_m: FloatArray, tilt_rad: float, sigma_px: float
) -> BeaconAdvice:
    """Forecast a beacon before it is built or trusted.

    Args:
        beacon: The beacon.
        calibration: The camera.
        ranges_m: Ranges, rising, shape (K,), m.
        tilt_rad: Widest tilt, rad.
        sigma_px: Deviation of a centroid per axis, px.

    Returns:
        The advice.

    Raises:
        ConfigError: At no range and view are four LEDs seen.
    """
    lens = calibration.lens

    def fit(points_m: FloatArray, px: FloatArray) -> FloatArray:
        from uvgs_bench.sensor.batch import solve_batch

        loose = np.full(len(points_m), _SEARCH_SIGMA_PX)
        return solve_batch(lens, points_m, px, loose, max_iterations=_SEARCH_STEPS).chi2 * _SEARCH_SIGMA_PX**2

    tilts: FloatArray = np.linspace(0.0, tilt_rad, _TILTS, dtype=np.float64)
    azimuths: FloatArray = np.arange(_AZIMUTHS, dtype=np.float64) * (2.0 * np.pi / _AZIMUTHS)
    found = accuracy_map(beacon, lens, fit, sigma_px, ranges_m, tilts, azimuths)
    if np.isnan(found.position_sigma_m).all():
        raise ConfigError("at none of these ranges and views are four LEDs in the picture", beacon.name, "leds")
    usable = [k for k in range(len(ranges_m)) if np.isfinite(found.margin_px[k]).any()]
    middle = usable[len(usable) // 2]
    moves = gains(beacon, lens, fit, sigma_px, found, middle, STEP_M)
    lines, is_safe = _lines(found, lens, sigma_px)
    best = moves[0] if moves else None
    if best is not None and best.attitude_ratio < 0.95:
        lines.append(
            f"moving {best.led} by {mm_from_m(STEP_M):.0f} mm along {best.direction} would change the attitude "
            f"deviation at {ranges_m[middle]:.2f} m by {best.attitude_ratio - 1.0:+.0%}, position "
            f"{best.position_ratio - 1.0:+.0%}, least margin to {best.margin_px:.2f} px"
        )
    return BeaconAdvice(found, moves, sigma_px, tuple(lines), is_safe)


def _lines(found: AccuracyMap, lens: Lens, sigma_px: float) -> tuple[list[str], bool]:
    out = []

    def where(values: FloatArray, worst: int) -> str:
        k, i, j = np.unravel_index(worst, values.shape)
        return (
            f"at {found.range_m[k]:.2f} m, tilted {deg_from_rad(float(found.tilt_rad[i])):.0f} deg towards "
            f"{deg_from_rad(float(found.azimuth_rad[j])):.0f} deg"
        )

    position, attitude = found.position_sigma_m, found.attitude_sigma_rad
    at = int(np.nanargmax(position))
    out.append(f"worst position ± {mm_from_m(float(position.flat[at])):.2f} mm {where(position, at)}")
    at = int(np.nanargmax(attitude))
    out.append(f"worst attitude ± {deg_from_rad(float(attitude.flat[at])):.3f} deg {where(attitude, at)}")
    at = int(np.nanargmin(found.margin_px))
    limit = SAFE_DEVIATIONS * sigma_px
    unsafe = found.margin_px < limit
    share = float(unsafe.sum() / np.isfinite(found.margin_px).sum())
    out.append(
        f"nearest other labels {found.margin_px.flat[at]:.2f} px {where(found.margin_px, at)}; "
        f"{share:.0%} of the views are below {limit:.2f} px"
    )
    blind = float(np.isnan(position).mean())
    if blind > 0.0:
        out.append(f"{blind:.0%} of the views show fewer than four LEDs")
    widths = np.where(np.isnan(found.diameter_px), 0.0, found.diameter_px) + _SPREAD_PX
    merged = found.separation_px < widths[:, None, None]
    if merged.any():
        at = int(np.nanargmin(found.separation_px / widths[:, None, None]))
        out.append(
            f"LEDs merge in {float(merged.mean()):.0%} of the views, worst {found.separation_px.flat[at]:.1f} px apart "
            f"{where(found.separation_px, at)}"
        )
    return out, not bool(unsafe.any() or merged.any())


def default_ranges(near_m: float, far_m: float, count: int = 6) -> FloatArray:
    """Ranges in equal ratios.

    Raises:
        ConfigError: The nearer is not positive, or the farther not beyond it.
    """
    if not 0.0 < near_m < far_m:
        raise ConfigError(f"expected 0 < nearest < farthest, got {near_m} m and {far_m} m", "--near, --far")
    result: FloatArray = np.geomspace(near_m, far_m, count)
    return result


def widest_tilt(degrees: float) -> float:
    """The widest tilt, rad. Raises ConfigError when it is not between 0 and 90 degrees."""
    if not 0.0 < degrees < 90.0:
        raise ConfigError(f"expected between 0 and 90 degrees, got {degrees}", "--tilt")
    return rad_from_deg(degrees)
