"""Judge a run as it lies on disk."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from uvgs_bench.accuracy import Judgement, judge
from uvgs_bench.accuracy.independent import Independent
from uvgs_bench.accuracy.judgement import Alert
from uvgs_bench.accuracy.uncertainty import BudgetInputs
from uvgs_bench.devices.bench import BenchFile
from uvgs_bench.errors import ConfigError
from uvgs_bench.store.documents import read_document
from uvgs_bench.store.gantry_records import axis_term_covariance, read_gantry_record
from uvgs_bench.store.observations import observations_from_run
from uvgs_bench.store.run_writer import SETUP, SETUP_BENCH, SETUP_GANTRY
from uvgs_bench.units import mm_from_m, s_from_ms

if TYPE_CHECKING:
    from uvgs_bench.store.run_types import Run


def judge_run(
    run: Run,
    *,
    seed: int | None = None,
    terms: tuple[str, ...] = (),
    independent: Independent | None = None,
) -> Judgement:
    """Register the frames of a run, compute its errors and hold them against the limits it was taken for.

    Args:
        run: A run, finished or not; one that did not end well is judged on what it has, with an alert.
        seed: Seed of the intervals; the run's own when None. The same run and seed give the same judgement.
        terms: Names of ``TERM_GROUPS`` that may be fitted beside the poses, each only when the data ask for it.
        independent: A registration by a board in place of one by the sensor's own poses.

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
        terms=terms,
        independent=independent,
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
    time_sigma_s, half_span_k = _of_bench(run)
    return BudgetInputs(
        lens=run.calibration.lens,
        lens_covariance=run.calibration.covariance,
        leds_m=run.beacon.positions_m,
        led_covariance_m2=run.beacon.covariance_m2,
        axis_covariance=axes,
        time_sigma_s=time_sigma_s,
        temperature_half_span_k=half_span_k,
    )


def _of_bench(run: Run) -> tuple[float | None, float | None]:
    """Doubt of time, s, and half the span of temperature, K, that the run's copy of the bench file states."""
    try:
        gantry = read_document(run.path / SETUP / SETUP_BENCH, BenchFile).gantry
    except ConfigError:
        # Runs from other versions, and those that were put together by hand, may have no bench file of this kind.
        return None, None
    span_k, sigma_ms = gantry.temperature_span_k, gantry.time_sigma_ms
    return None if sigma_ms is None else s_from_ms(sigma_ms), None if span_k is None else 0.5 * span_k
