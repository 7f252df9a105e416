"""The difference of two lenses as a picture of its own."""

from __future__ import annotations

import io

import numpy as np

from uvgs_bench.camera.difference import LensDifference
from uvgs_bench.report.figures import canvas, style
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
    with style("lens-difference"):
        figure = canvas(4.9 * (v.max() + 1.0) / (u.max() + 1.0) * 0.85 + 0.5)
        axes = figure.add_subplot()
        shown = axes.pcolormesh(u, v, length, cmap="cividis", vmin=0.0, shading="nearest")
        step_v, step_u = (max(1, size // _ARROWS) for size in length.shape)
        some = (slice(step_v // 2, None, step_v), slice(step_u // 2, None, step_u))
        axes.quiver(
            u[some], v[some], found.shift_px[some][..., 0], found.shift_px[some][..., 1], angles="xy", color="white",
            width=0.003,
        )  # fmt: skip
        worst_u, worst_v = (float(value) for value in found.max_at_px)
        axes.plot(worst_u, worst_v, "x", color="white", ms=8, mew=2.0)
        axes.annotate(
            f"{found.max_px:.3g} px", (worst_u, worst_v), color=INK, fontsize=8.5, ha="center", va="center",
            xytext=(0.15 * u.max() + 0.7 * worst_u, 0.15 * v.max() + 0.7 * worst_v),
            bbox={"facecolor": "white", "edgecolor": FAINT, "pad": 2.0},
        )  # fmt: skip
        axes.set(aspect="equal", xlabel="column, px", ylabel="row, px", xlim=(u.min(), u.max()))
        axes.set_ylim(v.max(), v.min())
        axes.grid(False)
        axes.set_title(title)
        figure.colorbar(shown, ax=axes, label="shift, px", shrink=0.85)
        stream = io.BytesIO()
        figure.savefig(stream, format="png", dpi=_DPI, facecolor="white")
    return stream.getvalue()
