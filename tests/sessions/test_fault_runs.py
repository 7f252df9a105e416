"""Sweeps over a bad line: nothing leaves the envelope, no sample is lost, doubled or false, every end has a reason."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.fault_runs import fault_run


def test_sweeps_over_a_bad_line_end_whole_or_say_why(tmp_path: Path) -> None:
    ends = [fault_run(seed, tmp_path) for seed in range(30)]
    assert {end.first for end in ends} >= {"done", "resumed"}
    assert all(end.reason for end in ends if end.first != "done")


@pytest.mark.slow
@pytest.mark.timeout(0)
@pytest.mark.parametrize("first", range(0, 10_000, 500))
def test_ten_thousand_sweeps_over_a_bad_line(tmp_path: Path, first: int) -> None:
    for seed in range(first, first + 500):
        fault_run(seed, tmp_path)
