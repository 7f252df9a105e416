"""How the frames were found to sit together, and what the motions could not tell."""

from __future__ import annotations

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.accuracy.registration import Registration
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import euler_zyx_from_rotation, is_near_gimbal_lock
from uvgs_bench.report.cells import Cell, Number, decimals_for
from uvgs_bench.report.document import Alert, Alerts, Block, Column, Paragraph, Section, Table
from uvgs_bench.store.run import Run
from uvgs_bench.units import deg_from_rad, mm_from_m, mrad_from_rad, ms_from_s

# A standard deviation below this is no doubt but the gauge's hold.
_HELD_M = 1e-9
_ABSORBING = (
    "Registration absorbs any constant offset between what the sensor sees and where the gantry is. What remains is "
    "noise, linearity, scale, depth error, drift and cross-coupling; absolute trueness needs more."
)
_INDEPENDENT = (
    "The registration owes nothing to the sensor's poses: constant errors of the sensor stay in the errors of this "
    "report, up to the doubt of the links below."
)


def build(run: Run, judgement: Judgement) -> Section | None:
    """The two constant poses with their doubt, rank, blind spots and gauge."""
    del run
    title = "Registration"
    registration = judgement.registration
    if registration is None:
        return Section("registration", title, (Paragraph("The frames could not be registered; the alerts say why."),))
    r = registration
    blocks: list[Block] = [
        Paragraph(
            f"Fitted to {r.capture_count} captures at {r.station_count} stations by robust least squares on poses; "
            f"captures with lowered weight: {r.downweighted_count}, beyond five times the usual distance: "
            f"{r.outlier_count}. The sensor's scale is never fitted: it would hide the error one looks for."
        ),
        _pose_table(r.left, *r.sigmas("left")),
        _pose_table(r.right, *r.sigmas("right")),
        _quality_table(r),
        *_terms(r),
        Paragraph(_INDEPENDENT if judgement.is_independent else _ABSORBING),
        *_links(judgement),
    ]
    if r.blind_spots:
        blocks.append(Alerts(tuple(Alert("info", f"Not seen by these motions: {text}") for text in r.blind_spots)))
    return Section("registration", title, tuple(blocks))


def _links(judgement: Judgement) -> list[Block]:
    """The chain from the camera to the beacon, with what each link adds to the doubt of a prediction."""
    if not judgement.links:
        return []
    rows: list[tuple[Cell, ...]] = []
    for link in judgement.links:
        position_mm, attitude_deg = mm_from_m(link.position_sigma_m), deg_from_rad(link.attitude_sigma_rad)
        rows.append(
            (
                link.name,
                Number(position_mm, decimals_for([position_mm]), "mm"),
                Number(attitude_deg, decimals_for([attitude_deg]), "deg"),
                "no" if link.is_independent else "yes",
                link.source,
            )
        )
    columns = (
        Column("Link"),
        Column("Adds to position, 1σ", is_numeric=True),
        Column("Adds to attitude, 1σ", is_numeric=True),
        Column("Rests on the sensor"),
        Column("Known from"),
    )
    caption = "The chain from the camera to the beacon: what each link adds to the doubt of where the beacon should be."
    return [Table(caption, columns, tuple(rows))]


def _pose_table(pose: Pose, sigma_rad: FloatArray, sigma_m: FloatArray) -> Table:
    yaw, pitch, roll = euler_zyx_from_rotation(pose.R)
    rows: list[tuple[Cell, ...]] = []
    for k, (axis, angle) in enumerate((("x", roll), ("y", pitch), ("z", yaw))):
        held = sigma_m[k] < _HELD_M
        rows.append(
            (
                f"{axis} of the {pose.target}",
                Number(mm_from_m(float(pose.t_m[k])), 3, "mm"),
                "held" if held else Number(mm_from_m(float(sigma_m[k])), 3, "mm"),
                Number(deg_from_rad(angle), 4, "deg"),
                Number(deg_from_rad(float(sigma_rad[k])), 4, "deg"),
            )
        )
    labels = ("Translation", "Its doubt, 1σ", "Angle, Z-Y-X", "Rotation doubt, 1σ")
    columns = (Column("Axis"), *(Column(label, is_numeric=True) for label in labels))
    caption = (
        f"{pose.target}_from_{pose.source}: the {pose.source} origin in {pose.target} axes. Angles are a view only "
        "(roll, pitch, yaw, intrinsic Z-Y-X); rotation doubt is about each axis; doubts hold in the gauge below."
    )
    if is_near_gimbal_lock(pose.R):
        caption += " Pitch is beyond 80 deg (gimbal lock): only the sum or difference of roll and yaw means anything."
    return Table(caption, columns, tuple(rows))


def _terms(r: Registration) -> list[Block]:
    """What was fitted beside the two poses, with the reason for each term taken or left."""
    rows: list[tuple[Cell, ...]] = []
    if r.axis_terms is not None:
        sigmas = r.axis_terms.sigmas
        for k, axis in enumerate("xyz"):
            ppm, doubt = 1e6 * float(r.axis_terms.scale[k]), 1e6 * float(sigmas[k])
            rows.append((f"Excess of travel along {axis}", Number(ppm, 0, "ppm"), Number(doubt, 0, "ppm")))
        for k, pair in enumerate(("xy", "xz", "yz")):
            lean, doubt = mrad_from_rad(float(r.axis_terms.shear_rad[k])), mrad_from_rad(float(sigmas[3 + k]))
            rows.append((f"Lean of axes {pair}", Number(lean, 3, "mrad"), Number(doubt, 3, "mrad")))
    for name, found in (("Captures are stamped late by", r.time_offset_s), ("growing each second by", r.time_rate)):
        if found is not None:
            # Half of a 95 % interval is about two standard deviations.
            half = 0.25 * (found.high - found.low)
            rows.append((name, Number(ms_from_s(found.value), 3, "ms"), Number(ms_from_s(half), 3, "ms")))
    blocks: list[Block] = []
    if rows:
        columns = (Column("Term"), Column("Value", is_numeric=True), Column("Doubt, 1σ", is_numeric=True))
        caption = "Fitted beside the two poses, because the data ask for it; a doubt of 0: held, not seen."
        blocks.append(Table(caption, columns, tuple(rows)))
    if r.term_notes:
        blocks.append(Alerts(tuple(Alert("info", note) for note in r.term_notes)))
    return blocks


def _quality_table(r: Registration) -> Table:
    rows: tuple[tuple[Cell, ...], ...] = (
        ("Directions seen", f"{r.rank} of 12", "rank of the information"),
        ("Gauge", r.gauge, "how unseen directions were chosen; predictions do not depend on it"),
        ("Variance factor", Number(r.variance_factor, 2), "scatter of station means over what one capture predicts"),
        ("Degrees of freedom", Number(r.degrees_of_freedom, 0), "six per station less the rank"),
        ("Assumed gantry doubt", Number(mm_from_m(r.gantry_sigma_m), 4, "mm"), "standard deviation per axis"),
        ("Iterations", Number(r.iterations, 0), "of the least squares"),
    )
    return Table("Quality of the fit.", (Column("Quantity"), Column("Value"), Column("Meaning")), rows)
