"""The closed exposure loop: what a capture showed decides the exposure of the next one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import ceil, inf, log

import numpy as np

from uvgs_bench.devices.cameras.source import ExposureControl
from uvgs_bench.errors import ConfigError
from uvgs_bench.sensor.blobs import NoBlobs, find_blobs, full_scale_of
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
# Without a pose a brighter lamp may govern: after so many captures other exposures are tried, each for so many.
_PATIENCE, _EACH = 10, 3
# LEDs are found over more than this factor of exposure.
_LADDER = 3.0
# LEDs of one beacon differ by less than this factor; what is brighter is another light.
_OUTSHONE = 3.0


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
        self._missed = 0
        self._last_good_s = self._state.exposure_s
        self._has_seen = False
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
        has_pose = any(isinstance(outcome, PoseEstimate) for outcome in outcomes.values())
        self._missed = 0 if has_pose else self._missed + 1
        if has_pose:
            self._has_seen = True
            self._last_good_s = self._state.exposure_s if capture.exposure_s is None else capture.exposure_s
        old_s = self._state.exposure_s
        if self._missed >= _PATIENCE:
            advice = self._searched()
        elif self._missed and self._has_seen:
            # A moment ago this exposure was right: a hidden LED is no reason to let lamps govern.
            waiting = max(self._state.waiting - 1, 0)
            advice = ExposureAdvice(old_s, "nothing_seen", "no pose", ExposureState(old_s, waiting))
        else:
            advice = self._advised(capture, outcomes)
        self._last_t_ns = capture.t_ns
        self._before = {name: o for name, o in outcomes.items() if isinstance(o, PoseEstimate)}
        self._state = advice.state
        if advice.exposure_s == old_s:
            return None
        taken_s = self._camera.set_exposure_s(advice.exposure_s)
        # A camera of coarse steps may take what it had: then there is nothing to wait for.
        self._state = ExposureState(taken_s, 0 if taken_s == old_s else advice.state.waiting)
        return None if taken_s == old_s else replace(advice, exposure_s=taken_s, state=self._state)

    def _advised(self, capture: Capture, outcomes: Mapping[str, Outcome]) -> ExposureAdvice:
        # Levels are said by the depth the picture shows; the camera knows its own.
        share = min(full_scale_of(capture) / self._camera.full_scale_dn, 1.0)
        levels = [_scaled(level, share) for level in self._levels(capture, outcomes)]
        peak = 0.0 if levels else float(capture.image.max()) / self._camera.full_scale_dn
        return advise_exposure(
            levels,
            self._state,
            self.policy,
            taken_s=capture.exposure_s,
            picture_peak=peak,
            forecast=self._forecast(capture, outcomes),
        )

    def _searched(self) -> ExposureAdvice:
        """From the last exposure that gave a pose outwards, longer and shorter in turn, over and over."""
        each = _EACH + self.policy.settling
        step, within = divmod(self._missed - _PATIENCE, each)
        if within:
            return ExposureAdvice(self._state.exposure_s, "searching", "waiting for a pose", self._state)
        shortest_s, longest_s, base_s = self.policy.shortest_s, self.policy.longest_s, self._last_good_s
        reach = ceil(log(longest_s / shortest_s, _LADDER)) + 1
        powers = [0, *(sign * k for k in range(1, reach) for sign in (1, -1))]
        rungs = [base_s * _LADDER**k for k in powers if shortest_s <= base_s * _LADDER**k <= longest_s]
        exposure_s = rungs[step % len(rungs)] if rungs else longest_s
        detail = f"no pose in {self._missed} captures"
        return ExposureAdvice(exposure_s, "searching", detail, ExposureState(exposure_s, self.policy.settling))

    def _levels(self, capture: Capture, outcomes: Mapping[str, Outcome]) -> list[LightLevel]:
        """Of all LEDs of all poses, the brightest first; without a pose, of the blobs, the governing one first."""
        poses = [outcome for outcome in outcomes.values() if isinstance(outcome, PoseEstimate)]
        if poses:
            levels = [level for pose in poses for level in _own_levels(capture, pose)]
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


def _own_levels(capture: Capture, pose: PoseEstimate) -> list[LightLevel]:
    """Levels of the LEDs of a pose without those that a lamp beside them outshines."""
    levels = led_levels(capture, pose, None, len(pose.led_px))
    usual = sorted(level.height for level in levels)[(len(levels) - 1) // 2]
    return [level for level in levels if level.height <= _OUTSHONE * usual]


def _scaled(level: LightLevel, share: float) -> LightLevel:
    if share == 1.0:
        return level
    return LightLevel(share * level.peak, share * level.background, 0.0, level.half_px2)


def _range_m(pose: PoseEstimate) -> float:
    return float(np.linalg.norm(pose.camera_from_beacon.t_m))
