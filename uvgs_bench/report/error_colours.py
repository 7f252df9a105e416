"""Errors by colour: bands between round levels, dark where they are small, light where they are large, in grey too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.figures import WIDTH_IN
from uvgs_bench.report.marks import draw_marks
from uvgs_bench.report.palette import FAINT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

BAR_IN = 0.62
"""Height of a bar of colours with its ticks and words, inches."""

_MOST_BANDS = 8
_SHARE_INSIDE = 98.0
_SMALLEST_PT, _LARGEST_PT = 3.6, 7.2


@dataclass(frozen=True, slots=True, eq=False)
class ErrorColours:
    """Bands of errors with their colours.

    Args:
        levels: Bounds of the bands, rising from 0, shape (n + 1,); the last band holds everything larger, too.
        colours: One per band, length n.
        is_open: Whether values beyond the last level exist.
    """

    levels: FloatArray
    colours: tuple[str, ...]
    is_open: bool

    def band(self, values: FloatArray) -> np.ndarray[Any, np.dtype[np.intp]]:
        """Band of each value, shape (N,), of values (N,)."""
        return np.clip(np.searchsorted(self.levels, values, side="right") - 1, 0, len(self.colours) - 1)


def error_colours(values: FloatArray) -> ErrorColours:
    """Bands that part most of the errors; the largest few share the last one.

    Args:
        values: Lengths of errors, shape (N,), N >= 1.

    Returns:
        The bands; their colours are perceptually uniform (cividis) and rise in lightness.
    """
    from matplotlib import colormaps
    from matplotlib.colors import to_hex
    from matplotlib.ticker import MaxNLocator

    largest = float(values.max())
    top = float(np.percentile(values, _SHARE_INSIDE)) if len(values) >= 50 else largest
    levels = MaxNLocator(_MOST_BANDS, steps=[1, 2, 2.5, 5, 10]).tick_values(0.0, top if top > 0.0 else 1.0)
    count = len(levels) - 1
    colours = tuple(str(to_hex(colormaps["cividis"]((k + 0.5) / count))) for k in range(count))
    return ErrorColours(np.asarray(levels), colours, largest > float(levels[-1]))


def draw_by_error(axes: Axes, places: FloatArray, values: FloatArray, bands: ErrorColours, mark: str) -> None:
    """Draw marks whose colour and size say how large an error is, the larger ones on top.

    Args:
        axes: Where to draw.
        places: Abscissae and ordinates, shape (2, N).
        values: Lengths of errors, shape (N,).
        bands: Their bands.
        mark: Shape of the marks.
    """
    band = bands.band(values)
    sizes_pt = np.linspace(_SMALLEST_PT, _LARGEST_PT, len(bands.colours))
    for k, (colour, size_pt) in enumerate(zip(bands.colours, sizes_pt, strict=True)):
        chosen = band == k
        if chosen.any():
            draw_marks(axes, places[:, chosen], mark, colour=colour, size_pt=float(size_pt), edge=FAINT)


def draw_bar(figure: Canvas, bands: ErrorColours, label: str) -> None:
    """Draw the bar that says what colours mean, along the lower edge of a figure.

    Args:
        figure: The figure; its lowest ``BAR_IN`` must be free.
        bands: The bands.
        label: What is drawn, with its unit.
    """
    height_in = figure.get_size_inches()[1]
    axes = figure.add_axes((0.8 / WIDTH_IN, 0.42 / height_in, 1.0 - 1.6 / WIDTH_IN, 0.14 / height_in))
    axes.barh(
        np.zeros(len(bands.colours)), np.diff(bands.levels), left=bands.levels[:-1], height=1.0, color=bands.colours
    )
    axes.set_xlim(float(bands.levels[0]), float(bands.levels[-1]))
    axes.set_ylim(-0.5, 0.5)
    axes.set_yticks([])
    axes.grid(False)
    axes.spines["left"].set_visible(False)
    axes.set_xticks(bands.levels, [f"{level:g}" for level in bands.levels])
    if bands.is_open:
        axes.annotate("and more", (1.0, 0.5), (4, 0), xycoords="axes fraction", textcoords="offset points", va="center")
    axes.set_xlabel(label)
