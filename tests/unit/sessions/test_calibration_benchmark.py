"""The benchmark of a calibration: both find the same minimum, and the command prints what was measured."""

from __future__ import annotations

import json

import numpy as np
import pytest

from uvgs_bench.cli.benchmark_calibration import calibration
from uvgs_bench.sessions import calibration_benchmark
from uvgs_bench.sessions.calibration_benchmark import benchmark_calibration, drawn_views
from uvgs_bench.sessions.events import ignore_events

pytestmark = pytest.mark.opencv


@pytest.fixture(autouse=True)
def fewer_views(monkeypatch):
    """Of the larger set only ten: its size is what the command is for, not what is tested."""

    def few(model: str, columns: int, rows: int, count: int, rng: np.random.Generator) -> list:
        return drawn_views(model, columns, rows, min(count, 10), rng)

    monkeypatch.setattr(calibration_benchmark, "drawn_views", few)


def test_both_find_the_same_minimum():
    found = benchmark_calibration(ignore_events, repeats=1, seed=3)
    # OpenCV takes pixels as 32-bit floats: 6e-5 px of rounding each, far less in the mean.
    assert found.rms_difference_px < 1e-5
    assert (found.corners, found.large_corners, found.large_parameters) == (54, 100, 12)
    assert min(found.fit_s, found.peer_s, found.whole_s, found.large_fit_s, found.large_whole_s) > 0.0


def test_command_prints_text_and_strict_json(capsys):
    calibration(repeats=1, seed=1, quiet=True)
    assert "ours over OpenCV's" in capsys.readouterr().out
    calibration(repeats=1, seed=1, as_json=True, quiet=True)
    assert json.loads(capsys.readouterr().out)["ratio"] > 0.0
