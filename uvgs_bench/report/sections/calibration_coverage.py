"""Where the boards were: over the picture, how tilted, how far."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.fitting import CalibrationResult
from uvgs_bench.camera.residual_structure import Coverage
from uvgs_bench.report.calibration_evidence import CalibrationEvidence, kept_masks
from uvgs_bench.report.cells import Number
from uvgs_bench.report.document import Column, Figure, Section, Table
from uvgs_bench.report.figures import canvas, series, style, svg_of, thinned
from uvgs_bench.report.maps import draw_circles, picture_canvas
from uvgs_bench.report.palette import BLUE, FAINT, ORANGE
from uvgs_bench.units import deg_from_rad

_RINGS_DEG = (15.0, 30.0, 45.0)


def build(evidence: CalibrationEvidence) -> Section | None:
    """Corners over the picture, tilts, distances."""
    result = evidence.result
    if result is None:
        return None
    blocks = (_figures(result), _corners(result), _tilts(result), _distances(result))
    return Section("coverage", "Coverage", blocks)


def _is_empty(covered: Coverage) -> NDArray[np.bool_]:
    """Cells that light reaches and no corner was seen in, shape (rows, columns)."""
    result: NDArray[np.bool_] = (covered.counts == 0) & covered.is_lit
    return result


def _figures(result: CalibrationResult) -> Table:
    covered = result.coverage
    tilts, distances = deg_from_rad(covered.tilts_rad), covered.distances_m
    empty = int(_is_empty(covered).sum())
    rows = (
        ("Covered radius", Number(covered.radius_px, 0, "px")),
        ("Farthest the picture reaches", Number(covered.picture_radius_px, 0, "px")),
        ("Side that limits it", (covered.short_sides or ("no single side",))[0]),
        (f"Cells without a corner, of {int(covered.is_lit.sum())}", Number(empty, 0)),
        ("Tilt, smallest", Number(float(tilts.min()), 1, "deg")),
        ("Tilt, largest", Number(float(tilts.max()), 1, "deg")),
        ("Boards tilted by more than 30 deg", Number(int((tilts > 30.0).sum()), 0)),
        ("Distance, smallest", Number(float(distances.min()), 3, "m")),
        ("Distance, largest", Number(float(distances.max()), 3, "m")),
    )
    return Table("Coverage in figures.", (Column("What"), Column("Value", is_numeric=True)), rows)


def _corners(result: CalibrationResult) -> Figure:
    lens, covered = result.calibration.lens, result.coverage
    px = np.concatenate([view.px[mask] for view, mask in zip(result.views, kept_masks(result), strict=True)])
    rows, columns = covered.counts.shape
    empty = int(_is_empty(covered).sum())
    key = "coverage-picture"
    alt = (
        f"{len(px)} corners of {len(result.views)} boards over the picture of {lens.width_px} by {lens.height_px} px; "
        f"{empty} of {int(covered.is_lit.sum())} cells hold none; covered to {covered.radius_px:.0f} of "
        f"{covered.picture_radius_px:.0f} px from the principal point."
    )
    with style(key):
        figure, axes = picture_canvas(lens.width_px, lens.height_px)
        width, height = lens.width_px / columns, lens.height_px / rows
        for row, column in np.argwhere(_is_empty(covered)):
            left, top = column * width - 0.5, row * height - 0.5
            axes.fill_between([left, left + width], top, top + height, color=FAINT, alpha=0.22, lw=0.0)
        shown = thinned(len(px))
        axes.plot(px[shown, 0], px[shown, 1], ".", color=BLUE, ms=2.5)
        axes.plot(lens.cx_px, lens.cy_px, "+", color=ORANGE, ms=9, mew=1.6)
        verdict = result.calibration.verdict
        usable_px = 0.0 if verdict is None else verdict.radius_px
        draw_circles(axes, lens, covered.radius_px, usable_px)
        svg = svg_of(figure, key, alt)
    caption = "Kept corners (dots), principal point (cross); grey cells hold no corner."
    return Figure(key, svg, alt, caption, (series("column", "px", px[:, 0]), series("row", "px", px[:, 1])))


def _tilts(result: CalibrationResult) -> Figure:
    # The board's normal as it leans in the picture; a board and its back lean alike.
    normals = np.array([pose.R[:, 2] * np.sign(pose.R[2, 2]) for pose in result.camera_from_board])
    angle = deg_from_rad(result.coverage.tilts_rad)
    lean = normals[:, :2] / np.maximum(np.linalg.norm(normals[:, :2], axis=1), 1e-12)[:, None]
    place = lean * angle[:, None]
    # Four quarters that a tilt may point to.
    quarter = np.bincount((place[:, 0] > 0) * 2 + (place[:, 1] > 0), weights=angle > _RINGS_DEG[0], minlength=4)
    key = "coverage-tilt"
    alt = (
        f"Tilts of {len(angle)} boards from {angle.min():.0f} to {angle.max():.0f} deg; {int((angle > 30).sum())} "
        f"exceed 30 deg. Tilted by more than 15 deg towards the four quarters of the picture: "
        f"{', '.join(str(int(count)) for count in quarter)}."
    )
    with style(key):
        figure = canvas(3.6)
        axes = figure.add_subplot()
        turn = np.linspace(0.0, 2.0 * np.pi, 121)
        for ring in _RINGS_DEG:
            axes.plot(ring * np.cos(turn), ring * np.sin(turn), "-", color=FAINT, lw=0.8)
            place_of_label = (-0.71 * ring, 0.71 * ring)
            axes.annotate(f"{ring:g}°", place_of_label, color=FAINT, fontsize=8, ha="right", va="top")
        axes.plot(place[:, 0], place[:, 1], "o", color=BLUE, ms=5, alpha=0.85)
        reach = 1.1 * max(_RINGS_DEG[-1], float(angle.max()))
        axes.set_xlim(-reach, reach)
        axes.set_ylim(reach, -reach)
        axes.set_aspect("equal")
        axes.grid(False)
        axes.set_xlabel("normal leans right (deg)")
        axes.set_ylabel("normal leans down (deg)")
        svg = svg_of(figure, key, alt)
    caption = "Which way and how far each board was tilted. Good sets fill the ring from 30 to 45 deg on all sides."
    return Figure(
        key, svg, alt, caption, (series("leans right", "deg", place[:, 0]), series("leans down", "deg", place[:, 1]))
    )


def _distances(result: CalibrationResult) -> Figure:
    distances, tilts = result.coverage.distances_m, deg_from_rad(result.coverage.tilts_rad)
    key = "coverage-distance"
    alt = (
        f"Tilt against distance of {len(distances)} boards: {distances.min():.3g} to {distances.max():.3g} m, "
        f"farthest over nearest {distances.max() / distances.min():.2f}."
    )
    with style(key):
        figure = canvas(3.6)
        axes = figure.add_subplot()
        axes.plot(distances, tilts, "o", color=BLUE, ms=5, alpha=0.85)
        axes.set_xlim(left=0.0, right=1.08 * float(distances.max()))
        axes.set_ylim(0.0, 1.1 * max(_RINGS_DEG[-1], float(tilts.max())))
        axes.set_xlabel("distance of the board's middle (m)")
        axes.set_ylabel("tilt (deg)")
        svg = svg_of(figure, key, alt)
    caption = "Distance and tilt of each board. Boards at one distance cannot tell focal length from distance."
    return Figure(key, svg, alt, caption, (series("distance", "m", distances), series("tilt", "deg", tilts)))
