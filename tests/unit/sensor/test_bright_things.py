"""Lights beside, before and among bright things that are no lights."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from tests.helpers import spots
from uvgs_bench.sensor import Capture, UvgsConfig
from uvgs_bench.sensor.blobs import Blobs, bright_tiles, find_blobs

SIZE = (640, 480)
LEDS = np.array([[120.3, 150.7], [200.2, 210.1], [165.9, 260.4], [150.1, 202.6]])
CONFIG = UvgsConfig()
YY, XX = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]


def picture(scene: np.ndarray, seed: int, leds: np.ndarray = LEDS, peak_dn: float = 170.0) -> np.ndarray:
    """LEDs on a scene, shot noise at 40 e/DN and read noise of 1 DN."""
    light = spots.draw(leds, None, peak_dn * 100.0, 1.3, 0.0, size=SIZE, dtype=np.uint16, full_scale=65535) / 100.0
    mean = light + scene
    noise = np.random.default_rng(seed).standard_normal(mean.shape) * np.sqrt(1.0 + mean / 40.0)
    return np.clip(np.rint(mean + noise), 0, 255).astype(np.uint8)


def texture(deviation_dn: float, length_px: float, seed: int = 1) -> np.ndarray:
    """Gaussian blotches."""
    field = gaussian_filter(np.random.default_rng(seed).standard_normal(YY.shape), length_px)
    return field / field.std() * deviation_dn


def errors_over_sigmas(blobs: Blobs, leds: np.ndarray = LEDS) -> np.ndarray:
    distance = np.linalg.norm(blobs.centroid_px[:, None] - leds[None], axis=2)
    nearest = distance.argmin(axis=0)
    error = blobs.centroid_px[nearest] - leds
    return np.asarray(error / blobs.sigma_px[nearest, None])


def modules() -> np.ndarray:
    """White squares of 27 px on black, in a white sheet: a tag from near."""
    cells = np.random.default_rng(4).integers(0, 2, (6, 6))
    sheet = np.zeros((10, 10))
    sheet[[0, -1]], sheet[:, [0, -1]] = 1.0, 1.0
    sheet[2:8, 2:8] = cells
    out = np.full(YY.shape, 35.0)
    out[100:370, 340:610] = 12.0 + 150.0 * np.kron(sheet, np.ones((27, 27)))
    return gaussian_filter(out, 0.9)


MOUNTS = np.logical_or.reduce([(XX - u) ** 2 + (YY - v) ** 2 < 18**2 for u, v in LEDS])
SCENES = {
    "clipped window": np.where((XX > 300) & (YY > 60) & (YY < 420), 400.0, 12.0),
    "open window": np.where((XX > 300) & (YY > 60) & (YY < 420), 160.0, 12.0),
    "panel 11 px beside": np.where(XX > 211, 210.0, 12.0),
    "panel 20 px beside": np.where(XX > 220, 110.0, 12.0),
    "tag sheet": modules(),
    "lamp": 12.0 + 600.0 * np.exp(-0.5 * np.maximum(np.hypot(XX - 450, YY - 240) - 80.0, 0.0) ** 2 / 15.0**2),
    "dark mounts on a dim wall": np.where(MOUNTS, 5.0, 60.0),
    "dark mounts on a wall as bright as they": np.where(MOUNTS, 5.0, 170.0),
    "dark mounts on a brighter wall": np.where(MOUNTS, 5.0, 230.0),
    "textured half": np.where(XX > 320, np.maximum(150.0 + texture(25.0, 3.0), 0.0), 12.0),
    "slope": 12.0 + 0.2 * XX,
}


@pytest.mark.parametrize("name", SCENES)
def test_lights_are_found_beside_and_before_bright_things(name):
    blobs = find_blobs(Capture(picture(SCENES[name], 7), 0), CONFIG)
    assert isinstance(blobs, Blobs)
    # Eight numbers; a true deviation of 1 reaches 4 once in 2000 pictures, and a lost light gives hundreds.
    assert np.abs(errors_over_sigmas(blobs)).max() < 4.0


def test_a_sheet_gives_no_more_blobs_than_it_has_squares():
    blobs = find_blobs(Capture(picture(modules(), 8), 0), CONFIG)
    assert isinstance(blobs, Blobs)
    assert len(blobs) < 20
    # The flat parts of windows and walls give none.
    for name in ("open window", "clipped window", "dark mounts on a brighter wall", "lamp"):
        found = find_blobs(Capture(picture(SCENES[name], 9), 0), CONFIG)
        assert isinstance(found, Blobs)
        assert len(found) == 4


@pytest.mark.parametrize("name", SCENES)
def test_the_tiles_shown_are_those_in_which_lights_are_found(name):
    capture = Capture(picture(SCENES[name], 9), 0)
    blobs, tiles = find_blobs(capture, CONFIG), bright_tiles(capture, CONFIG)
    assert isinstance(blobs, Blobs)
    x0, y0, x1, y1 = (blobs.box_px.T.astype(int)) // 8
    assert all(tiles[a : b + 1, c : d + 1].any() for a, b, c, d in zip(y0, y1, x0, x1, strict=True))
    if name == "open window":
        # The middle of a bright even place is not looked at, only its rim and the four lights are.
        assert tiles.mean() < 0.3


def test_before_a_texture_centroids_say_how_little_they_know():
    squares = []
    for seed in range(12):
        scene = np.maximum(70.0 + texture(12.0, 2.5, seed), 0.0)
        blobs = find_blobs(Capture(picture(scene, seed), 0), CONFIG)
        assert isinstance(blobs, Blobs)
        squares.append(errors_over_sigmas(blobs) ** 2)
    # White noise of the same variance would make this 20 or more; eight places tell a variance only to a factor of 2.
    assert np.median(squares) < 1.2
    assert np.mean(squares) < 4.0


@pytest.mark.parametrize("ratio", [1.0, 0.5])
@pytest.mark.parametrize("apart_px", [5.5, 6.5, 8.0])
def test_two_lights_that_touch_are_two_blobs_with_true_deviations(apart_px, ratio):
    rng = np.random.default_rng(11)
    first = np.stack(np.meshgrid(np.arange(50.0, 600.0, 60.0), np.arange(50.0, 440.0, 60.0)), -1).reshape(-1, 2)
    first += rng.uniform(-0.5, 0.5, first.shape)
    turn = rng.uniform(0.0, 2.0 * np.pi, len(first))
    second = first + apart_px * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    peaks = np.concatenate([np.full(len(first), 170.0), np.full(len(first), 170.0 * ratio)])
    leds = np.concatenate([first, second])
    blobs = find_blobs(Capture(spots.draw(leds, rng, peaks, 1.3, size=SIZE), 0), CONFIG)
    assert isinstance(blobs, Blobs)
    assert len(blobs) == len(leds)
    z = errors_over_sigmas(blobs, leds)
    # 280 numbers; the deviations of near pairs allow for what is left of the neighbour.
    assert np.sqrt((z**2).mean()) < 1.2
    assert np.abs(z).max() < 5.0


@pytest.mark.parametrize("quarters", [1, 2, 3])
@pytest.mark.parametrize("name", ["tag sheet", "dark mounts on a dim wall", "textured half"])
def test_a_turned_picture_has_turned_blobs(name, quarters):
    image = picture(SCENES[name], 3)
    straight = find_blobs(Capture(image, 0), CONFIG)
    turned = find_blobs(Capture(np.ascontiguousarray(np.rot90(image, quarters)), 0), CONFIG)
    assert isinstance(straight, Blobs)
    assert isinstance(turned, Blobs)
    x, y = turned.centroid_px.T
    right, bottom = image.shape[1] - 1.0, image.shape[0] - 1.0
    back = np.stack({1: (right - y, x), 2: (right - x, bottom - y), 3: (y, bottom - x)}[quarters], axis=1)
    distance = np.linalg.norm(back[:, None] - LEDS[None], axis=2)
    order = distance.argmin(axis=0)
    was = np.linalg.norm(straight.centroid_px[:, None] - LEDS[None], axis=2).argmin(axis=0)
    # The same pixels in another order of summation; the centroid iteration stops at 2e-5 px.
    np.testing.assert_allclose(back[order], straight.centroid_px[was], atol=1e-4)
    np.testing.assert_allclose(turned.area_px2[order], straight.area_px2[was])
    np.testing.assert_allclose(turned.sigma_px[order], straight.sigma_px[was], rtol=0.02)
    # Windows are sampled every second row, so that bumps of a texture just at the limit may come and go when turned.
    if name != "textured half":
        assert len(turned) == len(straight)


def test_a_picture_twice_as_large_has_blobs_twice_as_large():
    near = LEDS * 2.0
    small = find_blobs(Capture(spots.draw(LEDS, None, 170.0, 1.5, size=SIZE), 0), CONFIG)
    # The local window is a length as well.
    twice = UvgsConfig(window_px=2 * CONFIG.window_px - 1)
    large = find_blobs(Capture(spots.draw(near, None, 170.0, 3.0, size=(1280, 960)), 0), twice)
    assert isinstance(small, Blobs)
    assert isinstance(large, Blobs)
    np.testing.assert_allclose(np.sort(large.centroid_px[:, 0]), 2.0 * np.sort(small.centroid_px[:, 0]), atol=0.01)
    # Areas count whole pixels: a rim of a pixel on spots of some 50 px^2 is a fifth.
    assert float((large.area_px2 / small.area_px2).mean()) == pytest.approx(4.0, rel=0.2)
