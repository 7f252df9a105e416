"""The difference of two lenses as a picture of its own."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from uvgs_bench.camera.difference import LensDifference
from uvgs_bench.report.figures import label_of, style
from uvgs_bench.report.maps import draw_map, picture_canvas
from uvgs_bench.report.palette import FAINT, INK

_DPI = 160
_ARROWS = 12


def difference_png(found: LensDifference, title: str) -> bytes:
    """Draw the length of the shift over the picture, its direction as arrows, and the worst place.

    Args:
        found: The difference.
        title: One line above the picture.

    Returns:
        A PNG file.
    """
    length = np.linalg.norm(found.shift_px, axis=2)
    u, v = found.grid_px[:, :, 0], found.grid_px[:, :, 1]
    width, height = float(u.max()) + 1.0, float(v.max()) + 1.0
    with style("lens-difference"):
        figure, axes = picture_canvas(width, height)
        draw_map(figure, axes, found.grid_px, length, "shift (px)")
        step_v, step_u = (max(1, size // _ARROWS) for size in length.shape)
        some = (slice(step_v // 2, None, step_v), slice(step_u // 2, None, step_u))
        # Corners of the picture run away; their arrows are cut so that the others can be seen.
        longest = max(float(np.nanpercentile(length[some], 80.0)), 1e-12)
        arrows = found.shift_px[some] * np.minimum(1.0, longest / np.maximum(length[some], 1e-300))[..., None]
        scale = longest / (width / _ARROWS)
        options: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": scale, "width": 0.005}
        options |= {"facecolor": "white", "edgecolor": INK, "linewidth": 0.4}
        axes.quiver(u[some], v[some], arrows[..., 0], arrows[..., 1], **options)
        worst_u, worst_v = (float(value) for value in found.max_at_px)
        axes.plot(worst_u, worst_v, "x", color="white", ms=8, mew=2.0)
        axes.annotate(
            f"worst {found.max_px:.3g} px", (worst_u, worst_v), color=INK, fontsize=8.5, ha="center", va="center",
            xytext=(0.15 * u.max() + 0.7 * worst_u, 0.15 * v.max() + 0.7 * worst_v),
            bbox={"facecolor": "white", "edgecolor": FAINT, "pad": 2.0},
        )  # fmt: skip
        axes.set_title(f"{label_of(title, 60)}\narrows: direction, length up to {longest:.2g} px")
        stream = io.BytesIO()
        figure.savefig(stream, format="png", dpi=_DPI, facecolor="white")
    return stream.getvalue()
