"""Residuals of each LED against the angle it was seen at: a bright centre that wanders shows as a slope."""

from __future__ import annotations

import numpy as np

from uvgs_bench.beacon.measure_types import LedResiduals
from uvgs_bench.report.beacon_evidence import MeasurementEvidence
from uvgs_bench.report.document import Block, Figure, Paragraph, Section
from uvgs_bench.report.figures import canvas, label_of, series, style, svg_of, thinned
from uvgs_bench.report.palette import BLUE, FAINT, ORANGE
from uvgs_bench.units import deg_from_rad

_BINS = 5
_FEWEST = 3


def build(evidence: MeasurementEvidence) -> Section | None:
    """One drawing per LED with an axis."""
    leds = evidence.measurement.leds
    drawn = [led for led in leds if led.angle_rad.size]
    title = "Residuals against view angle"
    if not drawn:
        text = "No LED of the nominal beacon states its axis, so angles of view are unknown."
        return Section("angles", title, (Paragraph(text),))
    text = (
        "Residual along the picture of the LED's axis, by the angle between the axis and the line of sight. Marks that "
        "scatter about zero at every angle belong to a centre that stays where it is."
    )
    reach = max(float(np.abs(led.along_axis_px).max()) for led in drawn)
    blocks: list[Block] = [Paragraph(text)]
    blocks += [_drawing(led, i, 1.1 * max(reach, 1e-6), evidence) for i, led in enumerate(drawn)]
    return Section("angles", title, tuple(blocks))


def _drawing(led: LedResiduals, number: int, reach_px: float, evidence: MeasurementEvidence) -> Figure:
    angle, along = deg_from_rad(led.angle_rad), led.along_axis_px
    key = f"angle-{number}"
    order = np.argsort(angle, kind="stable")
    means = [(float(angle[part].mean()), float(along[part].mean())) for part in np.array_split(order, _BINS)
             if len(part) >= _FEWEST]  # fmt: skip
    worst = max((abs(mean) for _, mean in means), default=float(np.abs(along.mean())))
    alt = (
        f"LED {led.name}: residuals along its axis in {len(along)} sightings at {angle.min():.0f} to {angle.max():.0f} "
        f"deg; standard deviation {along.std():.3f} px, largest mean of a fifth of them {worst:.3f} px."
    )
    sigma_px = evidence.measurement.sigma_px
    with style(key):
        figure = canvas(2.8)
        axes = figure.add_subplot()
        axes.axhspan(-sigma_px, sigma_px, color=FAINT, alpha=0.15, lw=0.0)
        axes.axhline(0.0, color=FAINT, lw=1.0)
        shown = thinned(len(along))
        axes.plot(angle[shown], along[shown], ".", color=BLUE, ms=4)
        if means:
            axes.plot(*zip(*means, strict=True), "D-", color=ORANGE, ms=5, lw=1.2)
        axes.set_ylim(-reach_px, reach_px)
        axes.set_xlim(left=0.0)
        axes.set_xlabel("angle of view (deg)")
        axes.set_ylabel("along axis (px)")
        axes.set_title(f"LED {label_of(led.name)}")
        svg = svg_of(figure, key, alt)
    caption = f"LED {led.name}. Diamonds: means of a fifth of the sightings; band: centroid noise, 1 sigma."
    return Figure(key, svg, alt, caption, (series("angle", "deg", angle), series("along axis", "px", along)))
