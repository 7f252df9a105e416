"""What charts are made of: marks in one path, space in a box, errors by colour, scales of our own."""

from __future__ import annotations

import re

import numpy as np
import pytest

from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.error_colours import error_colours
from uvgs_bench.report.figures import plain_axes, style, svg_of
from uvgs_bench.report.marks import draw_marks
from uvgs_bench.report.palette import FAINT
from uvgs_bench.report.scales import draw_scales
from uvgs_bench.report.space import space_view

RNG = np.random.default_rng(3)


def drawn(places: FloatArray, mark: str, edge: str = "") -> str:
    with style("t"):
        figure, axes = plain_axes()
        draw_marks(axes, places, mark, colour="#123456", edge=edge)
        return svg_of(figure, "t", "marks")


def paths_in(svg: str, colour: str) -> list[str]:
    return re.findall(rf'<path d="([^"]*)"[^>]*(?:fill|stroke): {colour}', svg)


@pytest.mark.parametrize("mark", ["o", "^", "s", "x"])
def test_all_marks_are_one_path_and_none_is_lost(mark: str) -> None:
    places = RNG.normal(size=(2, 300))
    places[:, 7] = np.nan
    (path,) = paths_in(drawn(places, mark), "#123456")
    # A cross is two strokes, every other mark one.
    assert path.count("M") == 299 * (2 if mark == "x" else 1)


def test_a_line_around_discs_is_a_larger_disc_beneath() -> None:
    svg = drawn(RNG.normal(size=(2, 5)), "o", edge=FAINT)
    beneath, above = svg.index(f"stroke: {FAINT}; stroke-width: 4.4"), svg.index("stroke: #123456; stroke-width: 3.4")
    assert beneath < above


def test_a_thousand_marks_cost_few_bytes() -> None:
    few, many = (len(drawn(RNG.normal(size=(2, n)), "o")) for n in (10, 1010))
    # Two points of two numbers with six decimals each, and their letters.
    assert (many - few) / 1000 < 60


def test_the_projection_keeps_lengths_across_the_line_of_sight() -> None:
    with style("t"):
        _, view = space_view(RNG.normal(size=(20, 3)), turn_rad=-0.8)
    # Rows of a rotation: orthonormal to rounding.
    np.testing.assert_allclose(view.matrix @ view.matrix.T, np.eye(2), atol=1e-12)
    # y points down, so the drawing's up is against it.
    assert view.matrix[1, 1] < 0.0


@pytest.mark.parametrize("spread", [(1.0, 1.0, 1.0), (0.01, 0.02, 3.0), (2.0, 0.0, 0.0)])
def test_everything_in_space_lies_within_the_drawing(spread: tuple[float, float, float]) -> None:
    points = RNG.uniform(-1.0, 1.0, size=(200, 3)) * spread
    with style("t"):
        _, view = space_view(points)
    for values, (low, high) in zip(view.of(points), (view.axes.get_xlim(), view.axes.get_ylim()), strict=True):
        assert low < values.min()
        assert values.max() < high


def test_bands_hold_their_values_and_grow_lighter() -> None:
    values = np.abs(RNG.normal(size=400))
    bands = error_colours(values)
    band = bands.band(values)
    inside = values < bands.levels[-1]
    assert (values[inside] >= bands.levels[band[inside]]).all()
    assert (values[inside] < bands.levels[band[inside] + 1]).all()
    assert (band[~inside] == len(bands.colours) - 1).all()
    assert bands.is_open == (not inside.all())
    # Luminance (ITU-R BT.709 weights) must rise, or the map says something else in grey.
    rgb = np.array([[int(c[k : k + 2], 16) for k in (1, 3, 5)] for c in bands.colours])
    assert (np.diff(rgb @ [0.2126, 0.7152, 0.0722]) > 0.0).all()


def test_one_far_error_does_not_wash_out_the_others() -> None:
    values = np.append(np.linspace(0.1, 1.0, 199), 50.0)
    assert error_colours(values).levels[-1] <= 1.5
    assert error_colours(values).is_open


def test_errors_of_nothing_have_bands() -> None:
    assert error_colours(np.zeros(3)).band(np.zeros(3)).tolist() == [0, 0, 0]


def test_scales_say_what_matplotlib_would() -> None:
    with style("t"):
        figure, axes = plain_axes()
        axes.plot([0.0, 10.0], [-0.02, 0.03])
        figure.draw_without_rendering()
        expected = []
        for axis, ends in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            for place, text in zip(axis.get_majorticklocs(), axis.get_ticklabels(), strict=True):
                expected += [text.get_text()] if ends[0] <= place <= ends[1] else []
        draw_scales(axes)
        said = [text.get_text() for text in axes.texts if text.get_text()]
    assert len(said) > 8
    assert said == expected
    assert not axes.xaxis.get_visible()
