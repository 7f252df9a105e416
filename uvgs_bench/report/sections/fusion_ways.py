"""All ways of fusing beside one another: errors, consistency, what was refused, time."""

from __future__ import annotations

import numpy as np

from uvgs_bench.navigation.fusion_outcome import FusedRun, FusionOutcome
from uvgs_bench.report.cells import ABSENT, Cell, Number
from uvgs_bench.report.document import Block, Column, Paragraph, Section, Table
from uvgs_bench.units import deg_from_rad, mm_from_m, percent_from_fraction


def build(outcome: FusionOutcome) -> Section | None:
    """Tables of errors, of believed poses and of time."""
    blocks: list[Block] = []
    if outcome.source.truth is not None:
        rows = [_errors(run) for run in outcome.runs]
        raw = outcome.raw
        errors_mm = Number(mm_from_m(raw.position_rms_m), 2), Number(mm_from_m(raw.worst_m), 1)
        angle_deg = Number(deg_from_rad(raw.attitude_rms_rad), 3)
        rows.append(("sensor alone, at its captures", *errors_mm, angle_deg, ABSENT, ABSENT))
        columns = (
            Column("Way"), Column("Position RMS", "mm", True), Column("Worst", "mm", True),
            Column("Attitude RMS", "deg", True), Column("Mean NEES", "", True), Column("Lost", "%", True),
        )  # fmt: skip
        blocks.append(
            Table("Errors against the truth. Of the NEES of nine errors 9 is expected.", columns, tuple(rows))
        )
        if any(run.result.method == "ar_swap" for run in outcome.runs):
            blocks.append(Paragraph("Poses alone state no covariance of velocity, so that there is no NEES."))
    blocks.append(_updates(outcome))
    blocks.append(_times(outcome))
    return Section("ways", "Ways of fusing", tuple(blocks))


def _errors(run: FusedRun) -> tuple[Cell, ...]:
    score = run.score
    nees = score.nees[np.isfinite(score.nees)]
    return (
        run.name,
        Number(mm_from_m(score.position_rms_m), 2),
        Number(mm_from_m(score.worst_m), 1),
        Number(deg_from_rad(score.attitude_rms_rad), 3),
        Number(float(nees.mean()) if len(nees) else None, 1),
        Number(percent_from_fraction(score.lost_share), 1),
    )


def _updates(outcome: FusionOutcome) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for run in outcome.runs:
        for source, counts in run.score.counts.items():
            nis = run.score.nis[source]
            nis = nis[np.isfinite(nis)]
            numbers = [Number(counts.get(status, 0), 0) for status in ("fused", "refused", "reopened", "too_old")]
            false = Number(run.score.false_believed, 0) if source == "uvgs" and outcome.false_ns else ABSENT
            rows.append((f"{run.name}: {source}", *numbers, Number(float(nis.mean()) if len(nis) else None, 1), false))
    columns = (
        Column("Way: source"), Column("Believed", "", True), Column("Refused", "", True),
        Column("Believed after refusals", "", True), Column("Too old", "", True), Column("Mean NIS", "", True),
        Column("False, believed", "", True),
    )  # fmt: skip
    return Table("What became of the measured poses. Of the NIS of a pose 6 is expected.", columns, tuple(rows))


def _times(outcome: FusionOutcome) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for run in outcome.runs:
        spent = run.result.update_us
        if len(spent):
            rows.append((run.name, *(Number(float(np.percentile(spent, p)), 0) for p in (10, 50, 99))))
    columns = (Column("Way"), Column("p10", "µs", True), Column("Median", "µs", True), Column("p99", "µs", True))
    return Table(
        "Processor time of one update by a measured pose, readings before it not counted.", columns, tuple(rows)
    )
