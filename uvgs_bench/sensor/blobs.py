"""Stage 2: from a picture to its bright blobs, by two pipelines with the same output."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor import centroid_kernels as ck
from uvgs_bench.sensor import detection_kernels as dk
from uvgs_bench.sensor import peak_kernels as pk
from uvgs_bench.sensor.background_kernels import background_and_noise
from uvgs_bench.sensor.capture import Capture, ImageArray
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.mosaic import mosaic_sigma
from uvgs_bench.sensor.preprocess import intensity, segment

MAX_COMPONENTS = 256
# A binary centroid is off by the pixel grid, not by noise: about 0.3 px over the root of the diameter.
_BINARY_SIGMA_PX = 0.3
# Of a million pixels of pure noise, one or two exceed this many deviations.
_PEAK_TO_NOISE = 5.0
# Bumps of a texture that fills most of the picture are seldom higher above its dark places.
_PEAK_TO_TEXTURE = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Blobs:
    """Bright blobs of one picture, one row each.

    Args:
        centroid_px: Centres, shape (n, 2), raw (distorted) px; pixel (0, 0) is the centre of the top-left pixel.
        sigma_px: Standard deviation of each centre per axis, shape (n,), px.
        area_px2: Pixels of the binary blob, shape (n,), px^2.
        circularity: 4 pi area / perimeter^2, shape (n,).
        box_px: x0, y0, x1, y1 inclusive, shape (n, 4), px.
        hue_deg: Hue of the light in [0, 360), shape (n,); NaN in a mono picture or a colourless blob.
        saturation: HSV saturation of the light, 0 to 1, shape (n,); NaN in a mono picture.
        peak_dn: Brightest pixel, shape (n,), DN.
        clipped_px2: Pixels at full scale, shape (n,).
        on_edge: Whether the blob touches the border of the picture, shape (n,).
        width_px: Deviation of a Gaussian as wide as the spot, shape (n,), px.
    """

    centroid_px: FloatArray
    sigma_px: FloatArray
    area_px2: FloatArray
    circularity: FloatArray
    box_px: FloatArray
    hue_deg: FloatArray
    saturation: FloatArray
    peak_dn: FloatArray
    clipped_px2: FloatArray
    on_edge: np.ndarray[tuple[int], np.dtype[np.bool_]]
    width_px: FloatArray

    def __len__(self) -> int:
        return len(self.area_px2)

    @property
    def aspect(self) -> FloatArray:
        """Longer over shorter side of the bounding box, shape (n,)."""
        sides = self.box_px[:, 2:] - self.box_px[:, :2] + 1.0
        result: FloatArray = sides.max(axis=1) / sides.min(axis=1)
        return result

    def take(
        self, keep: np.ndarray[tuple[int], np.dtype[np.bool_]] | np.ndarray[tuple[int], np.dtype[np.intp]]
    ) -> Blobs:
        """The blobs chosen by a mask or by indices."""
        return Blobs(
            self.centroid_px[keep],
            self.sigma_px[keep],
            self.area_px2[keep],
            self.circularity[keep],
            self.box_px[keep],
            self.hue_deg[keep],
            self.saturation[keep],
            self.peak_dn[keep],
            self.clipped_px2[keep],
            self.on_edge[keep],
            self.width_px[keep],
        )


@dataclass(frozen=True, slots=True)
class NoBlobs:
    """Why a picture yields nothing to look at.

    Args:
        stage: ``preprocess`` or ``blobs``.
        reason: Stable word.
        detail: One line with the numbers.
    """

    stage: str
    reason: str
    detail: str


def full_scale_dn(image: ImageArray, brightest_dn: float | None = None) -> float:
    """Largest value a pixel can have, DN: of the type, or of 10, 12 or 14 bits when a 16-bit picture stays below."""
    if image.dtype == np.uint8:
        return 255.0
    brightest = int(image.max()) if brightest_dn is None else int(brightest_dn)
    return float(next(top for top in (1023, 4095, 16383, 65535) if brightest <= top))


def full_scale_of(capture: Capture) -> float:
    """Largest value a pixel of a capture can have, DN: as its source says, else as ``full_scale_dn`` finds."""
    return full_scale_dn(capture.image) if capture.full_scale_dn is None else capture.full_scale_dn


def noise_dn(raw: ImageArray) -> float:
    """Deviation of the pixel noise, DN, from neighbours on a sparse grid: a gradient or a few lights do not matter."""
    return background_and_noise(raw, int(raw.max()))[1]


def find_blobs(capture: Capture, config: UvgsConfig) -> Blobs | NoBlobs:
    """All bright blobs of a picture, before any is judged.

    Args:
        capture: The picture.
        config: Pipeline and its parameters.

    Returns:
        The blobs, possibly none, or why there is no point in looking.
    """
    raw = intensity(capture.image)
    maxima = pk.tile_maxima(raw)
    brightest = float(maxima.max())
    stated = capture.full_scale_dn
    full_scale = full_scale_dn(raw, brightest) if stated is None else stated
    background, noise, texture = background_and_noise(raw, int(brightest))
    # Before a bright wall lights stand out from what is dark about them.
    contrast = brightest - min(background, float(maxima.min()))
    if contrast < config.min_contrast * full_scale:
        return NoBlobs(
            "preprocess",
            "no_contrast",
            f"brightest pixel {brightest:.0f} DN is {contrast:.0f} DN above the background, "
            f"needs {config.min_contrast * full_scale:.0f} DN",
        )
    if config.detection == "paper":
        found = _components_of_segmentation(raw, config)
    else:
        floor = _floor_dn(contrast, noise, texture, config)
        table = np.empty((MAX_COMPONENTS, dk.COMPONENT_COLUMNS))
        count = dk.find_components(
            raw, maxima, config.window_px // 2, config.threshold_k, floor, config.threshold_floor,
            int(2.0 * config.max_area_px2), table,
        )  # fmt: skip
        found = table[:count] if count >= 0 else None
    if found is None:
        return NoBlobs("blobs", "too_many_blobs", f"more than {MAX_COMPONENTS} bright places or {pk.MAX_PEAKS} peaks")
    blobs = _measure(capture.image, raw, found, full_scale, config)
    if capture.bayer is None:
        return blobs
    return replace(blobs, sigma_px=mosaic_sigma(blobs.sigma_px, blobs.width_px, blobs.hue_deg))


def _floor_dn(contrast: float, noise: float, texture: float, config: UvgsConfig) -> float:
    """Least height of a light above its surroundings, DN."""
    return max(config.threshold_floor * contrast, _PEAK_TO_NOISE * noise, _PEAK_TO_TEXTURE * texture)


def bright_tiles(capture: Capture, config: UvgsConfig) -> NDArray[np.bool_]:
    """Tiles in which the fast pipeline looks for lights: above the darkest tile of their surroundings. For people.

    Args:
        capture: The picture.
        config: Its parameters.

    Returns:
        Shape (ceil(H / 8), ceil(W / 8)).
    """
    import cv2

    raw = intensity(capture.image)
    maxima = pk.tile_maxima(raw)
    background, noise, texture = background_and_noise(raw, int(maxima.max()))
    contrast = float(maxima.max()) - min(background, float(maxima.min()))
    side = 2 * pk.tiles_around(config.window_px // 2) + 1
    darkest = cv2.erode(maxima, np.ones((side, side), dtype=np.uint8))
    above = maxima.astype(np.int64) - darkest
    return np.asarray(above > int(_floor_dn(contrast, noise, texture, config)))


def _components_of_segmentation(raw: ImageArray, config: UvgsConfig) -> FloatArray | None:
    """Connected components (8 neighbours) of the paper's binary picture with outer contours, in raw pixels."""
    import cv2

    picture = segment(raw, config)
    count, labels, stats, centres = cv2.connectedComponentsWithStats(picture.binary, connectivity=8)
    if count - 1 > MAX_COMPONENTS:
        return None
    table = np.zeros((count - 1, dk.COMPONENT_COLUMNS))
    sx, sy = picture.scale_x, picture.scale_y
    height, width = raw.shape
    for i in range(1, count):
        x, y, w, h, area = (int(v) for v in stats[i])
        part = np.ascontiguousarray((labels[y : y + h, x : x + w] == i).astype(np.uint8))
        contours, _ = cv2.findContours(part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        # The contour runs through pixel centres; the outline lies half a pixel outside: pi more for any convex one.
        perimeter = (cv2.arcLength(contours[0], True) + pi) / np.sqrt(sx * sy)
        raw_area = area / (sx * sy)
        cx, cy = (centres[i][0] + 0.5) / sx - 0.5, (centres[i][1] + 0.5) / sy - 0.5
        x0, x1 = (x - 0.0) / sx, (x + w) / sx - 1.0
        y0, y1 = (y - 0.0) / sy, (y + h) / sy - 1.0
        table[i - 1] = (
            raw_area, cx * raw_area, cy * raw_area,
            max(0.0, np.floor(x0)), max(0.0, np.floor(y0)),
            min(width - 1.0, np.ceil(x1)), min(height - 1.0, np.ceil(y1)), perimeter,
        )  # fmt: skip
    return table


def _measure(image: ImageArray, raw: ImageArray, table: FloatArray, full_scale: float, config: UvgsConfig) -> Blobs:
    """Centroids, deviations and colours of components. What no gate lets pass keeps its binary centroid."""
    table = table[table[:, dk.AREA] >= 0.5 * config.min_area_px2]
    area = table[:, dk.AREA].copy()
    boxes = np.ascontiguousarray(table[:, dk.X0 : dk.Y1 + 1])
    circularity = 4.0 * pi * area / np.maximum(table[:, dk.PERIMETER], 1e-9) ** 2
    gain = config.gain_e_per_dn * 255.0 / full_scale
    fit = (area <= config.max_area_px2) & (circularity >= config.min_circularity)
    measured = np.empty((len(table), ck.MEASURE_COLUMNS))
    ck.measure_blobs(raw, boxes, fit, gain, full_scale, measured)
    binary = table[:, (dk.SUM_X, dk.SUM_Y)] / area[:, None]
    binary_sigma = _BINARY_SIGMA_PX / np.sqrt(np.maximum(2.0 * np.sqrt(area / pi), 1.0))
    weighted = np.isfinite(measured[:, ck.CX])
    if config.centroid == "binary":
        weighted = np.zeros(len(table), dtype=bool)
    centroid = np.where(weighted[:, None], measured[:, (ck.CX, ck.CY)], binary)
    sigma = np.where(weighted, measured[:, ck.SIGMA], binary_sigma)
    height, width = raw.shape
    on_edge = (boxes[:, 0] <= 0) | (boxes[:, 1] <= 0) | (boxes[:, 2] >= width - 1) | (boxes[:, 3] >= height - 1)
    hue, saturation = _colours(image, boxes, full_scale)
    width_px = np.where(weighted, measured[:, ck.WIDTH] / ck.WINDOW_RATIO, np.sqrt(area / ck.HALF_AREA))
    return Blobs(
        centroid, sigma, area, circularity, boxes, hue, saturation,
        measured[:, ck.PEAK].copy(), measured[:, ck.CLIPPED].copy(), on_edge, width_px,
    )  # fmt: skip


def _colours(image: ImageArray, boxes: FloatArray, full_scale: float) -> tuple[FloatArray, FloatArray]:
    """Hue and saturation of the light of each blob, from unclipped pixels above the darkest of its surroundings."""
    hue = np.full(len(boxes), np.nan)
    saturation = np.full(len(boxes), np.nan)
    if image.ndim == 2:
        return hue, saturation
    for i, (x0, y0, x1, y1) in enumerate(boxes.astype(int)):
        part = image[max(0, y0 - 2) : y1 + 3, max(0, x0 - 2) : x1 + 3].reshape(-1, 3).astype(np.float64)
        tenth = len(part) // 10
        dark = np.partition(part, tenth, axis=0)[tenth]
        open_pixels = part[(part < full_scale).all(axis=1)]
        blue, green, red = np.maximum((open_pixels - dark).sum(axis=0), 0.0)
        high, low = max(blue, green, red), min(blue, green, red)
        if high <= 0.0:
            continue
        chroma = high - low
        saturation[i] = chroma / high
        if chroma <= 0.05 * high:
            continue
        if high == red:
            sector = ((green - blue) / chroma) % 6.0
        elif high == green:
            sector = (blue - red) / chroma + 2.0
        else:
            sector = (red - green) / chroma + 4.0
        hue[i] = 60.0 * sector
    return hue, saturation
