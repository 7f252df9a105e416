"""A registration's doubt widens squared figures as far as it reaches, not without bounds."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.accuracy.clusters import Clusters
from uvgs_bench.accuracy.intervals import moment_intervals

SIZE_M, PLACES = 1e-5, 40


def intervals(doubt_m: float) -> tuple[float, float, float]:
    rng = np.random.default_rng(5)
    errors = rng.normal(scale=SIZE_M, size=(PLACES, 3))
    factor = np.broadcast_to(doubt_m * np.eye(3, 12), (PLACES, 3, 12))
    found = moment_intervals(errors, factor, Clusters.of(np.arange(PLACES), np.random.default_rng(1))).rms
    return found.low, found.value, found.high


@pytest.mark.parametrize("ratio", [0.0, 0.1, 1.0, 10.0, 100.0])
def test_the_upper_end_follows_the_doubt(ratio: float) -> None:
    low, value, high = intervals(ratio * SIZE_M)
    assert 0.0 <= low <= value <= high
    # Three components shift together by two standard deviations each at most, beside the errors' own doubt.
    assert high < 1.5 * value + 4.0 * ratio * SIZE_M * 3.0**0.5


def test_a_doubt_as_large_as_the_figure_leaves_no_lower_end() -> None:
    assert intervals(2.0 * SIZE_M)[0] == 0.0


def test_without_a_doubt_the_interval_is_that_of_the_places() -> None:
    low, value, high = intervals(0.0)
    # 120 components: a mean square is known to 13 %, its root to 6.5 %; two of those.
    assert 0.8 < low / value < 0.93
    assert 1.06 < high / value < 1.25
