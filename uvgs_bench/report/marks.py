"""Marks written as one path: a thousand of them cost as little as one, and a fifth of the bytes."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from uvgs_bench.geometry import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_EDGE_PT = 0.5
_LINE_PT = 1.0


def draw_marks(
    axes: Axes,
    places: FloatArray,
    mark: str,
    *,
    colour: str,
    size_pt: float = 3.4,
    label: str = "",
    alpha: float = 1.0,
    edge: str = "",
) -> None:
    """Draw marks without a line between them.

    Args:
        axes: Where to draw.
        places: Abscissae and ordinates, shape (2, N); a mark that is not finite is left out.
        mark: Shape: ``o``, ``^``, ``s``, ``D`` or ``x``.
        colour: Of the marks.
        size_pt: Their size, points.
        label: Their name in the legend; empty for none.
        alpha: Their opacity; marks on one another do not add up.
        edge: Colour of a thin line around each; empty for none.
    """
    look: dict[str, Any] = {"linestyle": "none", "marker": mark, "markersize": size_pt, "color": colour}
    look |= {"markeredgecolor": edge or colour, "markeredgewidth": _EDGE_PT if edge else _LINE_PT * (mark == "x")}
    axes.add_line(_marks_class()(places[0], places[1], alpha=alpha, label=label or "_nolegend_", **look))
    axes.autoscale_view()


@cache
def _marks_class() -> Any:
    """A line whose marks are one path; made when first drawn, because matplotlib takes long to import."""
    from matplotlib.colors import to_rgba
    from matplotlib.lines import Line2D
    from matplotlib.path import Path
    from matplotlib.transforms import IdentityTransform

    class Marks(Line2D):
        """Marks without a line between them."""

        def draw(self, renderer: Any) -> None:
            """Write all marks at once."""
            points = self.get_transform().transform(self.get_xydata())
            points = points[np.isfinite(points).all(axis=1)]
            if not len(points):
                return
            size = renderer.points_to_pixels(self.get_markersize())
            edge = renderer.points_to_pixels(self.get_markeredgewidth())
            path, is_disc = _path_of(Path, points, str(self.get_marker()), size)
            context = renderer.new_gc()
            # Matplotlib offers no other way to keep what an artist of its own draws inside the axes.
            self._set_gc_clip(context)  # type: ignore[attr-defined]
            context.set_alpha(self.get_alpha())
            face = None if is_disc or self.get_marker() == "x" else to_rgba(self.get_color())
            strokes = [(self.get_markeredgecolor(), edge)]
            if is_disc:
                context.set_capstyle("round")
                strokes = [(self.get_markeredgecolor(), size + 2.0 * edge)] if edge else []
                strokes.append((self.get_color(), size))
            for colour, width in strokes:
                context.set_foreground(colour)
                context.set_linewidth(width)
                renderer.draw_path(context, path, IdentityTransform(), face)
            context.restore()

    return Marks


def _path_of(path_class: Any, points: FloatArray, mark: str, size_px: float) -> tuple[Any, bool]:
    """All marks as one path in pixels of the page, and whether they are discs: strokes of no length with round ends."""
    from matplotlib.markers import MarkerStyle

    if mark == "o":
        corners, codes = np.array([[0.0, 0.0], [0.01, 0.0]]), np.array([path_class.MOVETO, path_class.LINETO])
    else:
        style = MarkerStyle(mark)
        one = style.get_path().transformed(style.get_transform())
        corners = size_px * np.asarray(one.vertices)
        lines = [path_class.MOVETO] + [path_class.LINETO] * (len(corners) - 1)
        codes = np.asarray(lines if one.codes is None else one.codes)
    path = path_class((points[:, None] + corners).reshape(-1, 2), np.tile(codes, len(points)).astype(np.uint8))
    # Simplifying a path drops the shortest strokes: all discs.
    path.should_simplify = False
    return path, mark == "o"
