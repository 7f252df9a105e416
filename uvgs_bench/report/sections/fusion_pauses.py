"""What the fusion said while the sensor was silent, and how it took it back."""

from __future__ import annotations

from uvgs_bench.navigation.fusion_outcome import FusionOutcome
from uvgs_bench.report.cells import Number
from uvgs_bench.report.document import Column, Paragraph, Section, Table
from uvgs_bench.units import mm_from_m, s_from_ns


def build(outcome: FusionOutcome) -> Section | None:
    """A row per pause; nothing without any."""
    pauses = outcome.main.score.pauses
    if not pauses:
        return None
    begin_ns = int(outcome.source.imu.t_ns[0]) if len(outcome.source.imu) else outcome.source.sensed[0].t_ns
    rows = tuple(
        (
            f"{s_from_ns(p.pause.start_ns - begin_ns):.1f} s",
            Number(p.pause.length_s, 2),
            Number(mm_from_m(p.worst_m), 1),
            Number(mm_from_m(p.sigma_m), 1),
            Number(p.nees_end, 1),
            Number(p.jump_sigma, 1),
        )
        for p in pauses
    )
    columns = (
        Column("From"),
        Column("Length", "s", True),
        Column("Worst error", "mm", True),
        Column("Stated at its end, 1 sigma", "mm", True),
        Column("NEES at its end", "", True),
        Column("Jump after it", "sigma", True),
    )
    text = (
        "While the sensor is silent the inertial unit and, where there is one, the native localiser go on alone. The "
        "jump is the step of position along the worst axis when the sensor is believed again, in deviations stated "
        "before; 3 are rarely exceeded by chance."
    )
    return Section("pauses", "Pauses of the sensor", (Paragraph(text), Table("Through each pause.", columns, rows)))
