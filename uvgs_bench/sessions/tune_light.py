"""What no parameter can mend: how long to expose, and the ranges at which LEDs clip, merge, outgrow or fade."""

from __future__ import annotations

from collections.abc import Sequence

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.exposure import ExposurePolicy, ExposureState, advise_exposure
from uvgs_bench.sessions.light_ranges import range_limits, saturation_model
from uvgs_bench.sessions.tune_measure import SceneLights
from uvgs_bench.units import ms_from_s


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
    exposure_s = 1.0 if taken_s is None else taken_s
    model = saturation_model(lights.level, lights.range_m, exposure_s, calibration, beacon)
    if model is None:
        return ["no warning of ranges: the beacon file names no LED diameter"]
    at = "at this exposure" if taken_s is None else f"at {ms_from_s(taken_s):.2f} ms"
    lines = [f"{limit.detail} {at}" for limit in range_limits(model, exposure_s, beacon, config)]
    if lights.level.clipped_px2 > 0.0:
        lines = [f"{line} (from a clipped core: an estimate)" for line in lines]
    return lines
