"""Which exposure the next capture should have: LED peaks inside a band of full scale, whatever the range does.

The rule is a function of what one capture showed and of an explicit state; whoever owns the camera applies its advice
and hands the new state to the next call.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor.blobs import Blobs, full_scale_of
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.outcome import Outcome, PoseEstimate
from uvgs_bench.sensor.preprocess import intensity
from uvgs_bench.sensor.saturation import SaturationModel

_REACH_PX = 4
_CORE_PX = 2
# Below this the spot is no light but the noise of its surroundings.
_LEAST_HEIGHT = 0.01


@dataclass(frozen=True, slots=True)
class LightLevel:
    """How bright one spot is.

    Args:
        peak: Brightest pixel as a fraction of full scale.
        background: Its surroundings as a fraction of full scale.
        clipped_px2: Pixels at full scale, px^2.
        half_px2: Pixels above half the height over the background, px^2.
    """

    peak: float
    background: float = 0.0
    clipped_px2: float = 0.0
    half_px2: float = 0.0

    @property
    def height(self) -> float:
        """Unclipped height over the background, as a fraction of full scale; above 1 it can only be estimated.

        A Gaussian spot of height A covers ``2 pi s^2 ln(A / level)`` above a level, so the areas above full and above
        half scale give A without knowing s. A flat disc is overestimated; the limits of a step bound that.
        """
        seen = max(self.peak - self.background, 0.0)
        rim_px2 = self.half_px2 - self.clipped_px2
        if self.clipped_px2 <= 0.0:
            return seen
        # With less than a pixel of rim the edge is as steep as pixels can show.
        return seen * float(2.0 ** min(self.clipped_px2 / max(rim_px2, 1.0), 30.0))


@dataclass(frozen=True, slots=True)
class ExposurePolicy:
    """What is wanted.

    Args:
        low: Lower end of the band of peaks in which nothing changes, fraction of full scale.
        target: Where a change aims, fraction of full scale.
        high: Upper end of the band.
        shortest_s: Shortest exposure of the camera, s.
        longest_s: Longest exposure allowed (motion blur, frame rate), s.
        greatest_step: Largest factor of one change, up or down.
        settling: Captures to wait after a change when a capture does not say its own exposure.

    Raises:
        ValueError: The band or the limits are not in order.
    """

    low: float = 0.60
    target: float = 0.75
    high: float = 0.90
    shortest_s: float = 2e-5
    longest_s: float = 0.02
    greatest_step: float = 16.0
    settling: int = 1

    def __post_init__(self) -> None:
        if not 0.0 < self.low < self.target < self.high < 1.0:
            raise ValueError(f"expected 0 < low < target < high < 1, got {self.low}, {self.target}, {self.high}")
        if not 0.0 < self.shortest_s < self.longest_s:
            raise ValueError(f"expected 0 < shortest_s < longest_s, got {self.shortest_s}, {self.longest_s}")
        if not self.greatest_step > 1.0:
            raise ValueError(f"greatest_step must exceed 1, got {self.greatest_step}")


@dataclass(frozen=True, slots=True)
class ExposureState:
    """What is remembered between captures.

    Args:
        exposure_s: Exposure asked for last, s.
        waiting: Captures still to come that may have been taken before the camera obeyed.
    """

    exposure_s: float
    waiting: int = 0


@dataclass(frozen=True, slots=True)
class RangeForecast:
    """How far the beacon is and will be when the advice takes effect.

    Args:
        range_m: Range at the capture, m.
        closing_mps: How fast it comes nearer, m/s; negative when it leaves.
        lead_s: Time from the capture to the one that obeys, s.
        model: How the peak follows range; None means 1/r^2, which holds for spots smaller than the point spread.
    """

    range_m: float
    closing_mps: float
    lead_s: float
    model: SaturationModel | None = None

    @property
    def brightening(self) -> float:
        """Peak then over peak now, at one exposure."""
        # Never past a fifth of the way left: a forecast must not expect the beacon inside the lens.
        later_m = max(self.range_m - self.closing_mps * self.lead_s, 0.2 * self.range_m)
        if self.model is None:
            return (self.range_m / later_m) ** 2
        exposure_s = self.model.exposure_s
        return self.model.height(later_m, exposure_s) / self.model.height(self.range_m, exposure_s)


@dataclass(frozen=True, slots=True)
class ExposureAdvice:
    """What to do.

    Args:
        exposure_s: Exposure of the next capture, s.
        reason: ``in_band``, ``too_dim``, ``too_bright``, ``clipped``, ``nothing_seen``, ``settling``, ``at_limit``,
            ``searching`` (of a loop that found no pose for long).
        detail: One line with the numbers.
        state: Hand this to the next call.
    """

    exposure_s: float
    reason: str
    detail: str
    state: ExposureState

    def changes(self, before: ExposureState) -> bool:
        """Whether it asks for another exposure than before."""
        return self.exposure_s != before.exposure_s


def led_levels(capture: Capture, outcome: Outcome, blobs: Blobs | None, led_count: int) -> tuple[LightLevel, ...]:
    """Levels that should govern the exposure, the governing one first.

    With a pose they are those of its LEDs, brightest first: none may clip. Without one nobody knows which blobs are
    LEDs, but the ``led_count``-th brightest is never dimmer than the dimmest LED in the picture, so it governs.

    Args:
        capture: The picture.
        outcome: What the sensor said.
        blobs: Bright blobs of the picture, for when there is no pose; None or empty when there are none.
        led_count: LEDs of the beacon.

    Returns:
        The levels; empty when nothing bright was found.
    """
    if isinstance(outcome, PoseEstimate):
        seen = outcome.led_px[np.isfinite(outcome.led_px).all(axis=1)]
        boxes = np.hstack([seen, seen])
    elif blobs is not None and len(blobs):
        boxes = blobs.box_px
    else:
        return ()
    levels = sorted(measure_levels(capture, boxes), key=lambda level: -level.height)
    if isinstance(outcome, PoseEstimate):
        return tuple(levels)
    first = min(led_count, len(levels)) - 1
    return (levels[first], *levels[:first], *levels[first + 1 :])


def clipped_leds(capture: Capture, estimate: PoseEstimate) -> int:
    """How many LEDs of a pose have a pixel at full scale within their core.

    Args:
        capture: The picture.
        estimate: Its pose.

    Returns:
        The count; LEDs that were not seen do not count.
    """
    full = full_scale_of(capture)
    seen = estimate.led_px[np.isfinite(estimate.led_px).all(axis=1)]
    cores = [
        capture.image[max(0, v - _CORE_PX) : v + _CORE_PX + 1, max(0, u - _CORE_PX) : u + _CORE_PX + 1]
        for u, v in np.rint(seen).astype(int)
    ]
    return sum(bool(core.size) and float(core.max()) >= full for core in cores)


def measure_levels(capture: Capture, boxes_px: FloatArray) -> tuple[LightLevel, ...]:
    """Brightness of spots in a picture.

    Args:
        capture: The picture.
        boxes_px: Where they are: x0, y0, x1, y1, shape (n, 4), px; a few px of surroundings are added.

    Returns:
        One level per box.
    """
    raw = intensity(capture.image)
    full = full_scale_of(capture)
    floor = float(np.median(raw[4::17, 4::19])) if raw.size > 4096 else float(np.median(raw))
    height, width = raw.shape
    levels = []
    for x0, y0, x1, y1 in np.rint(boxes_px).astype(int):
        # A spot larger than the first guess is followed until its rim lies inside.
        reach = _REACH_PX
        while True:
            left, top = max(0, x0 - reach), max(0, y0 - reach)
            part = raw[top : min(height, y1 + reach + 1), left : min(width, x1 + reach + 1)].astype(np.float64)
            background = float(np.percentile(np.concatenate([part[0], part[-1], part[:, 0], part[:, -1]]), 25))
            if background <= floor + 0.25 * (float(part.max()) - floor) or reach >= 32:
                break
            reach *= 2
        peak = float(part.max())
        half = 0.5 * (peak + background)
        levels.append(
            LightLevel(peak / full, background / full, float((part >= full).sum()), float((part > half).sum()))
        )
    return tuple(levels)


def advise_exposure(
    levels: Sequence[LightLevel],
    state: ExposureState,
    policy: ExposurePolicy | None = None,
    *,
    taken_s: float | None = None,
    picture_peak: float = 0.0,
    forecast: RangeForecast | None = None,
) -> ExposureAdvice:
    """Advise the exposure of the next capture.

    Args:
        levels: Of the LEDs, the governing one first (see ``led_levels``); empty when nothing was seen.
        state: From the last call; the exposure asked for.
        policy: What is wanted; the default when None.
        taken_s: Exposure this capture was truly taken with, s; None when it does not say.
        picture_peak: Brightest pixel of the picture as a fraction of full scale; used when nothing was seen.
        forecast: Prior range and closing speed, or None.

    Returns:
        The advice with the state for the next call.
    """
    wanted = ExposurePolicy() if policy is None else policy
    if taken_s is None and state.waiting > 0:
        detail = f"{state.waiting} captures until the last change shows"
        return ExposureAdvice(state.exposure_s, "settling", detail, ExposureState(state.exposure_s, state.waiting - 1))
    base_s = state.exposure_s if taken_s is None else taken_s
    if not levels:
        return _search(base_s, state, wanted, picture_peak)
    first = levels[0]
    factor = 1.0 if forecast is None else forecast.brightening
    # What asked for the last change may not have been in effect; the band is judged at the exposure asked for.
    asked = state.exposure_s / base_s
    expected = first.background * asked + first.height * factor * asked
    # A clipped core's height is an estimate; whatever it says, the peak cannot be inside the band.
    clips = first.clipped_px2 > 0.0 and factor * asked > wanted.high
    if wanted.low <= expected <= wanted.high and not clips:
        return _hold(state, "in_band", f"LED peak {expected:.0%} of full scale")
    rise = max(first.background + first.height * factor, _LEAST_HEIGHT)
    reason = "clipped" if clips else "too_bright" if expected > wanted.high else "too_dim"
    step = wanted.target / rise
    if clips:
        step = min(step, wanted.low)
    return _change(base_s, step, state, wanted, reason, f"LED peak {expected:.0%} of full scale")


def _search(base_s: float, state: ExposureState, policy: ExposurePolicy, picture_peak: float) -> ExposureAdvice:
    """Nothing was seen: brighter while the whole picture is dark, otherwise the light is there but it is no LED."""
    detail = f"no LED seen, brightest pixel {picture_peak:.0%} of full scale"
    if picture_peak >= policy.low:
        return _hold(state, "nothing_seen", detail)
    return _change(base_s, policy.target / max(picture_peak, _LEAST_HEIGHT), state, policy, "nothing_seen", detail)


def _hold(state: ExposureState, reason: str, detail: str) -> ExposureAdvice:
    return ExposureAdvice(state.exposure_s, reason, detail, ExposureState(state.exposure_s))


def _change(
    base_s: float, step: float, state: ExposureState, policy: ExposurePolicy, reason: str, detail: str
) -> ExposureAdvice:
    bounded = float(np.clip(step, 1.0 / policy.greatest_step, policy.greatest_step))
    exposure_s = float(np.clip(base_s * bounded, policy.shortest_s, policy.longest_s))
    if exposure_s == state.exposure_s:
        return _hold(state, "at_limit", f"{detail}; the exposure is at its limit")
    return ExposureAdvice(exposure_s, reason, detail, ExposureState(exposure_s, policy.settling))
