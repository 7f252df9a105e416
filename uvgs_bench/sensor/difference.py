"""Light on minus light off: what a switched light adds to a scene, for retroreflective targets among other lights.

Between the two captures camera or lights may have moved a little. The dark capture is laid over the lit one by a small
search, and where it has structure its local maximum is taken away, so that no rim of a moved light remains; where it is
flat its local mean is, which adds almost no noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from math import ceil, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.errors import CaptureError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor.blobs import full_scale_of, noise_dn
from uvgs_bench.sensor.capture import Capture, ImageArray
from uvgs_bench.sensor.exposure import measure_levels
from uvgs_bench.sensor.preprocess import intensity

_MEAN_SIDE_PX = 5
# A neighbourhood spanning more than this many deviations has structure; of 25 normal values hardly any span six.
_STRUCTURE = 8.0
_REGISTER_STEP = 64.0
# Share of an LED's light that its dark partner may show.
_STILL_LIT = 0.3
# Light this near to the rim of an LED's spot may reach under it and shift its centre.
_STILL_LIT_PX = 14


@dataclass(frozen=True, slots=True)
class DifferenceConfig:
    """How to take one capture from the other.

    Args:
        motion_px: Lights may move this far between the captures, px.
        slack_px: Neighbourhood whose maximum is taken away after the search, px; what is left of the motion where not
            all lights move alike.
        pedestal_dn: Added to every pixel, DN, so that noise is not cut off at 0 and can still be measured.
        gain_e_per_dn: Electrons per grey step of an 8-bit picture.

    Raises:
        ValueError: A value outside its meaning.
    """

    motion_px: int = 3
    slack_px: int = 1
    pedestal_dn: int = 8
    gain_e_per_dn: float = 40.0

    def __post_init__(self) -> None:
        for name in ("motion_px", "slack_px", "pedestal_dn"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if not self.gain_e_per_dn > 0.0:
            raise ValueError(f"gain_e_per_dn must be positive, got {self.gain_e_per_dn}")


@dataclass(frozen=True, slots=True, eq=False)
class Difference:
    """What the switched light added.

    Args:
        capture: A capture to solve, with the instant of the lit one; its background is the pedestal.
        shift_px: How far the lit scene lay from the dark one, columns and rows, px.
        noise_dn: Deviation of its pixels where nothing shines, DN.
        removed_dn: Light that was taken away, shape (H, W), DN; its shot noise is still there.
        electrons_per_dn: Electrons per DN of these pictures.
    """

    capture: Capture
    shift_px: tuple[int, int]
    noise_dn: float
    removed_dn: NDArray[np.float32]
    electrons_per_dn: float

    def variance_dn2(self) -> FloatArray:
        """Variance of each pixel, shape (H, W), DN^2: flat noise, and shot noise of light taken away and light left."""
        left = intensity(self.capture.image).astype(np.float64) - self._pedestal
        light = left + self.removed_dn.astype(np.float64) - self._dark
        # What does not stand out is noise, and that is counted already.
        light[light < 3.0 * self.noise_dn] = 0.0
        result: FloatArray = self.noise_dn**2 + light / self.electrons_per_dn
        return result

    def is_switched_at(self, led_px: FloatArray) -> bool:
        """Whether the dark capture is dark where LEDs are believed to be, and close around.

        With both captures lit (one between them was lost) a moved LED leaves a crescent, whose centre is not the LED's.
        A steady light behind one LED does not count; most of them must be dark.

        Args:
            led_px: Centres, shape (n, 2), px; NaN where an LED was not seen.

        Returns:
            Whether at least half of those seen shine in the lit capture only.
        """
        raw = intensity(self.capture.image)
        height, width = raw.shape
        dark = 0
        seen = led_px[np.isfinite(led_px).all(axis=1)]
        levels = measure_levels(self.capture, np.hstack([seen, seen]))
        for (u, v), level in zip(np.rint(seen).astype(int), levels, strict=True):
            core = np.s_[max(0, v - 1) : min(height, v + 2), max(0, u - 1) : min(width, u + 2)]
            r = _STILL_LIT_PX + ceil(sqrt(level.half_px2 / pi))
            around = np.s_[max(0, v - r) : min(height, v + r + 1), max(0, u - r) : min(width, u + r + 1)]
            left = float(raw[core].max()) - self._pedestal
            taken = float(self.removed_dn[around].max()) - self._dark
            dark += taken < _STILL_LIT * left
        return bool(2 * dark >= len(seen))

    @property
    def _pedestal(self) -> float:
        raw = intensity(self.capture.image)
        return float(np.median(raw[::7, ::7]))

    @property
    def _dark(self) -> float:
        # The noise of the ordinary background is in noise_dn already.
        return float(np.median(self.removed_dn[::7, ::7]))


def difference(on: Capture, off: Capture, config: DifferenceConfig | None = None) -> Difference:
    """Take the dark capture from the lit one.

    Pixels that clip in the lit capture stay at full scale when most of their light is the switched one's, so that the
    sensor still knows them as clipped.

    Args:
        on: Capture with the light on.
        off: Capture with the light off, just before or after it.
        config: Parameters.

    Returns:
        A capture of the switched light alone, and its noise.

    Raises:
        CaptureError: The captures differ in size, type or exposure.
    """
    import cv2

    rules = DifferenceConfig() if config is None else config
    _check_pair(on, off)
    full = max(full_scale_of(on), full_scale_of(off))
    lit, dark = intensity(on.image), intensity(off.image)
    shift = find_shift(lit, dark, rules.motion_px)
    moved = _shifted(off.image, shift)
    flat_noise = _flat_noise(dark)
    side = (_MEAN_SIDE_PX, _MEAN_SIDE_PX)
    reach = np.ones((2 * rules.slack_px + 1,) * 2, dtype=np.uint8)
    span = np.ones((2 * rules.slack_px + 3,) * 2, dtype=np.uint8)
    highest, lowest = cv2.dilate(moved, span), cv2.erode(moved, span)
    electrons_per_dn = rules.gain_e_per_dn * 255.0 / full
    light = np.maximum(highest.astype(np.float32) - float(np.median(dark)), 0.0)
    local_noise = np.sqrt(flat_noise**2 + light / electrons_per_dn)
    is_structured = (highest.astype(np.float32) - lowest) > _STRUCTURE * local_noise
    mean = cv2.boxFilter(moved, cv2.CV_32F, side)
    taken = np.where(is_structured, cv2.dilate(moved, reach).astype(np.float32), mean)
    rest = on.image.astype(np.float32) - taken
    clipped = (on.image >= full) & (rest > 0.5 * full)
    values = np.clip(np.rint(rest + rules.pedestal_dn), 0.0, full - 1.0)
    values[clipped] = full
    image: ImageArray = values.astype(on.image.dtype)
    removed = taken if taken.ndim == 2 else taken.max(axis=2)
    added = 1.0 + 1.0 / (_MEAN_SIDE_PX * _MEAN_SIDE_PX)
    name = f"{on.source} - {off.source}" if on.source or off.source else ""
    return Difference(
        Capture(image, on.t_ns, name, on.index, on.exposure_s, on.bayer, full),
        shift,
        float(np.sqrt(added * flat_noise**2 + 1.0 / 12.0)),
        np.ascontiguousarray(removed, dtype=np.float32),
        electrons_per_dn,
    )


def difference_pairs(
    captures: Iterable[Capture], config: DifferenceConfig | None = None, *, is_first_on: bool | None = None
) -> Iterator[Difference]:
    """Differences of consecutive captures of an alternating light.

    Args:
        captures: Captures, every other one with the light on.
        config: Parameters.
        is_first_on: Whether the first one is lit; None decides it by the first pair, by which of the two has light
            that the other lacks, and again where a pair shows nothing: a lost capture turns all later pairs round.

    Yields:
        One difference per pair; a last capture without partner is left out.

    Raises:
        CaptureError: Two captures of a pair differ in size, type or exposure.
    """
    rules = DifferenceConfig() if config is None else config
    first: Capture | None = None
    is_on = is_first_on
    for capture in captures:
        if first is None:
            first = capture
            continue
        if is_on is None:
            is_on = is_lit(first, capture, rules)
        on, off = (first, capture) if is_on else (capture, first)
        got = difference(on, off, rules)
        if is_first_on is None and _surplus_dn(got) == 0.0:
            turned = difference(off, on, rules)
            if _surplus_dn(turned) > 0.0:
                is_on, got = not is_on, turned
        yield got
        first = None


def is_lit(first: Capture, second: Capture, config: DifferenceConfig | None = None) -> bool:
    """Whether the first of two captures has the light on: it has more light the other lacks than the other way round.

    Raises:
        CaptureError: The captures differ in size, type or exposure.
    """
    return _surplus_dn(difference(first, second, config)) >= _surplus_dn(difference(second, first, config))


def _surplus_dn(got: Difference) -> float:
    """Light that cannot be noise, summed, DN."""
    raw = intensity(got.capture.image)
    height = raw.astype(np.float32) - np.float32(np.median(raw[::7, ::7]))
    return float(height[height > 8.0 * got.noise_dn].sum())


def find_shift(lit: ImageArray, dark: ImageArray, motion_px: int) -> tuple[int, int]:
    """How far the lit scene lies from the dark one, from the lights that both show.

    Compared only where the dark picture is bright, and each difference counts at most so much, because the switched
    light may lie there too.

    Args:
        lit: Brightness, shape (H, W).
        dark: Brightness, shape (H, W).
        motion_px: Farthest shift tried, px.

    Returns:
        Columns and rows, px; (0, 0) when the dark picture shows nothing.
    """
    import cv2

    background = float(np.median(dark[::7, ::7]))
    level = background + max(10.0 * noise_dn(dark), 0.05 * (float(dark.max()) - background), 3.0)
    bright = (dark > level).astype(np.uint8)
    if motion_px == 0 or not bright.any():
        return 0, 0
    m = motion_px
    area = cv2.dilate(bright, np.ones((2 * m + 3, 2 * m + 3), dtype=np.uint8))
    height, width = dark.shape
    rows, columns = np.nonzero(area[m : height - m, m : width - m])
    if len(rows) == 0:
        return 0, 0
    # A large bright area tells no more with every pixel than with every few.
    step = max(1, len(rows) // 20_000)
    rows, columns = rows[::step] + m, columns[::step] + m
    here = lit[rows, columns].astype(np.float32)
    cap = _REGISTER_STEP * max(noise_dn(dark), 0.3)
    best, found = np.inf, (0, 0)
    # Near shifts first, so that a tie is no motion.
    for dy, dx in sorted(np.ndindex(2 * m + 1, 2 * m + 1), key=lambda s: (s[0] - m) ** 2 + (s[1] - m) ** 2):
        there = dark[rows - (dy - m), columns - (dx - m)].astype(np.float32)
        cost = float(np.minimum(np.abs(here - there), cap).sum())
        if cost < best:
            best, found = cost, (dx - m, dy - m)
    return found


def _flat_noise(raw: ImageArray) -> float:
    """Deviation of the noise between lights, DN, quantisation included: finer than a median of whole numbers."""
    left, right = raw[3::5, 5:-1:7].astype(np.float64), raw[3::5, 6::7].astype(np.float64)
    step = left - right[:, : left.shape[1]]
    rough = max(noise_dn(raw), 0.5)
    # Lights and their flanks have other noise.
    quiet = step[(np.abs(step) <= 6.0 * rough) & (np.abs(left - np.median(left)) <= 4.0 * rough)]
    return max(float(np.sqrt(0.5 * np.mean(quiet**2))), 0.3) if quiet.size else 0.3


def _shifted(image: ImageArray, shift_px: tuple[int, int]) -> ImageArray:
    """The picture moved by whole pixels; what enters repeats the border."""
    dx, dy = shift_px
    height, width = image.shape[:2]
    rows = np.clip(np.arange(height) - dy, 0, height - 1)
    columns = np.clip(np.arange(width) - dx, 0, width - 1)
    picked = np.ascontiguousarray(image[rows][:, columns])
    moved: ImageArray = picked  # type: ignore[assignment]
    return moved


def _check_pair(on: Capture, off: Capture) -> None:
    if on.image.shape != off.image.shape or on.image.dtype != off.image.dtype:
        raise CaptureError(
            f"is {on.image.shape} {on.image.dtype}, its dark partner is {off.image.shape} {off.image.dtype}", on.source
        )
    if on.exposure_s is not None and off.exposure_s is not None:
        longer, shorter = max(on.exposure_s, off.exposure_s), min(on.exposure_s, off.exposure_s)
        if longer > 1.01 * shorter:
            raise CaptureError(
                f"was exposed {on.exposure_s:.6f} s, its dark partner {off.exposure_s:.6f} s; they must agree",
                on.source,
            )
