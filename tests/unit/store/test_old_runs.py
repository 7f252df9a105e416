"""Runs of earlier versions stay readable and keep their figures; the folder is as such a version wrote it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from uvgs_bench.report import build_document
from uvgs_bench.report.json_export import render_json
from uvgs_bench.store.judging import judge_run
from uvgs_bench.store.run import read_run

FIRST = Path(__file__).parents[2] / "helpers" / "old_runs" / "schema_1_first"


def test_a_run_of_the_first_version_reads_and_keeps_its_figures() -> None:
    run = read_run(FIRST)
    assert run.is_complete
    assert len(run.samples) == 24
    judgement = judge_run(run)
    assert judgement.summary is not None
    # As that version computed them; the last digits are the order of a sum.
    assert judgement.summary.components["position"].rms.value == pytest.approx(0.0007050106613825142, rel=1e-9)
    assert judgement.summary.components["attitude"].rms.value == pytest.approx(0.0027900004426215084, rel=1e-9)
    assert (judgement.availability.solved, judgement.availability.attempted) == (23, 24)
    data = json.loads(render_json(build_document(run, judgement)))
    assert data["schema"] == 1
    assert data["kind"] == "uvgs_report"
