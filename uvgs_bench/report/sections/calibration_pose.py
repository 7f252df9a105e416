"""What a calibration does to the pose of a beacon."""

from __future__ import annotations

import numpy as np

from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.camera.pose_doubt import FORECAST_RANGES_M, LED_NOISE_PX, doubt_ahead
from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.calibration_evidence import CalibrationEvidence
from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Column, Figure, Paragraph, Section, Table
from uvgs_bench.report.figures import canvas, legend_above, series, style, svg_of
from uvgs_bench.report.palette import MARKERS, SERIES
from uvgs_bench.units import mm_from_m, mrad_from_rad

_DRAWN = 25


def build(evidence: CalibrationEvidence) -> Section | None:
    """Deviations by range; a sentence where no beacon was given."""
    calibration, beacon = evidence.calibration, evidence.beacon
    if calibration.joint_covariance is None:
        return None
    title = "What it means for a pose"
    if beacon is None:
        text = "No beacon was named (--beacon FILE), so no pose was forecast; the maps below hold for any point."
        return Section("pose", title, (Paragraph(text),))
    text = (
        f"Beacon {beacon.name} faces the camera on its axis. The part of the calibration is the same in every picture: "
        f"averaging does not help, registering on the bench takes part of it out. The part of the LEDs ("
        f"{LED_NOISE_PX} px in each coordinate of each centre) is new in every picture."
    )
    return Section("pose", title, (Paragraph(text), _table(evidence, beacon), *_drawing(evidence, beacon)))


def _table(evidence: CalibrationEvidence, beacon: Beacon) -> Table:
    rows: list[tuple[Cell, ...]] = []
    factor = evidence.too_small or 1.0
    for range_m in FORECAST_RANGES_M:
        doubt = doubt_ahead(evidence.calibration, beacon.positions_m, range_m)
        if doubt is None:
            rows.append((f"{range_m:g} m: an LED is outside the picture", *(Number(None, 3) for _ in range(5))))
            continue
        parts = [("calibration, predicted", doubt.calibration_sigmas), ("LEDs", doubt.noise_sigmas)]
        if factor > 1.0:
            parts.insert(1, (f"calibration, times {factor:.2f}", factor * doubt.calibration_sigmas))
        for name, sigmas in parts:
            place = (Number(float(mm_from_m(s)), 3) for s in sigmas[3:])
            turn = (Number(float(mrad_from_rad(sigmas[:2].max())), 3), Number(float(mrad_from_rad(sigmas[2])), 3))
            rows.append((f"{range_m:g} m, {name}", *place, *turn))
    columns = (
        Column("Range and part"),
        *(Column(axis, "mm", True) for axis in ("x", "y", "z")),
        Column("Tilt, worse axis", "mrad", True),
        Column("Roll", "mrad", True),
    )
    caption = "One standard deviation of the pose by range, camera axes."
    if factor > 1.0:
        caption += f" Two halves of the pictures disagree {factor:.2f} times more than predicted: that row counts it."
    return Table(caption, columns, tuple(rows))


def _drawing(evidence: CalibrationEvidence, beacon: Beacon) -> tuple[Figure, ...]:
    calibration, factor = evidence.calibration, evidence.too_small or 1.0
    ranges = np.geomspace(FORECAST_RANGES_M[0], FORECAST_RANGES_M[-1], _DRAWN)
    found = [doubt_ahead(calibration, beacon.positions_m, float(r)) for r in ranges]
    seen = np.array([doubt is not None for doubt in found])
    if seen.sum() < 2:
        return ()
    ranges = ranges[seen]
    parts: dict[str, FloatArray] = {}
    for words, axes in (("lateral", (3, 4)), ("depth", (5,))):
        for source in ("calibration", "LEDs"):
            covariances = [d.by_calibration if source == "calibration" else d.by_noise for d in found if d is not None]
            variances = np.array([np.diag(C)[list(axes)].max() for C in covariances])
            times = factor if source == "calibration" else 1.0
            parts[f"{words}, {source}"] = mm_from_m(times * np.sqrt(variances))
    key = "pose-range"
    last = ", ".join(f"{name} {values[-1]:.3g} mm" for name, values in parts.items())
    alt = f"Deviation of the position of {beacon.name} from {ranges[0]:.2g} to {ranges[-1]:.2g} m; farthest: {last}."
    with style(key):
        figure = canvas()
        axes_ = figure.add_subplot()
        for (name, values), colour, marker, line in zip(
            parts.items(), (SERIES[0], SERIES[0], SERIES[1], SERIES[1]),
            (MARKERS[0], MARKERS[1], MARKERS[0], MARKERS[1]), ("-", "--", "-", "--"), strict=True,
        ):  # fmt: skip
            axes_.loglog(ranges, values, line, color=colour, marker=marker, ms=3.5, markevery=6, label=name)
        axes_.set_xlabel("range (m)")
        axes_.set_ylabel("1 sigma (mm)")
        axes_.xaxis.set_major_formatter("{x:g}")
        axes_.xaxis.set_minor_formatter("")
        axes_.set_xticks(FORECAST_RANGES_M)
        axes_.yaxis.set_major_formatter("{x:g}")
        legend_above(axes_, 2)
        svg = svg_of(figure, key, alt)
    numbers = (series("range", "m", ranges), *(series(name, "mm", values) for name, values in parts.items()))
    caption = "Position, 1 sigma, by range: lateral is the worse of x and y."
    if factor > 1.0:
        caption += f" The calibration's part times {factor:.2f}, by the halves."
    return (Figure(key, svg, alt, caption, numbers),)
