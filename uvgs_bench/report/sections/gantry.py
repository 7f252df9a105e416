"""The gantry's own test: how straight, square and repeatable the truth of this report was found to be."""

from __future__ import annotations

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.errors import UvgsError
from uvgs_bench.report.cells import Cell, Interval, Measured, Number
from uvgs_bench.report.document import Alert, Alerts, Block, Column, Paragraph, Section, Table
from uvgs_bench.store.gantry_records import AxisRecord, GantryRecord, read_gantry_record
from uvgs_bench.store.run import Run
from uvgs_bench.store.run_writer import SETUP, SETUP_GANTRY

_FIGURES = (
    ("Excess of travel", "scale_ppm", "scale_sigma_ppm", "ppm", 0),
    ("Drift", "drift_mm_per_h", "drift_sigma_mm_per_h", "mm/h", 4),
)
_PLAIN = (
    ("Repeatability R, from both sides (ISO 230-2)", "repeatability_mm"),
    ("Repeatability R, from below", "repeatability_up_mm"),
    ("Repeatability R, from above", "repeatability_down_mm"),
    ("Reversal B (ISO 230-2)", "reversal_mm"),
    ("Systematic deviation E (ISO 230-2)", "systematic_mm"),
    ("Accuracy A (ISO 230-2)", "accuracy_mm"),
    ("Pose repeatability, after ISO 9283", "pose_repeatability_mm"),
    ("Largest deviation from a constant scale, not corrected", "bend_mm"),
    ("Scatter of the instrument at rest, 1σ", "instrument_mm"),
)
_BOUNDED = (
    ("Backlash", "backlash_mm", "backlash_low_mm", "backlash_high_mm"),
    ("Scatter after homing anew, 1σ", "homing_mm", "homing_low_mm", "homing_high_mm"),
)


def build(run: Run, judgement: Judgement) -> Section | None:
    """What the characterisation found, from the run's own copy of its record."""
    del judgement
    path = run.path / SETUP / SETUP_GANTRY
    if not path.is_file():
        return None
    try:
        record = read_gantry_record(path)
    except UvgsError as error:
        text = f"The run's copy of the gantry's record cannot be read: {error}"
        return Section("gantry", "Gantry self-test", (Alerts((Alert("warning", text),)),))
    blocks: list[Block] = [
        Paragraph(f"Taken {record.created_utc} on {record.name}. Judged by: {record.judged_by}."),
        _axes_table(record),
    ]
    if record.pairs:
        rows = tuple(
            (
                " – ".join(pair.axes),
                Number(pair.squareness_mrad, 3, "mrad"),
                Number(pair.squareness_sigma_mrad, 3, "mrad"),
            )
            for pair in record.pairs
        )
        labels = (
            Column("Axes"),
            Column("Less than a right angle", "mrad", True),
            Column("Its doubt, 1σ", "mrad", True),
        )
        blocks.append(Table("Squareness of pairs of axes.", labels, rows))
    if record.remarks:
        blocks.append(Alerts(tuple(Alert("info", remark) for remark in record.remarks)))
    return Section("gantry", "Gantry self-test", tuple(blocks))


def _axes_table(record: GantryRecord) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for label, value, sigma, unit, decimals in _FIGURES:
        cells = [_with_sigma(axis, value, sigma, unit, decimals) for axis in record.axes]
        rows.append((f"{label}, 1σ range", *cells))
    for label, value in _PLAIN:
        rows.append((label, *(Number(getattr(axis, value), 4, "mm") for axis in record.axes)))
    for label, value, low, high in _BOUNDED:
        rows.append((f"{label}, 95 % interval", *(_bounded(axis, value, low, high) for axis in record.axes)))
    measured = tuple(row for row in rows if any(_is_there(cell) for cell in row[1:]))
    columns = (Column("Figure"), *(Column(f"Axis {axis.name}", is_numeric=True) for axis in record.axes))
    return Table("What was measured of each axis; the instrument's own scatter is in all of it.", columns, measured)


def _is_there(cell: Cell) -> bool:
    return not isinstance(cell, Number) or cell.value is not None


def _with_sigma(axis: AxisRecord, value: str, sigma: str, unit: str, decimals: int) -> Cell:
    found, doubt = getattr(axis, value), getattr(axis, sigma)
    if found is None or doubt is None:
        return Number(found, decimals, unit)
    return Measured(Number(found, decimals, unit), Interval(found - doubt, found + doubt, decimals, unit))


def _bounded(axis: AxisRecord, value: str, low: str, high: str) -> Cell:
    found, ends = getattr(axis, value), (getattr(axis, low), getattr(axis, high))
    if found is None or None in ends:
        return Number(found, 4, "mm")
    return Measured(Number(found, 4, "mm"), Interval(*ends, 4, "mm"))
