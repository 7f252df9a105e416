"""Exposure and saturation against the simulated camera: loops converge, areas and peaks are as forecast."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.beacon import Beacon, Led
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.sim.render import Emitter, Renderer
from uvgs_bench.devices.sim.truth import TrueCamera
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.sensor import Capture, PoseEstimate, Uvgs, UvgsConfig
from uvgs_bench.sensor.blobs import NoBlobs, find_blobs, full_scale_dn
from uvgs_bench.sensor.exposure import ExposurePolicy, ExposureState, RangeForecast, advise_exposure, led_levels
from uvgs_bench.sensor.saturation import SaturationModel

FOCAL_PX = 1000.0
CAMERA = replace(TrueCamera(), parameters_px=(FOCAL_PX, FOCAL_PX, 639.5, 479.5, 0.0, 0.0, 0.0, 0.0, 0.0))
LENS = Lens("plumb_bob", 1280, 960, np.array(CAMERA.parameters_px))
AXIS = np.array([0.0, 0.0, -1.0])
BEACON = Beacon(
    "test",
    tuple(
        Led(f"led{i}", np.array(p), AXIS, np.radians(70.0), 0.005)
        for i, p in enumerate(
            [(-0.062, 0.035, 0.005), (0.071, 0.022, -0.008), (-0.012, -0.058, 0.012), (0.018, 0.004, -0.07)]
        )
    ),
)
RENDERER = Renderer(LENS, CAMERA, 5)
R = so3_exp(np.array([0.1, -0.15, 0.4]))


def shot(range_m: float, exposure_s: float, index: int, brightness: float = 180.0) -> Capture:
    pose = Pose(R, np.array([0.02, -0.01, range_m]), "camera", "beacon")
    axis = (pose.R @ AXIS)[None]
    emitters = [
        Emitter(centre[None], axis, brightness, 0.005, np.radians(70.0)) for centre in pose.apply(BEACON.positions_m)
    ]
    image = RENDERER.expose(emitters, [], exposure_s, RENDERER.generator(index))
    return Capture(image, index, "", index, exposure_s)


def follow(start_s: float, ranges_m: list[float], lead: bool = False, brightness: float = 180.0) -> list[str]:
    """Reasons of the advice, capture by capture; the camera obeys from the next capture on."""
    uvgs = Uvgs(Calibration(LENS, "x"), BEACON)
    state, policy, reasons = ExposureState(start_s), ExposurePolicy(settling=0, longest_s=0.2), []
    for i, range_m in enumerate(ranges_m):
        capture = shot(range_m, state.exposure_s, i, brightness)
        outcome = uvgs.solve(capture)
        blobs = None if isinstance(outcome, PoseEstimate) else find_blobs(capture, uvgs.config)
        levels = led_levels(capture, outcome, None if isinstance(blobs, NoBlobs) else blobs, len(BEACON.leds))
        forecast = None
        if lead and isinstance(outcome, PoseEstimate) and i + 1 < len(ranges_m):
            forecast = RangeForecast(range_m, range_m - ranges_m[i + 1], 1.0)
        peak = float(capture.image.max()) / full_scale_dn(capture.image)
        advice = advise_exposure(
            levels, state, policy, taken_s=capture.exposure_s, picture_peak=peak, forecast=forecast
        )
        state = advice.state
        reasons.append(advice.reason)
    return reasons


@pytest.mark.parametrize("range_m", [0.4, 0.8, 1.2])
@pytest.mark.parametrize("factor", [0.1, 0.25, 4.0, 10.0])
def test_the_loop_converges_within_three_captures(range_m, factor):
    # 4 ms is right near 1 m; the fourth capture is taken with the third advice and must need no change.
    reasons = follow(0.004 * factor * max(range_m, 0.75) ** 2, [range_m] * 5)
    assert reasons[3:] == ["in_band", "in_band"], reasons


def test_an_approach_never_clips_with_a_forecast():
    # A fifth nearer with every capture: more than half again as bright.
    ranges = list(np.geomspace(3.0, 0.75, 7))
    with_it = follow(0.016, ranges, lead=True)
    assert "clipped" not in with_it
    assert "nothing_seen" not in with_it
    assert "clipped" in follow(0.016, ranges, lead=False)


def alone(range_m: float, exposure_s: float, rng: np.random.Generator, config: UvgsConfig) -> np.ndarray:
    """Area, peak over background and clipped area of one LED, mean over its place within a pixel."""
    rows = []
    for _ in range(8):
        centre = np.array([[*rng.uniform(-0.5, 0.5, 2) * range_m / FOCAL_PX, range_m]])
        image = RENDERER.expose([Emitter(centre, AXIS[None], 180.0, 0.005)], [], exposure_s, rng)
        blobs = find_blobs(Capture(image, 0), config)
        assert not isinstance(blobs, NoBlobs)
        assert len(blobs) == 1
        rows.append((blobs.area_px2[0], (blobs.peak_dn[0] - np.median(image)) / 255.0, blobs.clipped_px2[0]))
    return np.mean(rows, axis=0)


@pytest.mark.parametrize(
    ("range_m", "exposure_ms"),
    [(0.15, 4), (0.15, 40), (0.25, 12), (0.5, 1), (0.5, 12), (0.75, 4), (1, 12), (1.5, 4), (1.5, 40), (2, 4), (3, 12)],
)
def test_areas_and_peaks_are_as_forecast(range_m, exposure_ms):
    rng = np.random.default_rng(int(100 * range_m + exposure_ms))
    config = UvgsConfig()
    _, height, _ = alone(1.0, 0.004, rng, config)
    model = SaturationModel(0.005, FOCAL_PX, CAMERA.psf_sigma_px, 1.0, 0.004, height, 8.0 / 255.0)
    area, peak, clipped = alone(range_m, exposure_ms / 1e3, rng, config)
    # The ambient light of the scene is exposed with the LED; black stays.
    background = (CAMERA.black_dn + CAMERA.background_dn * exposure_ms / CAMERA.peak_exposure_ms) / 255.0
    expected = replace(model, background=background).forecast(range_m, exposure_ms / 1e3, config)
    assert expected.area_px2 == pytest.approx(area, rel=0.10)
    assert expected.peak == pytest.approx(peak, rel=0.10)
    # A pixel clips or does not: a rim of half a pixel is what counting cannot tell.
    assert expected.clipped_px2 == pytest.approx(clipped, rel=0.10, abs=0.5 * np.sqrt(4 * np.pi * max(clipped, 1.0)))


def test_warned_ranges_are_where_pictures_change():
    rng = np.random.default_rng(3)
    config = UvgsConfig(max_area_px2=300.0)
    _, height, _ = alone(1.0, 0.004, rng, config)
    model = SaturationModel(0.005, FOCAL_PX, CAMERA.psf_sigma_px, 1.0, 0.004, height, 8.0 / 255.0)
    limits = {limit.reason: limit for limit in model.limits(0.007, 0.1, 12.0, 0.02, config)}
    assert set(limits) == {"clips", "too_large", "merges", "too_dim"}
    assert [limits[k].side for k in ("clips", "too_large", "merges", "too_dim")] == [
        "nearer", "nearer", "farther", "farther",
    ]  # fmt: skip
    edge = limits["clips"].range_m
    assert alone(0.88 * edge, 0.007, rng, config)[2] > 0.0
    assert alone(1.12 * edge, 0.007, rng, config)[2] == 0.0
    edge = limits["too_large"].range_m
    assert alone(0.95 * edge, 0.007, rng, config)[0] > 300.0
    assert alone(1.05 * edge, 0.007, rng, config)[0] < 300.0
    far = limits["too_dim"].range_m
    assert model.height(1.05 * far, 0.007) < config.min_contrast < model.height(0.95 * far, 0.007)
