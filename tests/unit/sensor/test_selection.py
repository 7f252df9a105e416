from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from tests.helpers import spots
from uvgs_bench.sensor import Capture, UvgsConfig
from uvgs_bench.sensor.blobs import Blobs, NoBlobs, find_blobs
from uvgs_bench.sensor.selection import largest_area_px2, select_blobs

CENTRES = np.array([[300.0, 300], [420, 310], [350, 420], [370, 340], [600, 600]])


@pytest.fixture(scope="module")
def blobs() -> Blobs:
    found = find_blobs(Capture(spots.draw(CENTRES, np.random.default_rng(1)), 0), UvgsConfig())
    assert isinstance(found, Blobs)
    return found


def reason(answer: Blobs | NoBlobs) -> str:
    assert isinstance(answer, NoBlobs)
    assert answer.stage == "selection"
    return answer.reason


def test_good_blobs_pass_brightest_first(blobs):
    kept = select_blobs(blobs, spots.beacon(), 1000.0, UvgsConfig())
    assert len(kept) == 5
    assert (np.diff(kept.peak_dn * kept.area_px2) <= 0).all()


def test_each_gate_drops_and_says_so(blobs):
    answer = select_blobs(blobs, spots.beacon(), 1000.0, UvgsConfig(min_area_px2=100.0))
    assert reason(answer) == "too_few_blobs"
    assert "5 by area" in answer.detail
    answer = select_blobs(blobs, spots.beacon(), 1000.0, UvgsConfig(min_circularity=1.5))
    assert "5 by shape" in answer.detail


def test_too_many_candidates_are_refused(blobs):
    assert reason(select_blobs(blobs, spots.beacon(), 1000.0, UvgsConfig(max_blobs=4))) == "too_many_blobs"


def test_a_far_light_cannot_belong_to_the_beacon(blobs):
    # The longest edge, 146 mm, at 0.6 m and 1000 px spans 244 px; the fifth light is 330 px from the nearest.
    kept = select_blobs(blobs, spots.beacon(), 1000.0, UvgsConfig(min_range_m=0.6))
    assert len(kept) == 4
    assert kept.centroid_px[:, 0].max() < 500


def test_hue_gate_wraps_through_red(blobs):
    coloured = replace(blobs, hue_deg=np.array([350.0, 10.0, 0.0, 359.0, 120.0]), saturation=np.full(5, 0.9))
    red = replace(spots.beacon(), hue="red")
    assert len(select_blobs(coloured, red, 1000.0, UvgsConfig())) == 4
    assert len(select_blobs(coloured, spots.beacon(), 1000.0, UvgsConfig())) == 5
    answer = select_blobs(coloured, replace(spots.beacon(), hue="white"), 1000.0, UvgsConfig())
    assert "5 by hue" in answer.detail
    assert reason(select_blobs(coloured, red, 1000.0, UvgsConfig(hue_deg=(100.0, 140.0)))) == "too_few_blobs"


@pytest.mark.parametrize("range_m", [0.1, 0.3, 2.0])
def test_the_largest_area_holds_for_overexposed_blurred_discs_and_hardly_more(range_m):
    config, focal_px, diameter_m = UvgsConfig(), 600.0, 0.004
    sized = replace(spots.beacon(), leds=tuple(replace(led, diameter_m=diameter_m) for led in spots.beacon().leds))
    rows, columns = np.mgrid[-60:61, -60:61]
    disc = (np.hypot(rows, columns) <= 0.5 * focal_px * diameter_m / range_m).astype(np.float64)
    disc[60, 60] = 1.0
    light = gaussian_filter(disc, config.widest_blur_px)
    seen = int((100.0 * light / light.max() > config.threshold_floor).sum())
    bound = largest_area_px2(sized, focal_px, range_m, config)
    assert seen <= bound <= 1.6 * seen
    # What is not known bounds nothing; what the file says is never exceeded.
    assert largest_area_px2(spots.beacon(), focal_px, range_m, config) == config.max_area_px2
    assert largest_area_px2(sized, focal_px, range_m, replace(config, max_area_px2=50.0)) == 50.0


def test_a_light_larger_than_the_leds_can_be_is_dropped(blobs):
    sized = replace(spots.beacon(), leds=tuple(replace(led, diameter_m=0.004) for led in spots.beacon().leds))
    wide = replace(blobs, area_px2=np.array([40.0, 40.0, 40.0, 40.0, 3500.0]))
    near = UvgsConfig(min_range_m=0.2)
    assert len(select_blobs(wide, spots.beacon(), 1000.0, near)) == 5
    assert len(select_blobs(wide, sized, 1000.0, near)) == 4
