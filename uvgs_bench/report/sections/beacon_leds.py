"""Where the LEDs of a measured beacon are, in the frame that was asked for, and how each one fits."""

from __future__ import annotations

from uvgs_bench.beacon.frames import fit_rigid_robust
from uvgs_bench.report.beacon_drawing import beacon_figures, led_table
from uvgs_bench.report.beacon_evidence import MeasurementEvidence
from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Column, Paragraph, Section, Table
from uvgs_bench.units import deg_from_rad, mm_from_m


def build(evidence: MeasurementEvidence) -> Section | None:
    """Positions, fit of each LED, drawings with the frame."""
    beacon, nominal_m = evidence.measurement.beacon, evidence.nominal.positions_m
    R, t = fit_rigid_robust(nominal_m, beacon.positions_m)
    text = f"Frame of the positions: {evidence.measurement.gauge}."
    drawings = beacon_figures(beacon, nominal_m @ R.T + t)
    return Section("leds", "LEDs", (Paragraph(text), led_table(beacon), _fits(evidence), *drawings))


def _fits(evidence: MeasurementEvidence) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (
            led.name,
            Number(mm_from_m(led.deviation_m), 3),
            Number(led.count, 0),
            Number(led.rejected, 0),
            Number(led.rms_px, 3),
            Number(deg_from_rad(led.max_angle_rad), 1),
            Number(mm_from_m(led.shift_m), 3),
            Number(mm_from_m(led.shift_sigma_m), 3),
        )
        for led in evidence.measurement.leds
    ]
    columns = (
        Column("LED"),
        Column("Off nominal", "mm", True),
        Column("Sightings", is_numeric=True),
        Column("Set aside", is_numeric=True),
        Column("RMS per axis", "px", True),
        Column("Widest view", "deg", True),
        Column("Wander", "mm", True),
        Column("Wander, 1 sigma", "mm", True),
    )
    caption = (
        "How each LED fits. Off nominal: after laying most LEDs onto their nominal places. Wander: travel of the "
        "bright centre along the LED's axis from the front to a grazing view."
    )
    return Table(caption, columns, tuple(rows))
