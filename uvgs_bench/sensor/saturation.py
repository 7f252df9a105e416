"""How large and bright an LED's blob will be at a range and exposure, and where that stops working.

The image of an LED is a disc of radius ``f d / 2 r`` blurred by a Gaussian (point spread and pixel), times a height
that one measured reference fixes. While the disc is smaller than the blur, height falls as 1/r^2; closer, it levels
off and the area grows instead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import pi, sqrt
from typing import Literal

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor.config import UvgsConfig

# A pixel integrates over its square: variance 1/12 px^2 along each direction.
_PIXEL_VARIANCE_PX2 = 1.0 / 12.0
_RADII = 200
_SCAN = 64


@dataclass(frozen=True, slots=True)
class BlobForecast:
    """What detection will see.

    Args:
        peak: Brightest pixel over the background as a fraction of full scale, clipped at 1 minus the background.
        height: The same unclipped.
        area_px2: Area of the binary blob at the local threshold, px^2.
        clipped_px2: Area at full scale, px^2.
        radius_px: Radius of the binary blob, px.
    """

    peak: float
    height: float
    area_px2: float
    clipped_px2: float
    radius_px: float


@dataclass(frozen=True, slots=True)
class RangeLimit:
    """A range at which something stops working.

    Args:
        reason: ``clips``, ``too_large``, ``merges`` or ``too_dim``.
        range_m: Where, m.
        side: ``nearer`` or ``farther``: on which side of it the trouble is.
        detail: One line for people.
    """

    reason: str
    range_m: float
    side: str
    detail: str


@dataclass(frozen=True, slots=True)
class SaturationModel:
    """Blob area and peak against range and exposure, for an LED seen along its axis.

    Args:
        diameter_m: Diameter of the emitting area, m.
        focal_px: Focal length, px.
        psf_sigma_px: Standard deviation of the point spread, px, without the pixel.
        range_m: Range of the measured reference, m.
        exposure_s: Its exposure, s.
        reference_height: Its unclipped peak over the background as a fraction of full scale.
        background: Background as a fraction of full scale, taken as independent of exposure.

    Raises:
        ValueError: A value that is not positive, or a background outside [0, 1).
    """

    diameter_m: float
    focal_px: float
    psf_sigma_px: float
    range_m: float
    exposure_s: float
    reference_height: float
    background: float = 0.0

    def __post_init__(self) -> None:
        for name in ("diameter_m", "focal_px", "psf_sigma_px", "range_m", "exposure_s", "reference_height"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if not 0.0 <= self.background < 1.0:
            raise ValueError(f"background must be in [0, 1), got {self.background}")

    def height(self, range_m: float, exposure_s: float) -> float:
        """Unclipped peak over the background, fraction of full scale; above 1 the core clips."""
        there = self._centre(range_m) / range_m**2
        reference = self._centre(self.range_m) / self.range_m**2
        return self.reference_height * (exposure_s / self.exposure_s) * there / reference

    def forecast(self, range_m: float, exposure_s: float, config: UvgsConfig | None = None) -> BlobForecast:
        """Blob of one LED alone on a flat background.

        Args:
            range_m: Range, m.
            exposure_s: Exposure, s.
            config: Threshold of the detection; the default when None.

        Returns:
            Peak and areas.
        """
        rules = UvgsConfig() if config is None else config
        height = self.height(range_m, exposure_s)
        ceiling = 1.0 - self.background
        radius, shape = self._profile(range_m)
        light = np.minimum(height * shape, ceiling)
        peak = float(light[0])
        radius_px = _outer_radius(radius, light, _threshold(radius, light, rules))
        clipped_px = _outer_radius(radius, height * shape, ceiling)
        return BlobForecast(peak, height, pi * radius_px**2, pi * clipped_px**2, radius_px)

    def limits(
        self, exposure_s: float, near_m: float, far_m: float, separation_m: float, config: UvgsConfig | None = None
    ) -> tuple[RangeLimit, ...]:
        """Where within a span of ranges something stops working, nearest first.

        Args:
            exposure_s: Exposure, s.
            near_m: Nearest range of interest, m.
            far_m: Farthest range of interest, m.
            separation_m: Least distance of two LEDs as the camera sees them, m.
            config: Threshold and limits of the detection; the default when None.

        Returns:
            The limits; empty when all is well over the whole span.
        """
        rules = UvgsConfig() if config is None else config
        ceiling = 1.0 - self.background

        def clips(r: float) -> float:
            return self.height(r, exposure_s) - ceiling

        def too_large(r: float) -> float:
            return self.forecast(r, exposure_s, rules).area_px2 - rules.max_area_px2

        def merges(r: float) -> float:
            blob = 2.0 * self.forecast(r, exposure_s, rules).radius_px + 1.0
            return max(blob, rules.min_separation_px) - self.focal_px * separation_m / r

        def too_dim(r: float) -> float:
            return rules.min_contrast - self.height(r, exposure_s)

        tests: tuple[tuple[str, str, Callable[[float], float]], ...] = (
            ("clips", "the core of an LED clips", clips),
            ("too_large", f"a blob exceeds {rules.max_area_px2:.0f} px^2 (max_area_px2)", too_large),
            ("merges", "the blobs of two LEDs merge", merges),
            ("too_dim", f"an LED stays below {rules.min_contrast:.0%} of full scale (min_contrast)", too_dim),
        )
        found = []
        for reason, text, excess in tests:
            edges = _edges(excess, near_m, far_m)
            if edges is None:
                found.append(RangeLimit(reason, far_m, "nearer", f"{text} over all of {near_m:.2f} to {far_m:.2f} m"))
            for edge_m, side in edges or ():
                found.append(RangeLimit(reason, edge_m, side, f"{text} {side} than {edge_m:.2f} m"))
        return tuple(sorted(found, key=lambda limit: limit.range_m))

    def clips_below_m(self, exposure_s: float, near_m: float, far_m: float) -> float | None:
        """The range below which the core of an LED clips; quick enough for the loop of a live camera.

        Args:
            exposure_s: Exposure, s.
            near_m: Nearest range of interest, m.
            far_m: Farthest range of interest, m.

        Returns:
            The range, m; ``far_m`` when it clips everywhere, None when nowhere.
        """
        ceiling = 1.0 - self.background
        edges = _edges(lambda r: self.height(r, exposure_s) - ceiling, near_m, far_m)
        if edges is None:
            return far_m
        return next((edge_m for edge_m, side in edges if side == "nearer"), None)

    def _disc_px(self, range_m: float) -> float:
        return 0.5 * self.focal_px * self.diameter_m / range_m

    @property
    def _blur_px(self) -> float:
        return sqrt(self.psf_sigma_px**2 + _PIXEL_VARIANCE_PX2)

    def _centre(self, range_m: float) -> float:
        """Light at the centre for total light 1, times a constant. Source: integral of a Gaussian over a disc."""
        x = 0.5 * (self._disc_px(range_m) / self._blur_px) ** 2
        return float(-np.expm1(-x) / x) if x > 1e-9 else 1.0

    def _profile(self, range_m: float) -> tuple[FloatArray, FloatArray]:
        """Radii, px, and light there over light at the centre: a disc convolved with a Gaussian.

        Source: ``int_0^a exp(-(r^2 + p^2) / 2 s^2) I0(r p / s^2) p dp``, the Marcum Q integral.
        """
        from scipy.special import i0e

        disc, blur = self._disc_px(range_m), self._blur_px
        radius = np.linspace(0.0, disc + 6.0 * blur, _RADII)
        # Two points per blur, and some: the integrand is a bump no narrower than the blur.
        nodes, weights = _gauss(16 * min(2 + int(disc / blur) // 6, 32))
        p = 0.5 * disc * (nodes + 1.0)
        r = radius[:, None]
        # i0e carries the growing exponential, so that nothing overflows.
        value = np.exp(-0.5 * ((r - p) / blur) ** 2) * i0e(r * p / blur**2) * p
        light = value @ weights
        return radius, light / light[0]


@cache
def _gauss(count: int) -> tuple[FloatArray, FloatArray]:
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return nodes, weights


def _threshold(radius: FloatArray, light: FloatArray, config: UvgsConfig) -> float:
    """The detection's local threshold over the background, for one blob in the middle of its window."""
    window_px2 = float(config.window_px**2)
    ring = 2.0 * pi * radius * (radius[1] - radius[0])
    inside = radius <= config.window_px / sqrt(pi)
    mean = float((light * ring)[inside].sum()) / window_px2
    square = float((light**2 * ring)[inside].sum()) / window_px2
    sigma = sqrt(max(square - mean * mean, 0.0))
    height = float(light[0])
    return max(min(mean + config.threshold_k * sigma, 0.5 * height), 0.5 * config.threshold_floor * height)


def _outer_radius(radius: FloatArray, light: FloatArray, level: float) -> float:
    """Radius at which falling light crosses a level; 0 when it is never above."""
    above = np.flatnonzero(light > level)
    if len(above) == 0:
        return 0.0
    i = int(above[-1])
    if i + 1 == len(radius):
        return float(radius[-1])
    share = (light[i] - level) / (light[i] - light[i + 1])
    return float(radius[i] + share * (radius[i + 1] - radius[i]))


def _edges(
    excess: Callable[[float], float], near_m: float, far_m: float
) -> list[tuple[float, Literal["nearer", "farther"]]] | None:
    """Ranges at which something begins or ends to be bad, and on which side it is; None when it is bad everywhere."""
    ranges = np.geomspace(near_m, far_m, _SCAN)
    bad = np.array([excess(float(r)) > 0.0 for r in ranges])
    if bad.all():
        return None
    changes = np.flatnonzero(bad[1:] != bad[:-1])
    return [
        (_bisect(excess, float(ranges[i]), float(ranges[i + 1])), "nearer" if bad[i] else "farther") for i in changes
    ]


def _bisect(excess: Callable[[float], float], low: float, high: float) -> float:
    is_low_bad = excess(low) > 0.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        if (excess(middle) > 0.0) == is_low_bad:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)
