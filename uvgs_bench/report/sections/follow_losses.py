"""What every loss of sight did, and how the captures without a pose came about."""

from __future__ import annotations

from collections import Counter

from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Block, Column, Paragraph, Section, Table
from uvgs_bench.report.follow_evidence import FollowEvidence
from uvgs_bench.units import mm_from_m


def build(evidence: FollowEvidence) -> Section | None:
    """Two tables; a sentence where nothing was lost."""
    blocks: list[Block] = []
    losses = evidence.quality.losses
    if losses:
        columns = (
            Column("Began", "s", True),
            Column("Lasted", "s", True),
            Column("The law"),
            Column("Why"),
            Column("Largest error", "mm", True),
            Column("In tolerance again after", "s", True),
        )
        rows: list[tuple[Cell, ...]] = [
            (
                Number(loss.begin_s, 2),
                Number(loss.duration_s, 2),
                ", then ".join(loss.modes),
                ", ".join(loss.reasons),
                Number(mm_from_m(loss.worst_m), 1),
                "never" if loss.recovery_s is None else Number(loss.recovery_s, 2),
            )
            for loss in losses
        ]
        blocks.append(Table("Losses of sight, each until recovery.", columns, tuple(rows)))
    counts = Counter(cycle.reason for cycle in evidence.run.cycles if cycle.reason)
    if counts:
        reasons = tuple((reason, Number(count, 0)) for reason, count in counts.most_common())
        blocks.append(
            Table(
                "Captures without a believed pose, by reason.",
                (Column("Reason"), Column("Captures", "", True)),
                reasons,
            )
        )
    if not blocks:
        blocks.append(Paragraph("Every capture gave a pose that was believed."))
    return Section("losses", "Losses", tuple(blocks))
