"""The beacon as the solver knew it."""

from __future__ import annotations

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.report.beacon_drawing import beacon_figures, led_table
from uvgs_bench.report.document import Section
from uvgs_bench.store.run import Run


def build(run: Run, judgement: Judgement) -> Section | None:
    """LED positions with their doubt, and drawings."""
    del judgement
    return Section("beacon", "Beacon", (led_table(run.beacon), *beacon_figures(run.beacon)))
