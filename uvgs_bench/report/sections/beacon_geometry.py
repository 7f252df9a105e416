"""A beacon as its file says, for the forecast."""

from __future__ import annotations

from uvgs_bench.report.beacon_drawing import beacon_figures, led_table
from uvgs_bench.report.beacon_evidence import ForecastEvidence
from uvgs_bench.report.document import Section


def build(evidence: ForecastEvidence) -> Section | None:
    """LED positions and drawings."""
    return Section("geometry", "Beacon", (led_table(evidence.beacon), *beacon_figures(evidence.beacon)))
