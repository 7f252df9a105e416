"""The exposure rule by itself: bands, limits, waiting, forecasts."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.geometry import Pose
from uvgs_bench.sensor import Capture, PoseEstimate
from uvgs_bench.sensor.exposure import (
    ExposurePolicy,
    ExposureState,
    LightLevel,
    RangeForecast,
    advise_exposure,
    clipped_leds,
)
from uvgs_bench.sensor.saturation import SaturationModel

STATE = ExposureState(0.004)


@pytest.mark.parametrize("peak", [0.60, 0.66, 0.75, 0.90])
def test_inside_the_band_nothing_changes(peak):
    advice = advise_exposure([LightLevel(peak)], STATE)
    assert (advice.exposure_s, advice.reason) == (0.004, "in_band")
    assert not advice.changes(STATE)


@pytest.mark.parametrize(("peak", "reason"), [(0.15, "too_dim"), (0.59, "too_dim"), (0.91, "too_bright")])
def test_outside_it_aims_at_the_target(peak, reason):
    advice = advise_exposure([LightLevel(peak)], STATE)
    assert advice.reason == reason
    assert advice.exposure_s == pytest.approx(0.004 * 0.75 / peak)


def test_a_clipped_core_is_judged_by_its_areas():
    # A Gaussian of s = 2 px four times full scale: 2 pi s^2 ln 4 = 34.8 px^2 above full, 52.3 px^2 above half of it.
    advice = advise_exposure([LightLevel(1.0, 0.0, 34.8, 52.3)], STATE)
    assert advice.reason == "clipped"
    assert advice.exposure_s == pytest.approx(0.004 * 0.75 / 4.0, rel=0.02)
    # However small the clipped core, the step leaves the band's upper half.
    assert advise_exposure([LightLevel(1.0, 0.0, 1.0, 40.0)], STATE).exposure_s <= 0.004 * 0.6


def test_limits_and_steps_bound_the_advice():
    policy = ExposurePolicy(longest_s=0.006, greatest_step=4.0)
    up = advise_exposure([LightLevel(0.2)], STATE, policy)
    assert up.exposure_s == 0.006
    stuck = advise_exposure([LightLevel(0.3)], ExposureState(0.006), policy)
    assert (stuck.exposure_s, stuck.reason) == (0.006, "at_limit")
    down = advise_exposure([LightLevel(1.0, 0.0, 500.0, 510.0)], STATE, policy)
    assert down.exposure_s == 0.001


def test_it_waits_until_a_change_can_show():
    first = advise_exposure([LightLevel(0.2)], STATE, ExposurePolicy(settling=2))
    second = advise_exposure([LightLevel(0.2)], first.state)
    third = advise_exposure([LightLevel(0.2)], second.state)
    fourth = advise_exposure([LightLevel(0.75)], third.state)
    assert [a.reason for a in (first, second, third, fourth)] == ["too_dim", "settling", "settling", "in_band"]
    assert second.exposure_s == third.exposure_s == first.exposure_s


def test_a_capture_that_says_its_exposure_is_not_waited_for():
    # Taken before the change to 16 ms: at 16 ms the same light is at 0.72, so nothing more is asked for.
    asked = ExposureState(0.016, 1)
    assert advise_exposure([LightLevel(0.18)], asked, taken_s=0.004).reason == "in_band"


def test_nothing_seen_brightens_only_a_dark_picture():
    assert advise_exposure([], STATE, picture_peak=0.05).exposure_s == pytest.approx(0.004 * 15.0, rel=1.0)
    assert advise_exposure([], STATE, picture_peak=0.05).reason == "nothing_seen"
    assert not advise_exposure([], STATE, picture_peak=0.95).changes(STATE)


def test_an_approach_is_met_before_it_clips():
    here = [LightLevel(0.8)]
    coming = RangeForecast(1.0, closing_mps=1.0, lead_s=0.1)
    assert coming.brightening == pytest.approx(1.0 / 0.81)
    advice = advise_exposure(here, STATE, forecast=coming)
    assert advice.reason == "too_bright"
    assert advise_exposure(here, STATE).reason == "in_band"
    # A close, resolved emitter grows but does not brighten.
    model = SaturationModel(0.02, 1000.0, 0.9, 1.0, 0.004, 0.7)
    near = RangeForecast(0.4, closing_mps=1.0, lead_s=0.1, model=model)
    assert near.brightening == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    "bad", [{"low": 0.8, "target": 0.7}, {"high": 1.0}, {"shortest_s": 0.1}, {"greatest_step": 1.0}]
)
def test_impossible_policies_are_refused(bad):
    with pytest.raises(ValueError):
        ExposurePolicy(**bad)


@pytest.mark.parametrize(("kind", "full"), [(np.uint8, 255), (np.uint16, 4095)])
def test_leds_at_full_scale_are_counted(kind, full):
    image = np.full((60, 80), 10, dtype=kind)
    led_px = np.array([[10.0, 10.0], [30.2, 40.0], [79.0, 59.0], [np.nan, np.nan]])
    image[40, 31], image[59, 78], image[10, 10] = full, full, full - 1
    # Full scale, but no LED.
    image[50, 10] = full
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 1.0]), "camera", "beacon")
    estimate = PoseEstimate(pose, np.eye(6), 0, "b", led_px, np.zeros((4, 2)), 0.1, 9.0, 4)
    assert clipped_leds(Capture(image, 0), estimate) == 2
