"""What captures show: noise, background, LEDs, other lights; the evidence ``uvgs tune`` proposes parameters from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor.blobs import Blobs, NoBlobs, find_blobs, full_scale_of, noise_dn
from uvgs_bench.sensor.capture import Capture, ImageArray
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.exposure import LightLevel, led_levels
from uvgs_bench.sensor.outcome import Outcome, PoseEstimate
from uvgs_bench.sensor.preprocess import intensity

_SAME_LIGHT_PX = 1.5
_TILES = 12
_GREATEST_AREA_PX2 = 1e5


@dataclass(frozen=True, slots=True)
class SceneNoise:
    """The pictures without their lights.

    Args:
        full_scale_dn: Largest value a pixel can have, DN.
        background_dn: Median of the picture, DN.
        unevenness_dn: How far the background of a part of the picture is from that, 90 % of the parts, DN.
        spatial_dn: Deviation between neighbouring pixels, DN.
        temporal_dn: Deviation of a pixel from capture to capture, DN; NaN with one capture.
        brightest_dn: Brightest pixel of all, DN.
    """

    full_scale_dn: float
    background_dn: float
    unevenness_dn: float
    spatial_dn: float
    temporal_dn: float
    brightest_dn: float

    @property
    def contrast_dn(self) -> float:
        """Brightest pixel over the background, DN."""
        return self.brightest_dn - self.background_dn


@dataclass(frozen=True, slots=True)
class SceneLights:
    """The LEDs of solved captures, and what else shines.

    Args:
        poses: Captures with a pose, which the rest is measured on.
        least_height_dn: Dimmest LED over its surroundings, DN.
        level: Median of the brightest LED's levels, for the exposure; None without a pose.
        least_area_px2: Smallest LED blob, px^2.
        greatest_area_px2: Largest LED blob, px^2.
        least_circularity: Least round LED blob.
        hues_deg: Hues of LED blobs, degrees; empty for mono pictures.
        others: Median number of other bright blobs per capture.
        brightest_other_dn: Brightest other light, DN; 0 without one.
        range_m: Median range of the poses, m; NaN without one.
    """

    poses: int
    least_height_dn: float
    level: LightLevel | None
    least_area_px2: float
    greatest_area_px2: float
    least_circularity: float
    hues_deg: tuple[float, ...]
    others: float
    brightest_other_dn: float
    range_m: float


def measure_noise(captures: Sequence[Capture]) -> SceneNoise:
    """Measure the pictures without their lights.

    Args:
        captures: At least one, all of one size.

    Returns:
        Medians over the captures.
    """
    pictures = [intensity(capture.image) for capture in captures]
    backgrounds = [float(np.median(raw[::7, ::7])) for raw in pictures]
    steps = [_pixel_noise(a, b) for a, b in pairwise(pictures)]
    return SceneNoise(
        max(full_scale_of(capture) for capture in captures),
        float(np.median(backgrounds)),
        float(np.median([_unevenness(raw) for raw in pictures])),
        float(np.median([noise_dn(raw) for raw in pictures])),
        float(np.median(steps)) if steps else float("nan"),
        max(float(raw.max()) for raw in pictures),
    )


def measure_lights(captures: Sequence[Capture], outcomes: Sequence[Outcome], config: UvgsConfig) -> SceneLights:
    """Measure the LEDs of the captures that have a pose, and count what else shines.

    Args:
        captures: The captures.
        outcomes: Their outcomes with this config.
        config: The config the outcomes were solved with.

    Returns:
        The lights; with no pose, only the number of blobs.
    """
    heights: list[float] = []
    areas: list[float] = []
    circularities: list[float] = []
    hues: list[float] = []
    others: list[int] = []
    ranges: list[float] = []
    levels: list[LightLevel] = []
    brightest = 0.0
    # Lights outside the area limits are still lights.
    wide = replace(config, min_area_px2=1.0, max_area_px2=max(config.max_area_px2, _GREATEST_AREA_PX2))
    for capture, outcome in zip(captures, outcomes, strict=True):
        blobs = find_blobs(capture, wide)
        if isinstance(blobs, NoBlobs):
            continue
        is_led = _led_mask(blobs, outcome)
        others.append(int((~is_led).sum()))
        if len(blobs) and not is_led.all():
            brightest = max(brightest, float(blobs.peak_dn[~is_led].max()))
        if isinstance(outcome, PoseEstimate) and is_led.any():
            found = led_levels(capture, outcome, None, len(outcome.led_px))
            levels.append(found[0])
            full = full_scale_of(capture)
            heights += [full * (level.peak - level.background) for level in found]
            areas += blobs.area_px2[is_led].tolist()
            circularities += blobs.circularity[is_led].tolist()
            hues += [hue for hue in blobs.hue_deg[is_led].tolist() if np.isfinite(hue)]
            ranges.append(float(np.linalg.norm(outcome.camera_from_beacon.t_m)))
    middle = sorted(levels, key=lambda level: level.height)[len(levels) // 2] if levels else None
    return SceneLights(
        len(ranges),
        min(heights, default=float("nan")),
        middle,
        min(areas, default=float("nan")),
        max(areas, default=float("nan")),
        min(circularities, default=float("nan")),
        tuple(hues),
        float(np.median(others)) if others else 0.0,
        brightest,
        float(np.median(ranges)) if ranges else float("nan"),
    )


def hue_range_deg(hues_deg: Sequence[float], margin_deg: float) -> tuple[float, float]:
    """The shortest arc that holds all hues, widened on both sides, degrees; it may wrap.

    Args:
        hues_deg: At least one hue, degrees.
        margin_deg: Added on both sides.

    Returns:
        Low and high; low > high when the arc wraps through 0.
    """
    ordered = np.sort(np.asarray(hues_deg, dtype=np.float64) % 360.0)
    gaps = np.diff(np.concatenate([ordered, ordered[:1] + 360.0]))
    after = int(np.argmax(gaps))
    low, high = float(ordered[(after + 1) % len(ordered)]), float(ordered[after])
    return (low - margin_deg) % 360.0, (high + margin_deg) % 360.0


def _led_mask(blobs: Blobs, outcome: Outcome) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    if not isinstance(outcome, PoseEstimate) or not len(blobs):
        return np.zeros(len(blobs), dtype=bool)
    seen: FloatArray = outcome.led_px[np.isfinite(outcome.led_px).all(axis=1)]
    apart = np.linalg.norm(blobs.centroid_px[:, None] - seen[None], axis=2)
    return np.asarray(apart.min(axis=1) < _SAME_LIGHT_PX, dtype=bool)


def _pixel_noise(first: ImageArray, second: ImageArray) -> float:
    """Deviation of one pixel between two captures, DN; moving lights are few pixels and are left out."""
    if first.shape != second.shape:
        return float("nan")
    step = first[2::9, 3::11].astype(np.float64) - second[2::9, 3::11].astype(np.float64)
    quiet = step[np.abs(step) <= 6.0 * max(noise_dn(first), 0.5)]
    return float(np.sqrt(0.5 * np.mean(quiet**2))) if quiet.size else float("nan")


def _unevenness(raw: ImageArray) -> float:
    rows = np.array_split(raw[::3, ::3], _TILES, axis=0)
    medians = np.array([float(np.median(tile)) for row in rows for tile in np.array_split(row, _TILES, axis=1)])
    return float(np.percentile(np.abs(medians - np.median(medians)), 90))
