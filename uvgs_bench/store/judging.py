"""Judge a run as it lies on disk."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from uvgs_bench.accuracy import Judgement, judge
from uvgs_bench.accuracy.judgement import Alert
from uvgs_bench.accuracy.uncertainty import BudgetInputs
from uvgs_bench.store.gantry_records import axis_term_covariance, read_gantry_record
from uvgs_bench.store.observations import observations_from_run
from uvgs_bench.store.run_writer import SETUP, SETUP_GANTRY
from uvgs_bench.units import mm_from_m

if TYPE_CHECKING:
    from uvgs_bench.store.run_types import Run


def judge_run(run: Run, *, seed: int | None = None) -> Judgement:
    """Register the frames of a run, compute its errors and hold them against the limits it was taken for.

    Args:
        run: A run, finished or not; one that did not end well is judged on what it has, with an alert.
        seed: Seed of the intervals; the run's own when None. The same run and seed give the same judgement.

    Returns:
        The judgement.
    """
    judgement = judge(
        observations_from_run(run),
        run.manifest.limits,
        np.random.default_rng(run.manifest.seed if seed is None else seed),
        run_completed=run.is_complete,
        gantry_sigma_m=run.manifest.gantry_sigma_m,
        nominal=run.manifest.mounted,
        lens=run.calibration.lens,
        beacon=run.beacon,
        known=_budget_inputs(run),
    )
    remarks = [Alert("warning", remark) for remark in run.remarks]
    if run.ended != "completed":
        word = run.ended or "still running or killed"
        remarks.append(Alert("warning", f"the run is {word}" + (f": {run.end_reason}" if run.end_reason else "")))
    if run.seams:
        shift_mm = mm_from_m(max(seam.shift_m for seam in run.seams))
        often = "once" if len(run.seams) == 1 else f"{len(run.seams)} times"
        remarks.append(Alert("note", f"the run was resumed {often}; the bench had shifted by up to {shift_mm:.3f} mm"))
    return replace(judgement, alerts=judgement.alerts + tuple(remarks))


def _budget_inputs(run: Run) -> BudgetInputs:
    """What the run's own copies of its set-up say about lens, beacon and axes."""
    record_file = run.path / SETUP / SETUP_GANTRY
    axes = axis_term_covariance(read_gantry_record(record_file)) if record_file.is_file() else None
    return BudgetInputs(
        lens=run.calibration.lens,
        lens_covariance=run.calibration.covariance,
        leds_m=run.beacon.positions_m,
        led_covariance_m2=run.beacon.covariance_m2,
        axis_covariance=axes,
    )
