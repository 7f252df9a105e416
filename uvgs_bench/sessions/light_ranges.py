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

    It is told from the first pose without clipped cores; where they clip from the beginning, that is said at once.

    Args:
        sensors: The sensors by beacon.
        sink: Where warnings go.
        shortest_s: With automatic exposure, the shortest it can go, s: only what clips even then is warned of.
    """

    def __init__(self, sensors: Mapping[str, Uvgs], sink: EventSink, shortest_s: float | None = None) -> None:
        self._waiting = dict(sensors)
        self._clipping: set[str] = set()
        self._sink = sink
        self._shortest_s = shortest_s

    def look(self, capture: Capture, outcomes: Mapping[str, Outcome]) -> None:
        """Look at the poses of the beacons that nothing was said about yet."""
        for name, uvgs in tuple(self._waiting.items()):
            outcome = outcomes[name]
            if not isinstance(outcome, PoseEstimate):
                continue
            level = led_levels(capture, outcome, None, len(uvgs.beacon.leds))[0]
            if level.clipped_px2 > 0.0:
                self._say_clipped(capture, outcome, name)
            else:
                self._warn(capture, outcome, level, self._waiting.pop(name))

    def _say_clipped(self, capture: Capture, pose: PoseEstimate, name: str) -> None:
        if name in self._clipping or self._shortest_s is not None:
            return
        self._clipping.add(name)
        at = "" if capture.exposure_s is None else f" and {ms_from_s(capture.exposure_s):.3g} ms"
        text = f"{name}: LED cores clip already at {_range_m(pose):.2f} m{at}: expose shorter"
        self._sink(Remark("warning", text))

    def _warn(self, capture: Capture, pose: PoseEstimate, level: LightLevel, uvgs: Uvgs) -> None:
        range_m = _range_m(pose)
        # Without a known exposure only this one can be spoken of.
        taken_s = 1.0 if capture.exposure_s is None else capture.exposure_s
        model = saturation_model(level, range_m, taken_s, uvgs.calibration, uvgs.beacon)
        if model is None:
            return
        exposure_s = taken_s if capture.exposure_s is None or self._shortest_s is None else self._shortest_s
        clip_m = model.clips_below_m(exposure_s, uvgs.config.min_range_m, uvgs.config.max_range_m)
        if clip_m is None:
            return
        at = "this exposure" if capture.exposure_s is None else f"{ms_from_s(exposure_s):.3g} ms"
        text = f"{uvgs.beacon.name}: LED cores clip below about {clip_m:.2f} m at {at} (now {range_m:.2f} m)"
        self._sink(Remark("warning", text))


def _range_m(pose: PoseEstimate) -> float:
    return float(np.linalg.norm(pose.camera_from_beacon.t_m))
