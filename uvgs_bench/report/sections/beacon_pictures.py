"""How the pictures of a measured beacon fared: named, missed, set aside."""

from __future__ import annotations

import math

from uvgs_bench.report.beacon_evidence import MeasurementEvidence
from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Block, Column, Paragraph, Section, Table

_LISTED = 60


def build(evidence: MeasurementEvidence) -> Section | None:
    """Counts, network figures, sightings set aside."""
    m = evidence.measurement
    mirror = "cannot be mistaken" if math.isinf(m.mirror_margin) else Number(m.mirror_margin, 1)
    rows: list[tuple[Cell, ...]] = [
        ("Pictures looked at", Number(evidence.captures, 0)),
        ("Pictures whose LEDs were named", Number(evidence.named, 0)),
        ("Views used", Number(m.view_count, 0)),
        *((f"Not named: {reason.replace('_', ' ')}", Number(count, 0)) for reason, count in evidence.misses.items()),
        ("Centroid noise per axis, found", Number(m.sigma_px, 4, "px")),
        ("Degrees of freedom left", Number(m.redundancy, 0)),
        ("Condition of the adjustment", Number(m.condition, 0)),
        ("Mirror image costs more by (chi-square)", mirror),
    ]
    blocks: list[Block] = [
        Table("The network of sightings.", (Column("What"), Column("Value", is_numeric=True)), tuple(rows))
    ]
    if not m.rejected:
        blocks.append(Paragraph("No sighting was set aside."))
    else:
        worst = sorted(m.rejected, key=lambda item: -item[2])[:_LISTED]
        columns = (Column("View"), Column("LED"), Column("Off by", "px", True))
        listed = tuple((view, led, Number(px, 2)) for view, led, px in worst)
        more = f" The worst {_LISTED} are listed." if len(m.rejected) > _LISTED else ""
        blocks.append(Table(f"Sightings set aside: {len(m.rejected)}.{more}", columns, listed))
    return Section("pictures", "Pictures", tuple(blocks))
