"""What no parameter can mend: how long to expose, and the ranges at which LEDs clip, merge, outgrow or fade."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf

import numpy as np

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.exposure import ExposurePolicy, ExposureState, advise_exposure
from uvgs_bench.sensor.saturation import SaturationModel
from uvgs_bench.sessions.tune_measure import SceneLights
from uvgs_bench.units import ms_from_s

# Nothing in the captures tells it well while LEDs are larger than it; limits depend on it little there.
_PSF_SIGMA_PX = 0.9


def light_remarks(
    captures: Sequence[Capture],
    lights: SceneLights,
    calibration: Calibration,
    beacon: Beacon,
    config: UvgsConfig,
) -> list[str]:
    """Lines about exposure and about ranges.

    Args:
        captures: The captures looked at.
        lights: What was measured on them.
        calibration: The camera.
        beacon: The beacon.
        config: The parameters whose limits count.

    Returns:
        The lines; empty when no LED was seen.
    """
    if lights.level is None:
        return []
    taken_s = next((c.exposure_s for c in captures if c.exposure_s is not None), None)
    return [_exposure(lights, taken_s), *_ranges(lights, taken_s, calibration, beacon, config)]


def _exposure(lights: SceneLights, taken_s: float | None) -> str:
    assert lights.level is not None
    # Without a known exposure only the ratio means something.
    base_s = 1.0 if taken_s is None else taken_s
    policy = ExposurePolicy(shortest_s=1e-9 * base_s, longest_s=1e9 * base_s)
    advice = advise_exposure([lights.level], ExposureState(base_s), policy, taken_s=base_s)
    if advice.exposure_s == base_s:
        return f"exposure is right: {advice.detail}"
    ratio = advice.exposure_s / base_s
    times = f"{ratio:.1f} times as long" if ratio > 1.0 else f"1/{1.0 / ratio:.1f} as long"
    instead = "" if taken_s is None else f" ({ms_from_s(advice.exposure_s):.2f} ms instead of {ms_from_s(taken_s):.2f})"
    doubt = ", an estimate because the core clips" if lights.level.clipped_px2 > 0.0 else ""
    return f"{advice.detail}: expose {times}{instead}{doubt}"


def _ranges(
    lights: SceneLights, taken_s: float | None, calibration: Calibration, beacon: Beacon, config: UvgsConfig
) -> list[str]:
    assert lights.level is not None
    diameters = [led.diameter_m for led in beacon.leds if led.diameter_m is not None]
    if not diameters or not lights.level.height > 0.0:
        return ["no warning of ranges: the beacon file names no LED diameter"]
    lens = calibration.lens
    exposure_s = 1.0 if taken_s is None else taken_s
    model = SaturationModel(
        max(diameters),
        float(np.sqrt(lens.fx_px * lens.fy_px)),
        _PSF_SIGMA_PX,
        lights.range_m,
        exposure_s,
        lights.level.height,
        lights.level.background,
    )
    # Seen from the front two LEDs are as far apart as across the line of sight.
    across = beacon.positions_m[:, :2]
    apart = np.linalg.norm(across[:, None] - across[None], axis=2)
    separation_m = float(apart[np.triu_indices(len(across), 1)].min())
    rules = replace(config, min_contrast=max(config.min_contrast, 1e-3))
    found = model.limits(exposure_s, config.min_range_m, config.max_range_m, max(separation_m, 1e-6), rules)
    at = "at this exposure" if taken_s is None else f"at {ms_from_s(taken_s):.2f} ms"
    lines = [f"{limit.detail} {at}" for limit in found if 0.0 < limit.range_m < inf]
    if lights.level.clipped_px2 > 0.0:
        lines = [f"{line} (from a clipped core: an estimate)" for line in lines]
    return lines
