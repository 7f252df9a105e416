"""At which ranges the LEDs of captures will clip, merge, outgrow or fade, and the warning before they clip."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import inf

import numpy as np

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.exposure import LightLevel, led_levels
from uvgs_bench.sensor.outcome import Outcome, PoseEstimate
from uvgs_bench.sensor.saturation import RangeLimit, SaturationModel
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.sessions.events import EventSink, Remark
from uvgs_bench.units import ms_from_s

# Nothing in the captures tells it well while LEDs are larger than it; limits depend on it little there.
_PSF_SIGMA_PX = 0.9


def saturation_model(
    level: LightLevel, range_m: float, exposure_s: float, calibration: Calibration, beacon: Beacon
) -> SaturationModel | None:
    """The model fixed by one measured LED.

    Args:
        level: Its level.
        range_m: Its range, m.
        exposure_s: The exposure it was measured with, s.
        calibration: The camera.
        beacon: The beacon.

    Returns:
        The model, or None when the beacon names no LED diameter or the LED does not stand out.
    """
    diameters = [led.diameter_m for led in beacon.leds if led.diameter_m is not None]
    if not diameters or not level.height > 0.0:
        return None
    lens = calibration.lens
    focal_px = float(np.sqrt(lens.fx_px * lens.fy_px))
    background = min(level.background, 0.99)
    return SaturationModel(max(diameters), focal_px, _PSF_SIGMA_PX, range_m, exposure_s, level.height, background)


def range_limits(
    model: SaturationModel, exposure_s: float, beacon: Beacon, config: UvgsConfig
) -> tuple[RangeLimit, ...]:
    """Where something stops working within the ranges of a config.

    Args:
        model: How light follows range and exposure.
        exposure_s: Exposure, s.
        beacon: The beacon.
        config: The parameters whose limits count.

    Returns:
        The limits at finite ranges, nearest first.
    """
    # Seen from the front two LEDs are as far apart as across the line of sight.
    across = beacon.positions_m[:, :2]
    apart = np.linalg.norm(across[:, None] - across[None], axis=2)
    separation_m = float(apart[np.triu_indices(len(across), 1)].min())
    rules = replace(config, min_contrast=max(config.min_contrast, 1e-3))
    found = model.limits(exposure_s, config.min_range_m, config.max_range_m, max(separation_m, 1e-6), rules)
    return tuple(limit for limit in found if 0.0 < limit.range_m < inf)


class ClipWatch:
    """Warns once per beacon of the range below which the cores of its LEDs clip, before that range is reached.

    Args:
        sensors: The sensors by beacon.
        sink: Where warnings go.
        shortest_s: With automatic exposure, the shortest it can go, s: only what clips even then is warned of.
    """

    def __init__(self, sensors: Mapping[str, Uvgs], sink: EventSink, shortest_s: float | None = None) -> None:
        self._waiting = dict(sensors)
        self._sink = sink
        self._shortest_s = shortest_s

    def look(self, capture: Capture, outcomes: Mapping[str, Outcome]) -> None:
        """Look at the first pose of each beacon."""
        for name in tuple(self._waiting):
            outcome = outcomes[name]
            if isinstance(outcome, PoseEstimate):
                self._warn(capture, outcome, self._waiting.pop(name))

    def _warn(self, capture: Capture, pose: PoseEstimate, uvgs: Uvgs) -> None:
        level = led_levels(capture, pose, None, len(uvgs.beacon.leds))[0]
        range_m = float(np.linalg.norm(pose.camera_from_beacon.t_m))
        # Without a known exposure only this one can be spoken of.
        taken_s = 1.0 if capture.exposure_s is None else capture.exposure_s
        model = saturation_model(level, range_m, taken_s, uvgs.calibration, uvgs.beacon)
        if model is None:
            return
        is_controlled = self._shortest_s is not None and capture.exposure_s is not None
        exposure_s = self._shortest_s if is_controlled and self._shortest_s is not None else taken_s
        limits = range_limits(model, exposure_s, uvgs.beacon, uvgs.config)
        clip = next((limit for limit in limits if limit.reason == "clips" and limit.side == "nearer"), None)
        if clip is None:
            return
        at = "this exposure" if capture.exposure_s is None else f"{ms_from_s(exposure_s):.3g} ms"
        doubt = ", an estimate because they clip already" if level.clipped_px2 > 0.0 else ""
        text = (
            f"{uvgs.beacon.name}: LED cores clip below about {clip.range_m:.2f} m at {at} (now {range_m:.2f} m){doubt}"
        )
        self._sink(Remark("warning", text))
