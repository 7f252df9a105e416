"""The captures with the largest errors, with pictures where they were kept."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Block, Column, Gallery, Paragraph, Picture, Section, Table
from uvgs_bench.report.pictures import overlay_png, read_picture
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.store.run import Run, Sample
from uvgs_bench.units import deg_from_rad, mm_from_m

_LISTED = 10
_KEPT = {
    "all": "all, but their files are not in its folder",
    "worst": "the misses and the largest residuals, and a large error need not leave a large residual",
    "none": "none",
}


@dataclass(frozen=True, slots=True, eq=False)
class _Worst:
    sample: Sample
    estimate: PoseEstimate
    position_mm: float
    attitude_deg: float
    range_m: float
    nees: float
    expected_px: FloatArray


def build(run: Run, judgement: Judgement) -> Section | None:
    """The worst ten by position error."""
    table = judgement.table
    if table is None or not table.is_solved.any():
        return None
    by_instant = {(s.station, s.t_ns): s for s in run.samples}
    order = np.argsort(-np.where(table.is_solved, table.position_error_m, -1.0), kind="stable")
    worst: list[_Worst] = []
    for i in order[:_LISTED]:
        sample = by_instant.get((int(table.station[i]), int(table.t_ns[i])))
        if sample is None or not isinstance(sample.outcome, PoseEstimate):
            continue
        leds_m = run.beacon.positions_m @ table.predicted_R[i].T + table.predicted_t_m[i]
        worst.append(
            _Worst(
                sample=sample,
                estimate=sample.outcome,
                position_mm=mm_from_m(float(table.position_error_m[i])),
                attitude_deg=deg_from_rad(float(table.attitude_error_rad[i])),
                range_m=float(table.range_m[i]),
                nees=float(table.nees[i]),
                expected_px=run.calibration.lens.project(leds_m),
            )
        )
    columns = (
        Column("Sample"),
        Column("Station", is_numeric=True),
        Column("Range", "m", True),
        Column("Position error", "mm", True),
        Column("Attitude error", "deg", True),
        Column("Residual, per axis", "px", True),
        Column("Margin", is_numeric=True),
        Column("NEES", is_numeric=True),
    )
    blocks: list[Block] = [
        Table("The held-out captures with the largest position errors.", columns, tuple(_row(w) for w in worst))
    ]
    pictures = tuple(p for w in worst if (p := _picture(run, w)) is not None)
    if run.has_several_beacons:
        blocks.append(Paragraph("No pictures: in a group of beacons the lights are not those of the frame's beacon."))
    elif pictures:
        blocks.append(Paragraph("Circles: LEDs as observed. Crosses: where the registration expects them."))
        blocks.append(Gallery(pictures))
    else:
        blocks.append(Paragraph(f"No picture of these captures was kept: the run kept {_KEPT[run.manifest.keep]}."))
    return Section("worst", "Worst captures", tuple(blocks))


def _row(w: _Worst) -> tuple[Cell, ...]:
    return (
        str(w.sample.index),
        Number(w.sample.station, 0),
        Number(w.range_m, 3, "m"),
        Number(w.position_mm, 3, "mm"),
        Number(w.attitude_deg, 3, "deg"),
        Number(w.estimate.rms_px, 3, "px"),
        Number(w.estimate.margin, 1),
        Number(w.nees, 1),
    )


def _picture(run: Run, w: _Worst) -> Picture | None:
    if not w.sample.capture_file or run.has_several_beacons:
        return None
    image = read_picture(run.path / w.sample.capture_file)
    if image is None:
        return None
    shift = np.hypot(*(w.estimate.led_px - w.expected_px).T)
    far = float(np.nanmax(shift)) if np.isfinite(shift).any() else float("nan")
    return Picture(
        f"worst-{w.sample.index}",
        overlay_png(image, w.estimate.led_px, w.expected_px, run.beacon.led_names),
        f"Capture of sample {w.sample.index} around the beacon; observed LEDs up to {far:.2f} px from where the "
        f"registration expects them; position error {w.position_mm:.3f} mm.",
        f"Sample {w.sample.index}, station {w.sample.station}: {w.position_mm:.3f} mm, {w.attitude_deg:.3f} deg.",
    )
