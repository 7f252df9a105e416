"""Measuring where the LEDs of a beacon are, from pictures whose blobs have names.

Three sources of shape and scale: ``board`` (a known board is fixed to the beacon), ``gantry`` (the carriage moves by
known amounts), ``free`` (pictures alone; the scale comes from calipers, or else from the nominal geometry). Exactly
one of them sets the scale; calipers beside a board or a gantry are a check.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from uvgs_bench.beacon.emission_shift import with_shifts
from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.beacon.length_row import LengthRow
from uvgs_bench.beacon.measure_checks import check_mirror, check_placed, check_views, pulled_priors
from uvgs_bench.beacon.measure_fit import robust_fit
from uvgs_bench.beacon.measure_result import build_result
from uvgs_bench.beacon.measure_start import LedView, initial, nominal_scale_row
from uvgs_bench.beacon.measure_types import BeaconMeasurement, Caliper, Distance, LedResiduals, MeasureConfig
from uvgs_bench.beacon.network import Network
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.errors import ConfigError

__all__ = ["BeaconMeasurement", "Caliper", "Distance", "LedResiduals", "LedView", "MeasureConfig", "measure_beacon"]


def measure_beacon(
    views: Sequence[LedView], nominal: Beacon, calibration: Calibration, config: MeasureConfig, name: str = ""
) -> BeaconMeasurement:
    """Measure LED positions.

    Args:
        views: What was seen, with a pose near the truth each; a gantry's views have carriage positions, a board's views
            have corners.
        nominal: The beacon as it was meant.
        calibration: The camera; its lens is adjusted within its covariance if it has one.
        config: Source, frame, what else is known.
        name: Name of the measured beacon; the nominal's when empty.

    Returns:
        The measurement.

    Raises:
        TooFewViews: The views cannot tell the positions, or their mirror image fits as well.
        ConfigError: Calipers or the frame name what does not exist, or do not fit the source.
        CalibrationError: The views contradict each other or what is declared.
    """
    check_placed(config.frame, config.by)
    by_hand, is_free = _calipers(config.calipers, nominal), config.by == "free"
    check_views(views, nominal, config.by, config.worst_sigma_m)
    lens_covariance = None if config.is_lens_fixed else calibration.covariance
    network, state = initial(views, nominal, calibration.lens, config, lens_covariance)
    lengths: tuple[LengthRow, ...] = ()
    if is_free:
        lengths = by_hand or (nominal_scale_row(nominal.positions_m, nominal, config.nominal_sigma_m)[0],)
        network = _with(network, lengths=lengths)
    fit = robust_fit(network, state)
    margin = check_mirror(fit.network, fit.state, fit.weight) if is_free else float("inf")
    if config.is_shift_free:
        fit = robust_fit(*with_shifts(fit.network, fit.state, nominal))
    warnings = list(fit.warnings)
    scale_source = _SCALE[config.by].format(board=config.board_scale_sigma, gantry=config.scale_sigma)
    if is_free and by_hand:
        scale_source = f"{len(by_hand)} caliper distances"
    elif is_free:
        row, left_out = nominal_scale_row(fit.state.leds_m, nominal, config.nominal_sigma_m)
        fit = robust_fit(_with(fit.network, lengths=(row,)), fit.state)
        warnings = list(fit.warnings)
        scale_source = f"nominal distances, {row.sigma:.1e} of each length"
        if left_out:
            warnings.append(f"LED {left_out} is not where the nominal geometry has it; the scale comes from the others")
    warnings += pulled_priors(fit.network, fit.state, calibration)
    if config.is_lens_fixed or calibration.covariance is None:
        warnings.append("the lens is taken as exact: the deviations leave its doubt out")
    return build_result(views, nominal, config, fit, name, scale_source, margin, tuple(warnings), by_hand)


_SCALE = {
    "board": "the board fixed to the beacon, print scale known to {board:.1e}",
    "gantry": "travel of the gantry, scale of its axes known to {gantry:.1e}",
    "free": "",
}


def _with(network: Network, lengths: Sequence[LengthRow]) -> Network:
    return replace(network, lengths=tuple(lengths))


def _calipers(calipers: Sequence[Caliper], beacon: Beacon) -> tuple[LengthRow, ...]:
    names = list(beacon.led_names)
    rows = []
    for caliper in calipers:
        for led in (caliper.first, caliper.second):
            if led not in names:
                raise ConfigError(f"no LED is called '{led}', the beacon has {', '.join(names)}", "--caliper")
        if not (caliper.distance_m > 0.0 and caliper.sigma_m > 0.0) or caliper.first == caliper.second:
            raise ConfigError(
                f"{caliper.first}-{caliper.second}: needs two LEDs, a positive distance and deviation", "--caliper"
            )
        first, second = (np.array([names.index(led)]) for led in (caliper.first, caliper.second))
        stated = np.array([caliper.distance_m])
        rows.append(LengthRow(first, second, stated, caliper.sigma_m / caliper.distance_m))
    return tuple(rows)
