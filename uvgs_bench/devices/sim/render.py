"""From true lights before the true lens to the pixels of a capture.

An emitter is a disc, sampled by points; each point goes through the lens and becomes a Gaussian spot (the point spread)
integrated over pixels; light is summed over instants of the exposure, turned into electrons with shot noise, limited
by the full well, read with noise and digitised. Only pixels near lights are computed; elsewhere the picture is a
background that was drawn once with the same noise and is shifted at random for every capture.
"""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, cos, exp, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.sim.render_kernels import add_spots
from uvgs_bench.devices.sim.truth import TrueCamera
from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor.capture import ImageArray
from uvgs_bench.units import m_from_mm, ms_from_s

DEFAULT_DIAMETER_M = m_from_mm(3.0)
"""Of an emitter whose diameter is not said, m."""

# Points of a disc lie closer than this many standard deviations of the point spread, so that no ripple remains.
_POINT_SPACING_SIGMA = 0.8
_MAX_RINGS = 12
_READ_OUT_PX = 1 << 16
_LEAKED_COLOUR = 0.06
_HUES_DEG = {"red": 0.0, "green": 120.0, "blue": 240.0}


@dataclass(frozen=True, slots=True, eq=False)
class Emitter:
    """A shining disc during one exposure.

    Args:
        centre_m: Its centre at S instants, camera axes, shape (S, 3), m.
        axis: Unit vector it shines along at these instants, camera axes, shape (S, 3), or None when it always faces
            the camera and shines everywhere.
        peak_dn_at_1m: Grey value of its centre from 1 m on its axis at the exposure the camera's truth names, DN.
        diameter_m: Its diameter, m.
        half_angle_rad: Angle from the axis beyond which it cannot be seen, rad, or None.
        exponent: It shines as the cosine to its axis to this power.
        hue: ``any``, ``white``, ``red``, ``green``, ``blue``, or a range in degrees.
    """

    centre_m: FloatArray
    axis: FloatArray | None
    peak_dn_at_1m: float
    diameter_m: float = DEFAULT_DIAMETER_M
    half_angle_rad: float | None = None
    exponent: float = 1.0
    hue: str | tuple[float, float] = "any"


@dataclass(frozen=True, slots=True)
class Spot:
    """A glint: a Gaussian spot at a place in the picture.

    Args:
        u_px: Column, px.
        v_px: Row, px.
        peak_dn: Grey value of its centre, DN.
        sigma_px: Its standard deviation, px.
    """

    u_px: float
    v_px: float
    peak_dn: float
    sigma_px: float


class Renderer:
    """The sensor behind the true lens.

    Args:
        lens: The true lens.
        camera: The true camera.
        seed: Seed of all noise; the same seed, capture number and lights give the same pixels.
    """

    def __init__(self, lens: Lens, camera: TrueCamera, seed: int) -> None:
        self.lens = lens
        self.camera = camera
        self.seed = seed
        self.channels = 3 if camera.is_colour else 1
        self._light = np.zeros((camera.height_px, camera.width_px, self.channels))
        self._background: dict[float, NDArray[np.uint8] | NDArray[np.uint16]] = {}

    def generator(self, index: int) -> np.random.Generator:
        """The source of everything random in a capture."""
        return np.random.default_rng((self.seed, 2, index))

    def expose(
        self, emitters: Sequence[Emitter], spots: Sequence[Spot], exposure_s: float, rng: np.random.Generator
    ) -> ImageArray:
        """Take a picture.

        Args:
            emitters: The lights.
            spots: The glints; their grey value does not depend on the exposure.
            exposure_s: Exposure, s.
            rng: Source of the noise.

        Returns:
            Mono (H, W) or BGR (H, W, 3), uint8, or uint16 for more than 8 bit.
        """
        gain = ms_from_s(exposure_s) / self.camera.peak_exposure_ms
        boxes = [self._add(emitter, gain) for emitter in emitters]
        boxes += [self._add_spot(spot) for spot in spots]
        image = self._shifted_background(gain, rng)
        boxes = [box for box in boxes if box[0] < box[1] and box[2] < box[3]]
        for top, bottom, left, right in boxes:
            window = (slice(top, bottom), slice(left, right))
            image[window] = read_out(self._light[window] + self.camera.background_dn * gain, self.camera, rng)
        for top, bottom, left, right in boxes:
            self._light[top:bottom, left:right] = 0.0
        return image if self.channels == 3 else image[:, :, 0]

    def _add(self, emitter: Emitter, gain: float) -> tuple[int, int, int, int]:
        points_m, weight = disc_points(emitter, self._rings(emitter))
        distance_m = np.linalg.norm(points_m, axis=-1)
        focal_px = sqrt(self.lens.fx_px * self.lens.fy_px)
        total = emitter.peak_dn_at_1m / peak_density(0.5 * emitter.diameter_m * focal_px, self.camera.psf_sigma_px)
        share = emission(emitter)[:, None] * weight[None, :] / len(points_m)
        amount = np.ascontiguousarray((gain * total * share / distance_m**2).reshape(-1))
        px = self.lens.project(points_m.reshape(-1, 3))
        return add_spots(self._light, px, amount, self._colour(emitter.hue), self.camera.psf_sigma_px)

    def _rings(self, emitter: Emitter) -> int:
        nearest_m = float(np.linalg.norm(emitter.centre_m, axis=-1).min())
        radius_px = 0.5 * emitter.diameter_m * self.lens.fx_px / max(nearest_m, emitter.diameter_m)
        return int(np.clip(ceil(radius_px / (_POINT_SPACING_SIGMA * self.camera.psf_sigma_px)), 2, _MAX_RINGS))

    def _add_spot(self, spot: Spot) -> tuple[int, int, int, int]:
        amount = np.array([spot.peak_dn * 2.0 * pi * spot.sigma_px**2])
        return add_spots(self._light, np.array([[spot.u_px, spot.v_px]]), amount, self._colour("white"), spot.sigma_px)

    def _colour(self, hue: str | tuple[float, float]) -> FloatArray:
        return bgr_of_hue(hue) if self.channels == 3 else np.ones(1)

    def _shifted_background(self, gain: float, rng: np.random.Generator) -> NDArray[np.uint8] | NDArray[np.uint16]:
        if gain not in self._background:
            dark = np.full(self._light.shape, self.camera.background_dn * gain)
            self._background = {gain: read_out(dark, self.camera, np.random.default_rng((self.seed, 3)))}
        shift = tuple(int(n) for n in rng.integers(0, self._light.shape[:2]))
        return np.roll(self._background[gain], shift, axis=(0, 1))


def read_out(
    light_dn: FloatArray, camera: TrueCamera, rng: np.random.Generator
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Light to digits: shot noise, full well, read noise, converter.

    Args:
        light_dn: Expected light, any shape, DN.
        camera: The true sensor.
        rng: Source of the noise.

    Returns:
        Values of the same shape, uint8, or uint16 for more than 8 bit.
    """
    light, gain = light_dn.reshape(-1), camera.gain_e_per_dn
    # From 100 electrons on a normal distribution is as good and much faster.
    is_dim = bool(light.min() * gain < 100.0)
    largest = (1 << camera.bit_depth) - 1
    electrons = np.empty(light.size)
    value: NDArray[np.uint8] | NDArray[np.uint16] = np.empty(light.size, dtype=np.uint8)
    if camera.bit_depth > 8:
        value = np.empty(light.size, dtype=np.uint16)
    # Part by part: a whole picture in floats, six times over, would be most of the memory of a run.
    parts = [slice(start, start + _READ_OUT_PX) for start in range(0, light.size, _READ_OUT_PX)]
    for part in parts:
        mean = light[part] * gain
        shot = rng.poisson(mean) if is_dim else mean + np.sqrt(mean) * rng.standard_normal(mean.shape)
        electrons[part] = np.minimum(shot, camera.full_well_e)
    for part in parts:
        read = camera.read_noise_dn * rng.standard_normal(electrons[part].shape)
        value[part] = np.rint(np.clip(camera.black_dn + electrons[part] / gain + read, 0, largest))
    return value.reshape(light_dn.shape)


def disc_points(emitter: Emitter, rings: int) -> tuple[FloatArray, FloatArray]:
    """Points of the disc for a sum over its area.

    Args:
        emitter: The emitter.
        rings: Rings around the central point; ring k has 6 k points.

    Returns:
        Points, camera axes, shape (S, K, 3), m; weights that sum to 1, shape (K,).
    """
    step = 0.5 * emitter.diameter_m / (2 * rings + 1)
    radius, angle = [0.0], [0.0]
    for k in range(1, rings + 1):
        radius += [step * sqrt(0.5 * ((2 * k + 1) ** 2 + (2 * k - 1) ** 2))] * (6 * k)
        angle += [2.0 * pi * n / (6 * k) for n in range(6 * k)]
    weight = np.full(len(radius), 4.0 / 3.0) / (2 * rings + 1) ** 2
    weight[0] = 1.0 / (2 * rings + 1) ** 2
    normal = -emitter.centre_m if emitter.axis is None else emitter.axis
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    # Any vector that is not the normal spans the disc with it.
    other = np.where(np.abs(normal[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normal, other)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = np.cross(normal, first)
    r, phi = np.array(radius)[None, :, None], np.array(angle)[None, :, None]
    points = emitter.centre_m[:, None] + r * (np.cos(phi) * first[:, None] + np.sin(phi) * second[:, None])
    return points, weight


def emission(emitter: Emitter) -> FloatArray:
    """Brightness towards the camera at each instant: 1 on the axis, 0 beyond the half angle, shape (S,)."""
    if emitter.axis is None:
        return np.ones(len(emitter.centre_m))
    towards = -emitter.centre_m / np.linalg.norm(emitter.centre_m, axis=-1, keepdims=True)
    cosine = np.einsum("si,si->s", emitter.axis, towards)
    limit = 0.0 if emitter.half_angle_rad is None else max(0.0, cos(emitter.half_angle_rad))
    return np.where(cosine > limit, np.clip(cosine, 0.0, 1.0) ** emitter.exponent, 0.0)


def peak_density(radius_px: float, sigma_px: float) -> float:
    """Light at the centre of a blurred disc of total light 1, per px^2.

    Source: the integral of a Gaussian over a disc, (1 - exp(-a^2 / 2 s^2)) / (pi a^2).
    """
    x = 0.5 * (radius_px / sigma_px) ** 2
    return (1.0 - exp(-x)) / (2.0 * pi * sigma_px**2 * x) if x > 1e-9 else 1.0 / (2.0 * pi * sigma_px**2)


def bgr_of_hue(hue: str | tuple[float, float]) -> FloatArray:
    """What the three channels see of a light: its own channels fully, the others a little.

    Args:
        hue: ``any`` and ``white`` are white; a range in degrees (may wrap) means its middle.

    Returns:
        Blue, green, red, shape (3,), largest 1.
    """
    if isinstance(hue, str):
        if hue not in _HUES_DEG:
            return np.ones(3)
        degrees = _HUES_DEG[hue]
    else:
        low, high = hue
        degrees = low + 0.5 * ((high - low) % 360.0)
    red, green, blue = colorsys.hsv_to_rgb((degrees % 360.0) / 360.0, 1.0 - _LEAKED_COLOUR, 1.0)
    return np.array([blue, green, red])
