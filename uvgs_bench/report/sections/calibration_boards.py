"""Camera and boards in space."""

from __future__ import annotations

import numpy as np

from uvgs_bench.camera.fitting import CalibrationResult
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.calibration_evidence import CalibrationEvidence
from uvgs_bench.report.document import Figure, Section
from uvgs_bench.report.figures import canvas, legend_above, series, style, svg_of
from uvgs_bench.report.palette import BLUE, FAINT, INK, ORANGE
from uvgs_bench.report.space import space_view

_CAMERA_SHARE = 0.3
_WORST = 3
# Rays farther off the axis would make the pyramid of a fisheye a plane or worse.
_LEAST_FORWARD = 0.35


def build(evidence: CalibrationEvidence) -> Section | None:
    """A view from behind and one from above."""
    result = evidence.result
    if result is None:
        return None
    outlines = np.stack([_outline(result, i) for i in range(len(result.views))])
    worst = set(np.argsort(-result.view_rms_px, kind="stable")[:_WORST].tolist())
    figures = (_view_3d(result, outlines, worst), _from_above(result, outlines, worst))
    return Section("boards", "Boards in space", figures)


def _outline(result: CalibrationResult, i: int) -> FloatArray:
    """Corners of the seen part of a board in camera axes, closed, shape (5, 3), m."""
    board_m = result.views[i].board_m
    (x0, y0), (x1, y1) = board_m[:, :2].min(axis=0), board_m[:, :2].max(axis=0)
    return result.camera_from_board[i].apply([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0], [x0, y0, 0]])


def _pyramid(lens: Lens, depth_m: float) -> FloatArray:
    """Strokes of the camera's field of view, shape (8, 2, 3), m; cut where a fisheye looks sideways."""
    right, bottom = lens.width_px - 0.5, lens.height_px - 0.5
    rays = lens.unproject([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]])
    aim = np.array([[-1.0, -0.75, 1.0], [1.0, -0.75, 1.0], [1.0, 0.75, 1.0], [-1.0, 0.75, 1.0]])
    rays = np.where(np.isfinite(rays) & (rays[:, 2:] > _LEAST_FORWARD), rays, aim)
    ends = rays * (depth_m / rays[:, 2:])
    return np.concatenate(
        [np.stack([np.zeros_like(ends), ends], axis=1), np.stack([ends, np.roll(ends, -1, axis=0)], axis=1)]
    )


def _with_gaps(strokes: FloatArray) -> FloatArray:
    """Strokes as one line with gaps."""
    gap = np.full((len(strokes), 1, strokes.shape[2]), np.nan)
    return np.concatenate([strokes, gap], axis=1).reshape(-1, strokes.shape[2])


def _view_3d(result: CalibrationResult, outlines: FloatArray, worst: set[int]) -> Figure:
    middles = outlines[:, :4].mean(axis=1)
    key = "boards-3d"
    depth = middles[:, 2]
    names = ", ".join(result.view_names[i] for i in sorted(worst, key=lambda i: -result.view_rms_px[i]))
    alt = (
        f"{len(outlines)} boards before the camera, {depth.min():.3g} to {depth.max():.3g} m along its axis, "
        f"{np.ptp(middles[:, 0]):.3g} m wide and {np.ptp(middles[:, 1]):.3g} m high; largest residuals: {names}."
    )
    pyramid = _pyramid(result.calibration.lens, _CAMERA_SHARE * float(depth.min()))
    with style(key):
        figure, view = space_view(np.vstack([outlines.reshape(-1, 3), pyramid.reshape(-1, 3)]))
        bad = np.isin(np.arange(len(outlines)), list(worst))
        for chosen, colour, label, width in (
            (outlines[~bad], BLUE, "boards", 1.0),
            (outlines[bad], ORANGE, f"largest {len(worst)} residuals", 1.4),
            (pyramid, INK, "camera", 1.2),
        ):
            if len(chosen):
                view.axes.plot(*view.of(_with_gaps(chosen)), "-", color=colour, lw=width, label=label)
        figure.legend(loc="upper left", ncols=3, handletextpad=0.4, columnspacing=0.9, borderaxespad=0.2)
        svg = svg_of(figure, key, alt)
    numbers = tuple(series(f"middle {n}", "m", middles[:, k]) for k, n in enumerate("xyz"))
    caption = "The seen part of each board in camera axes, with the camera's field of view."
    return Figure(key, svg, alt, caption, numbers)


def _from_above(result: CalibrationResult, outlines: FloatArray, worst: set[int]) -> Figure:
    key = "boards-top"
    across = outlines[..., 0]
    alt = (
        f"{len(outlines)} boards seen from above: from {across.min():+.3g} to {across.max():+.3g} m right of the axis, "
        f"{outlines[..., 2].min():.3g} to {outlines[..., 2].max():.3g} m ahead."
    )
    with style(key):
        figure = canvas(height_in=3.9)
        axes = figure.add_subplot()
        bad = np.isin(np.arange(len(outlines)), list(worst))
        for chosen, colour, label in (
            (outlines[~bad], BLUE, "boards"),
            (outlines[bad], ORANGE, f"largest {len(worst)} residuals"),
        ):
            if len(chosen):
                p = _with_gaps(chosen)
                axes.plot(p[:, 0], p[:, 2], "-", color=colour, lw=1.0, label=label)
        depth_m = float(outlines[..., 2].max())
        lens = result.calibration.lens
        rays = lens.unproject([[-0.5, lens.cy_px], [lens.width_px - 0.5, lens.cy_px]])
        for ray in rays:
            if np.isfinite(ray).all() and ray[2] > _LEAST_FORWARD:
                end = ray * depth_m / ray[2]
                axes.plot([0.0, end[0]], [0.0, end[2]], "--", color=FAINT, lw=1.0)
        axes.plot(0.0, 0.0, "o", color=INK, ms=6, label="camera")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("x, right (m)")
        axes.set_ylabel("z, forward (m)")
        legend_above(axes, 3)
        svg = svg_of(figure, key, alt)
    return Figure(key, svg, alt, "Seen from above; dashed: the edges of the picture at the middle row.")
