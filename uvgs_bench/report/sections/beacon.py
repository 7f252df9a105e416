"""The beacon as the solver knew it."""

from __future__ import annotations

import numpy as np

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Column, Figure, Section, Table
from uvgs_bench.report.figures import canvas, style, svg_of
from uvgs_bench.report.palette import INK, SERIES
from uvgs_bench.store.run import Run
from uvgs_bench.units import deg_from_rad, mm_from_m


def build(run: Run, judgement: Judgement) -> Section | None:
    """LED positions with their doubt, and a drawing."""
    del judgement
    beacon = run.beacon
    sigma_mm = None
    if beacon.covariance_m2 is not None:
        sigma_mm = mm_from_m(np.sqrt(np.diag(beacon.covariance_m2)).reshape(-1, 3))
    rows: list[tuple[Cell, ...]] = []
    for k, led in enumerate(beacon.leds):
        doubt = None if sigma_mm is None else float(np.sqrt((sigma_mm[k] ** 2).sum()))
        rows.append(
            (
                led.name,
                *(Number(mm_from_m(float(p)), 3) for p in led.position_m),
                Number(doubt, 3),
                Number(None if led.half_angle_rad is None else deg_from_rad(led.half_angle_rad), 1),
                Number(None if led.diameter_m is None else mm_from_m(led.diameter_m), 2),
            )
        )
    columns = (
        Column("LED"),
        *(Column(axis, "mm", True) for axis in "xyz"),
        Column("Doubt, 3-D", "mm", True),
        Column("Half angle", "deg", True),
        Column("Diameter", "mm", True),
    )
    hue = beacon.hue if isinstance(beacon.hue, str) else f"{beacon.hue[0]:g}° to {beacon.hue[1]:g}°"
    known = "measured" if sigma_mm is not None else "not measured: LED errors act like a pose bias and a scale"
    caption = f"Beacon {beacon.name}, {len(beacon.leds)} LEDs, hue {hue}, beacon frame; covariance {known}."
    return Section("beacon", "Beacon", (Table(caption, columns, tuple(rows)), _drawing(beacon)))


def _drawing(beacon: Beacon) -> Figure:
    p = mm_from_m(beacon.positions_m)
    size_mm = float(max(np.linalg.norm(a - b) for a in p for b in p))
    depth_mm = float(np.ptp(p[:, 2]))
    key = "beacon-leds"
    alt = (
        f"Front view of beacon {beacon.name}: {len(p)} LEDs, the farthest two {size_mm:.1f} mm apart, "
        f"{depth_mm:.1f} mm deep along z."
    )
    with style(key):
        figure = canvas(height_in=3.4)
        axes = figure.add_subplot()
        axes.plot(p[:, 0], p[:, 1], "o", color=SERIES[0], ms=7)
        for led, (x, y, z) in zip(beacon.leds, p, strict=True):
            note = f"{led.name}, z {z:.1f}".replace("$", r"\$")
            axes.annotate(note, (x, y), (7, 6), textcoords="offset points", color=INK, fontsize=8.5)
        axes.margins(0.28)
        axes.set_aspect("equal", adjustable="datalim")
        axes.invert_yaxis()
        axes.set_xlabel("x (mm)")
        axes.set_ylabel("y (mm)")
        svg = svg_of(figure, key, alt)
    return Figure(key, svg, alt, "The beacon in the x-y plane of its own frame; z in mm beside each LED.")
