from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.sensor import Capture, UvgsConfig
from uvgs_bench.sensor.blobs import Blobs, NoBlobs, find_blobs

CENTRES = np.array([[100.3, 80.7], [400.0, 300.5], [1200.9, 900.2], [16.2, 47.9], [640.4, 16.0]])
PIPELINES = ["fast", pytest.param("paper", marks=pytest.mark.opencv)]


def nearest(blobs: Blobs, centres: np.ndarray) -> np.ndarray:
    distance = np.linalg.norm(blobs.centroid_px[:, None] - centres[None], axis=2)
    assert (distance.min(axis=0) < 1.0).all()
    return distance.argmin(axis=0)


@pytest.mark.parametrize("detection", PIPELINES)
def test_both_pipelines_find_the_same_spots_and_nothing_else(detection):
    image = spots.draw(CENTRES, np.random.default_rng(1))
    blobs = find_blobs(Capture(image, 0), UvgsConfig(detection=detection))
    assert len(blobs) == len(CENTRES)
    order = nearest(blobs, CENTRES)
    # Noise is 0.009 px per axis; four of its deviations.
    assert np.abs(blobs.centroid_px[order] - CENTRES).max() < 0.036
    assert (blobs.circularity > 0.7).all()
    assert not blobs.on_edge.any()
    assert np.isnan(blobs.hue_deg).all()


@pytest.mark.opencv
def test_decimation_maps_centroids_back_without_shift():
    image = spots.draw(CENTRES, np.random.default_rng(1), sigma_px=3.0)
    config = UvgsConfig(detection="paper", alpha=0.5, centroid="binary")
    blobs = find_blobs(Capture(image, 0), config)
    order = nearest(blobs, CENTRES)
    error = blobs.centroid_px[order] - CENTRES
    # Binary centroids of half-size blobs scatter by some tenths of a pixel; without the half pixel all shift by 0.5.
    assert np.abs(error).max() < 0.4
    assert np.abs(error.mean(axis=0)).max() < 0.2


def test_weighted_centroids_beat_binary_ones_several_times():
    rng = np.random.default_rng(2)
    centres = np.stack(np.meshgrid(np.arange(60, 1240, 90.0), np.arange(60, 920, 90.0)), -1).reshape(-1, 2)
    centres += rng.uniform(-0.5, 0.5, centres.shape)
    capture = Capture(spots.draw(centres, rng), 0)
    rms = {}
    for kind in ("weighted", "binary"):
        blobs = find_blobs(capture, UvgsConfig(centroid=kind))
        error = blobs.centroid_px[nearest(blobs, centres)] - centres
        rms[kind] = float(np.sqrt((error**2).mean()))
    assert rms["weighted"] < 0.02
    assert rms["binary"] > 3.0 * rms["weighted"]


def test_deviations_of_centroids_are_true():
    rng = np.random.default_rng(5)
    centres = np.stack(np.meshgrid(np.arange(40, 1250, 80.0), np.arange(40, 930, 80.0)), -1).reshape(-1, 2)
    z = []
    for peak, sigma in ((180.0, 1.0), (60.0, 1.4), (200.0, 3.0)):
        true = centres + rng.uniform(-0.5, 0.5, centres.shape)
        blobs = find_blobs(Capture(spots.draw(true, rng, peak, sigma), 0), UvgsConfig())
        order = nearest(blobs, true)
        z.append((blobs.centroid_px[order] - true) / blobs.sigma_px[order, None])
    square = float((np.concatenate(z) ** 2).mean())
    # 1152 numbers: the mean square of a unit normal scatters by sqrt(2 / 1152) = 0.042; three of it.
    assert abs(square - 1.0) < 0.125


def test_clipped_spots_keep_their_centre():
    rng = np.random.default_rng(6)
    image = spots.draw(CENTRES[:3], rng, peak_dn=900.0, sigma_px=2.5)
    blobs = find_blobs(Capture(image, 0), UvgsConfig())
    assert (blobs.clipped_px2 > 10).all()
    assert np.abs(blobs.centroid_px[nearest(blobs, CENTRES[:3])] - CENTRES[:3]).max() < 0.06


def test_a_blob_of_a_hundred_pixels_across_is_one_blob():
    yy, xx = np.mgrid[0:960, 0:1280]
    image = np.full((960, 1280), 10, dtype=np.uint8)
    image[(xx - 500) ** 2 + (yy - 400) ** 2 < 30**2] = 240
    blobs = find_blobs(Capture(image, 0), UvgsConfig())
    assert len(blobs) == 1
    np.testing.assert_allclose(blobs.centroid_px[0], [500, 400], atol=0.01)
    assert blobs.area_px2[0] == pytest.approx(np.pi * 30**2, rel=0.01)
    assert blobs.circularity[0] == pytest.approx(0.9, abs=0.06)  # the outline of a pixel disc is 5 % long


@pytest.mark.parametrize("detection", PIPELINES)
def test_a_dark_picture_has_no_contrast(detection):
    image = spots.draw(np.zeros((0, 2)), np.random.default_rng(1))
    answer = find_blobs(Capture(image, 0), UvgsConfig(detection=detection))
    assert isinstance(answer, NoBlobs)
    assert answer.reason == "no_contrast"


def test_a_bright_even_field_with_noise_gives_no_blobs():
    image = spots.draw(CENTRES[:1], np.random.default_rng(1), background_dn=120.0, read_noise_dn=4.0, peak_dn=100.0)
    blobs = find_blobs(Capture(image, 0), UvgsConfig())
    assert len(blobs) == 1


def test_sixteen_bit_pictures_of_twelve_bits():
    rng = np.random.default_rng(1)
    image = spots.draw(CENTRES, rng, 2800.0, 1.3, 200.0, 16.0, 2.5, dtype=np.uint16, full_scale=4095)
    blobs = find_blobs(Capture(image, 0), UvgsConfig())
    assert np.abs(blobs.centroid_px[nearest(blobs, CENTRES)] - CENTRES).max() < 0.036


@pytest.mark.opencv
@pytest.mark.parametrize(("bgr", "hue"), [((20, 20, 180), 0.0), ((20, 180, 20), 120.0), ((180, 20, 20), 240.0)])
def test_hue_of_coloured_spots(bgr, hue):
    light = spots.draw(CENTRES[:2], None, peak_dn=1000.0, background_dn=0.0, dtype=np.uint16, full_scale=65535) / 1000.0
    image = np.clip(8 + light[..., None] * np.array(bgr), 0, 255).astype(np.uint8)
    blobs = find_blobs(Capture(image, 0), UvgsConfig())
    assert len(blobs) == 2
    apart = (blobs.hue_deg - hue + 180.0) % 360.0 - 180.0
    assert np.abs(apart).max() < 5.0
    assert (blobs.saturation > 0.7).all()
