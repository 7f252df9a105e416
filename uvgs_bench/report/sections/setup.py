"""What was set up, and how the run went."""

from __future__ import annotations

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.report.bench_drawing import bench_figure
from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Block, Column, Section, Table
from uvgs_bench.report.quantities import stations_taken
from uvgs_bench.store.run import Run
from uvgs_bench.units import deg_from_rad, mm_from_m, s_from_ns


def build(run: Run, judgement: Judgement) -> Section | None:
    """A picture of the bench, procedure, devices, axes, progress."""
    blocks: list[Block] = []
    drawing = None if judgement.registration is None else bench_figure(run, judgement.registration)
    if drawing is not None:
        blocks.append(drawing)
    blocks += [_run_table(run), _axes_table(run.manifest.axes)]
    return Section("setup", "Set-up", tuple(blocks))


def _run_table(run: Run) -> Table:
    m = run.manifest
    driven = sum(sample.station >= m.station_count > 0 for sample in run.samples)
    duration_s = s_from_ns(run.samples[-1].t_ns - run.samples[0].t_ns) if run.samples else None
    fitted = len({sample.station for sample in run.samples if sample.role == "register"})
    rows: list[tuple[Cell, ...]] = [
        ("Procedure", m.procedure_name),
        ("Camera", m.camera_spec),
        ("Gantry", m.gantry_spec),
        ("Gantry judged by", m.gantry_info.get("judged_by", "not recorded")),
        ("Simulated", "YES: camera or gantry are software" if m.simulated else "no: real camera and gantry"),
        ("Mount", m.mount.replace("_", " ")),
        (
            "Stations taken",
            f"{stations_taken(run)} of {m.station_count} planned, {fitted} of them to fit the registration",
        ),
        ("Captures per station", Number(m.captures_per_station, 0)),
        ("Captures taken", Number(len(run.samples), 0)),
        *((("Of them along the motion", Number(driven, 0)),) if driven else ()),
        ("Settling before the first exposure", Number(m.settle_s, 2, "s")),
        ("First to last capture", Number(duration_s, 1, "s")),
        ("Began", m.created_utc),
        ("Ended", run.ended_utc or "not recorded"),
        ("How it ended", ": ".join(t for t in (run.ended or "no end recorded", run.end_reason) if t)),
        ("Pictures kept", m.keep),
    ]
    for number, seam in enumerate(run.seams, start=1):
        moved = f"reference station off by {mm_from_m(seam.shift_m):.3f} mm, {deg_from_rad(seam.shift_rad):.4f} deg"
        checked = moved if seam.reference_station >= 0 else "no reference station to check"
        if seam.accepted:
            checked += f"; CHANGED since it was begun and accepted: {', '.join(seam.accepted)}"
        rows.append((f"Resumed, {number}", f"{seam.resumed_utc}, from sample {seam.first_index} on; {checked}"))
    rows += [("Remark", remark) for remark in run.remarks]
    return Table("The run.", (Column("What"), Column("Value")), tuple(rows))


def _axes_table(axes: tuple[Axis, ...]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for axis in axes:
        linear = axis.kind == "linear"
        convert, unit = (mm_from_m, "mm") if linear else (deg_from_rad, "deg")
        rows.append(
            (
                axis.name,
                axis.kind,
                ", ".join(f"{component:.4g}" for component in axis.direction),
                Number(convert(axis.lower), 1, unit),
                Number(convert(axis.upper), 1, unit),
                Number(convert(axis.max_speed), 1, f"{unit}/s"),
                Number(convert(axis.backlash), 3, unit),
            )
        )
    columns = (
        Column("Axis"),
        Column("Kind"),
        Column("Direction"),
        *(Column(label, is_numeric=True) for label in ("From", "To", "Speed", "Backlash")),
    )
    return Table("Axes of the gantry as declared: the truth this report is measured against.", columns, tuple(rows))
