"""The closed exposure loop: what a capture showed decides the exposure of the next one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import inf

import numpy as np

from uvgs_bench.devices.cameras.source import ExposureControl
from uvgs_bench.errors import ConfigError
from uvgs_bench.sensor.blobs import NoBlobs, find_blobs, full_scale_dn
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.exposure import (
    ExposureAdvice,
    ExposurePolicy,
    ExposureState,
    LightLevel,
    RangeForecast,
    advise_exposure,
    led_levels,
)
from uvgs_bench.sensor.outcome import Outcome, PoseEstimate
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.units import ms_from_s, s_from_ns

# An older pose says nothing about how fast the beacon comes nearer now.
_FRESH_S = 0.5


class ExposureLoop:
    """Keeps the brightest LED inside the band of a policy; sets nothing but the exposure.

    Args:
        camera: The camera; its own automatic exposure is taken over at once.
        sensors: The sensors by beacon.
        policy: What is wanted; limits and waiting are narrowed to what the camera can.

    Raises:
        ConfigError: The camera cannot expose as shortly as the policy's longest.
        CaptureError: The camera refuses.
    """

    def __init__(self, camera: ExposureControl, sensors: Mapping[str, Uvgs], policy: ExposurePolicy) -> None:
        shortest_s = max(policy.shortest_s, camera.exposure_limits_s[0])
        longest_s = min(policy.longest_s, camera.exposure_limits_s[1])
        if not shortest_s < longest_s:
            raise ConfigError(
                f"{ms_from_s(policy.longest_s):g} ms is not longer than the camera's shortest exposure, "
                f"{ms_from_s(shortest_s):g} ms",
                key="--max-exposure-ms",
            )
        settling = max(policy.settling, camera.settling_captures)
        self.policy = replace(policy, shortest_s=shortest_s, longest_s=longest_s, settling=settling)
        self._camera = camera
        self._sensors = dict(sensors)
        self._state = ExposureState(camera.set_exposure_s(camera.exposure_s), settling)
        self._before: dict[str, PoseEstimate] = {}
        self._last_t_ns: int | None = None

    def after(self, capture: Capture, outcomes: Mapping[str, Outcome]) -> ExposureAdvice | None:
        """Judge a capture and set the camera.

        Args:
            capture: The capture just solved.
            outcomes: Its outcomes by beacon.

        Returns:
            The advice with the exposure the camera took, when that changed; None otherwise.

        Raises:
            CaptureError: The camera refuses.
        """
        # Levels are said by the depth the picture shows; the camera knows its own.
        share = min(full_scale_dn(capture.image) / self._camera.full_scale_dn, 1.0)
        levels = [_scaled(level, share) for level in self._levels(capture, outcomes)]
        peak = 0.0 if levels else float(capture.image.max()) / self._camera.full_scale_dn
        advice = advise_exposure(
            levels,
            self._state,
            self.policy,
            taken_s=capture.exposure_s,
            picture_peak=peak,
            forecast=self._forecast(capture, outcomes),
        )
        self._last_t_ns = capture.t_ns
        self._before = {name: o for name, o in outcomes.items() if isinstance(o, PoseEstimate)}
        old_s = self._state.exposure_s
        self._state = advice.state
        if advice.exposure_s == old_s:
            return None
        taken_s = self._camera.set_exposure_s(advice.exposure_s)
        # A camera of coarse steps may take what it had: then there is nothing to wait for.
        self._state = ExposureState(taken_s, 0 if taken_s == old_s else advice.state.waiting)
        return None if taken_s == old_s else replace(advice, exposure_s=taken_s, state=self._state)

    def _levels(self, capture: Capture, outcomes: Mapping[str, Outcome]) -> list[LightLevel]:
        """Of all LEDs of all poses, the brightest first; without a pose, of the blobs, the governing one first."""
        poses = [outcome for outcome in outcomes.values() if isinstance(outcome, PoseEstimate)]
        if poses:
            levels = [level for pose in poses for level in led_levels(capture, pose, None, len(pose.led_px))]
            return sorted(levels, key=lambda level: -level.height)
        # Which beacon is in the picture is not known; with the fewest LEDs none of it is taken for another light.
        name, uvgs = min(self._sensors.items(), key=lambda item: len(item[1].beacon.leds))
        blobs = find_blobs(capture, uvgs.config)
        found = None if isinstance(blobs, NoBlobs) else blobs
        return list(led_levels(capture, outcomes[name], found, len(uvgs.beacon.leds)))

    def _forecast(self, capture: Capture, outcomes: Mapping[str, Outcome]) -> RangeForecast | None:
        """How much brighter the nearest beacon will be when the advice takes effect."""
        nearest, range_m = "", inf
        for name, outcome in outcomes.items():
            if isinstance(outcome, PoseEstimate) and _range_m(outcome) < range_m:
                nearest, range_m = name, _range_m(outcome)
        before = self._before.get(nearest)
        if before is None or self._last_t_ns is None:
            return None
        passed_s = s_from_ns(capture.t_ns - self._last_t_ns)
        if not 0.0 < passed_s <= _FRESH_S:
            return None
        closing_mps = (_range_m(before) - range_m) / passed_s
        waiting = 0 if capture.exposure_s is not None else self.policy.settling
        return RangeForecast(range_m, closing_mps, passed_s * (1 + waiting))


def _scaled(level: LightLevel, share: float) -> LightLevel:
    if share == 1.0:
        return level
    return LightLevel(share * level.peak, share * level.background, 0.0, level.half_px2)


def _range_m(pose: PoseEstimate) -> float:
    return float(np.linalg.norm(pose.camera_from_beacon.t_m))
