"""The simulated sensor: light adds up, digits saturate, noise has its stated size, seeds repeat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.sim.render import Emitter, Renderer, Spot, bgr_of_hue, disc_points, emission, peak_density
from uvgs_bench.devices.sim.truth import TrueCamera

# Without noise, and fine enough digits that rounding is nothing: 16 bit, peak in the thousands.
CLEAN = TrueCamera(
    width_px=160,
    height_px=120,
    parameters_px=(1000.0, 1000.0, 80.0, 60.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    bit_depth=16,
    peak_dn_at_1m=20000.0,
    black_dn=0.0,
    background_dn=0.0,
    gain_e_per_dn=1e6,
    full_well_e=1e12,
    read_noise_dn=0.0,
)
EXPOSURE_S = 0.004


def renderer(camera: TrueCamera, seed: int = 1) -> Renderer:
    lens = Lens(camera.model, camera.width_px, camera.height_px, np.array(camera.parameters_px))
    return Renderer(lens, camera, seed)


def emitter(x: float = 0.0, y: float = 0.0, z: float = 1.0, **changes: object) -> Emitter:
    plain = Emitter(np.array([[x, y, z]]), np.array([[0.0, 0.0, -1.0]]), CLEAN.peak_dn_at_1m, diameter_m=0.004)
    return replace(plain, **changes)


def taken(camera: TrueCamera, *lights: Emitter, exposure_s: float = EXPOSURE_S, index: int = 0, seed: int = 1):
    r = renderer(camera, seed)
    return r.expose(lights, [], exposure_s, r.generator(index))


def test_peak_is_what_was_asked_at_one_metre() -> None:
    # A wide point spread makes the pixel's own width (1/12 px^2 of variance against 9) matter by less than 2 %.
    camera = replace(CLEAN, psf_sigma_px=3.0)
    assert taken(camera, emitter()).max() == pytest.approx(CLEAN.peak_dn_at_1m, rel=0.02)


def test_peak_density_is_the_blurred_disc() -> None:
    # A sum over a fine grid instead of the closed form.
    radius, sigma, step = 2.3, 0.9, 0.01
    x, y = np.meshgrid(*[np.arange(-3.0, 3.0, step) + step / 2] * 2)
    inside = x**2 + y**2 < radius**2
    gauss = np.exp(-0.5 * (x**2 + y**2) / sigma**2) / (2.0 * np.pi * sigma**2)
    # The disc's edge crosses cells of the grid: 1e-3.
    assert peak_density(radius, sigma) == pytest.approx(gauss[inside].mean(), rel=1e-3)
    assert peak_density(1e-9, sigma) == pytest.approx(1.0 / (2.0 * np.pi * sigma**2))


def test_light_is_proportional_to_exposure_and_falls_with_the_square_of_distance() -> None:
    once = taken(CLEAN, emitter(z=1.0)).sum(dtype=np.int64)
    # Rounding adds at most half a digit in each of some 300 pixels of 3e5 in all: 1e-3.
    assert taken(CLEAN, emitter(z=1.0), exposure_s=0.5 * EXPOSURE_S).sum(dtype=np.int64) == pytest.approx(
        once / 2, rel=1e-3
    )
    assert taken(CLEAN, emitter(z=2.0)).sum(dtype=np.int64) == pytest.approx(once / 4, rel=1e-3)


def test_light_of_two_adds_up_where_they_overlap() -> None:
    one, other = emitter(x=-0.002), emitter(x=0.002)
    together = taken(CLEAN, one, other).astype(np.int64)
    apart = taken(CLEAN, one).astype(np.int64) + taken(CLEAN, other)
    # Each picture is rounded on its own.
    assert np.abs(together - apart).max() <= 2


def test_an_led_is_dimmer_from_the_side_and_dark_beyond_its_half_angle() -> None:
    def turned(deg: float) -> Emitter:
        axis = np.array([[np.sin(np.radians(deg)), 0.0, -np.cos(np.radians(deg))]])
        return emitter(axis=axis, half_angle_rad=np.radians(70.0), exponent=2.0)

    assert emission(turned(60.0)) == pytest.approx(0.25)
    assert emission(turned(69.9)) > 0.0
    assert emission(turned(70.1)) == 0.0
    assert emission(turned(180.0)) == 0.0
    assert taken(CLEAN, turned(75.0)).max() == 0
    assert emission(emitter(axis=None)) == 1.0


def test_disc_points_have_the_disc_s_centre_and_spread() -> None:
    light = emitter(x=0.1, y=-0.2, z=0.7, axis=np.array([[0.6, 0.0, -0.8]]))
    points, weight = disc_points(light, 4)
    offset = points[0] - light.centre_m[0]
    assert weight.sum() == pytest.approx(1.0, abs=1e-12)
    assert np.abs(weight @ offset).max() < 1e-15
    assert np.abs(offset @ [0.6, 0.0, -0.8]).max() < 1e-15
    # A uniform disc has the second moment r^2 / 2 in all; the rings with their points miss only the cells' own size.
    assert weight @ (offset**2).sum(axis=1) == pytest.approx(0.5 * 0.002**2, rel=0.01)


def test_full_well_and_converter_clip() -> None:
    small_well = replace(CLEAN, full_well_e=5000.0 * CLEAN.gain_e_per_dn, black_dn=7.0)
    assert taken(small_well, emitter()).max() == 5007
    eight_bit = replace(CLEAN, bit_depth=8)
    image = taken(eight_bit, emitter())
    assert image.dtype == np.uint8
    assert image.max() == 255


def test_noise_has_the_stated_variance() -> None:
    camera = replace(
        CLEAN,
        bit_depth=12,
        width_px=400,
        height_px=300,
        black_dn=50.0,
        background_dn=90.0,
        gain_e_per_dn=5.0,
        read_noise_dn=2.0,
    )
    image = taken(camera).astype(np.float64)
    # Shot noise 90/5, read noise 4, rounding 1/12; 120000 pixels know a variance to sqrt(2/n) = 0.4 %, a mean to 0.014.
    assert image.var() == pytest.approx(90.0 / 5.0 + 4.0 + 1.0 / 12.0, rel=0.016)
    assert image.mean() == pytest.approx(140.0, abs=0.056)


def test_noise_near_a_light_has_the_stated_variance() -> None:
    camera = replace(CLEAN, psf_sigma_px=2.0, peak_dn_at_1m=500.0, gain_e_per_dn=2.0, read_noise_dn=3.0, black_dn=20.0)
    r = renderer(camera)
    light = emitter(peak_dn_at_1m=500.0)
    stack = np.array(
        [r.expose([light], [], EXPOSURE_S, r.generator(i))[58:63, 78:83] for i in range(400)], dtype=np.float64
    )
    mean = stack.mean(axis=0)
    expected = (mean - 20.0) / 2.0 + 9.0 + 1.0 / 12.0
    # 25 pixels times 400 pictures: sqrt(2/10000) = 1.4 %, three times that.
    assert (stack.var(axis=0, ddof=1) / expected).mean() == pytest.approx(1.0, abs=0.042)


def test_the_same_seed_gives_the_same_pixels_and_another_does_not() -> None:
    camera = replace(CLEAN, gain_e_per_dn=5.0, background_dn=30.0, read_noise_dn=1.0)
    first = taken(camera, emitter(), index=3)
    assert np.array_equal(first, taken(camera, emitter(), index=3))
    assert not np.array_equal(first, taken(camera, emitter(), index=4))
    assert not np.array_equal(first, taken(camera, emitter(), index=3, seed=2))


def test_a_renderer_forgets_the_last_picture() -> None:
    r = renderer(CLEAN)
    r.expose([emitter()], [Spot(20.0, 30.0, 900.0, 1.0)], EXPOSURE_S, r.generator(0))
    assert r.expose([], [], EXPOSURE_S, r.generator(1)).max() == 0


def test_lights_outside_or_behind_leave_no_trace() -> None:
    assert taken(CLEAN, emitter(x=3.0), emitter(z=-1.0), emitter(y=-0.3)).max() == 0


def test_glints_stand_where_they_are_put() -> None:
    r = renderer(CLEAN)
    image = r.expose([], [Spot(41.0, 17.0, 3000.0, 2.0)], EXPOSURE_S, r.generator(0))
    assert np.unravel_index(image.argmax(), image.shape) == (17, 41)
    # The pixel integrates over 1 px of a spot of sigma 2 px: 1/(12 * 4) lower.
    assert image.max() == pytest.approx(3000.0, rel=0.03)


@pytest.mark.parametrize(
    ("hue", "brightest"), [("red", 2), ("green", 1), ("blue", 0), ((350.0, 10.0), 2), ((100.0, 140.0), 1)]
)
def test_colour_goes_into_its_channel(hue: str | tuple[float, float], brightest: int) -> None:
    image = taken(replace(CLEAN, is_colour=True), emitter(hue=hue))
    totals = image.sum(axis=(0, 1), dtype=np.int64)
    assert image.shape == (120, 160, 3)
    assert totals.argmax() == brightest
    others = np.delete(totals, brightest)
    assert others.max() < 0.1 * totals[brightest]


def test_white_is_equal_in_all_channels() -> None:
    assert np.array_equal(bgr_of_hue("white"), np.ones(3))
    assert np.array_equal(bgr_of_hue("any"), np.ones(3))
