"""Raster pictures of captures: cut around the beacon, with what was seen and what was expected drawn in."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.figures import label_of

_SIDE_IN = 2.6
_WIDE_IN = 3.6
_DPI = 110
_BIGGEST_PX = 400
_MOST_GAIN = 4.0


def read_picture(path: Path) -> NDArray[np.uint8] | None:
    """Read a kept capture for looking at.

    Args:
        path: The image file.

    Returns:
        RGB, shape (H, W, 3), a dim picture up to four times brighter than it was; None when it cannot be read.
    """
    import cv2

    try:
        encoded = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError:
        return None
    image = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED) if encoded.size else None
    return None if image is None else shown_picture(image)


def shown_picture(image: NDArray[np.generic]) -> NDArray[np.uint8]:
    """A capture for looking at.

    Args:
        image: Mono (H, W) or BGR (H, W, 3), uint8 or uint16.

    Returns:
        RGB, shape (H, W, 3), a dim picture up to four times brighter than it was.
    """
    bright = image.astype(np.float64)
    if bright.ndim == 2:
        bright = np.repeat(bright[:, :, None], 3, axis=2)
    rgb = bright[:, :, 2::-1]
    brightest = float(rgb.max())
    # Cameras of 10 or 12 bits hand over 16-bit numbers that never come near 65535.
    full = 255.0 if image.dtype == np.uint8 else next(f for f in (1023.0, 4095.0, 65535.0) if f >= brightest)
    shown: NDArray[np.uint8] = (rgb * (255.0 / max(brightest, full / _MOST_GAIN))).astype(np.uint8)
    return shown


def overlay_png(
    image: NDArray[np.uint8], observed_px: FloatArray, expected_px: FloatArray, names: tuple[str, ...]
) -> bytes:
    """Draw a capture with observed (circles) and expected (crosses) LED positions.

    Args:
        image: RGB, shape (H, W, 3).
        observed_px: Observed centroids, shape (n, 2), px; NaN where unseen; may be empty.
        expected_px: Where the registration expects the LEDs, shape (n, 2), px; NaN where outside the valid field.
        names: LED names, length n.

    Returns:
        PNG file; the same input gives the same bytes.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    left, top, right, bottom = _window(image, np.vstack([observed_px.reshape(-1, 2), expected_px.reshape(-1, 2)]))
    # Cells of a large cut-out are averaged away by drawing it small; only neighbours are skipped for speed.
    step = max(1, (right - left) // _BIGGEST_PX)
    cut = image[top:bottom:step, left:right:step]
    figure = Figure(figsize=(_SIDE_IN, _SIDE_IN * (bottom - top) / (right - left)), dpi=_DPI)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    # Pixel centres are whole numbers, so the picture's border lies half a pixel outside.
    extent = (left - 0.5, right - 0.5, bottom - 0.5, top - 0.5)
    axes.imshow(cut, extent=extent, interpolation="nearest", aspect="auto")
    marks: dict[str, Any] = {"fillstyle": "none", "linestyle": "none"}
    axes.plot(*observed_px.reshape(-1, 2).T, "o", color="#56b4e9", ms=11, mew=1.2, **marks)
    axes.plot(*expected_px.reshape(-1, 2).T, "+", color="#ff7a1a", ms=9, mew=1.2, linestyle="none")
    for name, (x, y) in zip(names, expected_px.reshape(-1, 2), strict=False):
        if np.isfinite([x, y]).all() and left <= x < right and top <= y < bottom:
            axes.annotate(
                label_of(name), (x, y), (7, 7), textcoords="offset points", color="white", fontsize=7, clip_on=True
            )
    axes.set_xlim(left - 0.5, right - 0.5)
    axes.set_ylim(bottom - 0.5, top - 0.5)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def residual_png(
    image: NDArray[np.uint8], px: FloatArray, residuals_px: FloatArray, keep: NDArray[np.bool_], magnification: float
) -> bytes:
    """Draw a picture of a board with the residuals of its corners.

    Args:
        image: RGB, shape (H, W, 3).
        px: Corners, shape (N, 2), px.
        residuals_px: Observed minus projected, shape (N, 2), px.
        keep: Which corners were kept, shape (N,); the others are drawn as crosses.
        magnification: How many times longer than true residuals are drawn.

    Returns:
        PNG file; the same input gives the same bytes.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    height, width = image.shape[:2]
    figure = Figure(figsize=(_WIDE_IN, _WIDE_IN * height / width), dpi=_DPI)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    step = max(1, width // (2 * _BIGGEST_PX))
    # Half as bright, so that lines on white squares stand out.
    axes.imshow(image[::step, ::step] // 2, extent=(-0.5, width - 0.5, height - 0.5, -0.5), aspect="auto")
    ends = np.stack([px[keep], px[keep] + magnification * residuals_px[keep]], axis=1)
    gaps = np.concatenate([ends, np.full((len(ends), 1, 2), np.nan)], axis=1).reshape(-1, 2)
    axes.plot(*gaps.T, "-", color="#f0c04d", lw=1.1)
    axes.plot(*px[keep].T, ".", color="#56b4e9", ms=2.2)
    axes.plot(*px[~keep].T, "x", color="#ff5a3c", ms=6, mew=1.5)
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _window(image: NDArray[np.uint8], points_px: FloatArray) -> tuple[int, int, int, int]:
    """A square window around the points, or the whole picture when there are none in it."""
    height, width = image.shape[:2]
    points = points_px[np.isfinite(points_px).all(axis=1)]
    points = points[((points >= 0.0) & (points < [width, height])).all(axis=1)]
    if not len(points):
        return 0, 0, width, height
    low, high = points.min(axis=0), points.max(axis=0)
    side = int(min(max(1.5 * float((high - low).max()), 48.0) + 16.0, width, height))
    centre = 0.5 * (low + high)
    left = int(np.clip(round(centre[0] - side / 2), 0, width - side))
    top = int(np.clip(round(centre[1] - side / 2), 0, height - side))
    return left, top, left + side, top + side
