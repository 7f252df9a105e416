"""Formulas of ISO 9283 and ISO 5725 against small examples worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.accuracy.clusters import Clusters
from uvgs_bench.accuracy.iso_figures import (
    angular_repeatability,
    direction_variation,
    drift,
    pose_accuracy,
    pose_repeatability,
    precision,
)
from uvgs_bench.accuracy.pairs import distance_figures, place_pairs

# Mean (2, 1, 0); distances from it: root 2, root 2, 2.
CYCLES = np.array([[1.0, 0.0, 0.0], [3.0, 0.0, 0.0], [2.0, 3.0, 0.0]])


def test_pose_accuracy_is_the_length_of_the_mean() -> None:
    assert pose_accuracy(CYCLES) == pytest.approx(5.0**0.5)


def test_pose_repeatability_is_mean_distance_and_three_deviations() -> None:
    # lbar = (2 root 2 + 2) / 3 = 1.609476; S_l = root(0.228764 / 2) = 0.338204; RP = lbar + 3 S_l.
    assert pose_repeatability(CYCLES) == pytest.approx(1.609476 + 3.0 * 0.338204, abs=1e-5)
    # Standard deviations by axis: 1, root 3, 0.
    assert angular_repeatability(CYCLES) == pytest.approx(3.0 * 3.0**0.5)


def test_direction_variation_is_the_largest_distance_of_means() -> None:
    errors = np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 2.0, 0.0], [9.0, 9.0, 9.0]])
    # Means (1, 0, 0) from below and (0, 2, 0) from above; where the way is not known it does not count.
    ways = np.array([[1, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 0, 0]], dtype=np.int8)
    assert direction_variation(errors, ways) == pytest.approx(5.0**0.5)
    assert np.isnan(direction_variation(errors[:2], ways[:2]))


def test_distance_accuracy_and_repeatability() -> None:
    observed = np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 0], [1.001, 0, 0], [1.002, 0, 0], [1.003, 0, 0]])
    reference = np.repeat([[5.0, 0.0, 0.0], [5.0, 1.0, 0.0]], 3, axis=0)
    place = np.repeat([4, 7], 3)
    accuracy, repeatability = distance_figures(observed, reference, place_pairs(place))
    # Mean distance 1.002 against 1; deviation 0.001.
    assert accuracy.value == pytest.approx(0.002, abs=1e-12)
    assert repeatability.value == pytest.approx(0.003, abs=1e-12)
    assert np.isinf(accuracy.high)
    assert "only 2 stations" in accuracy.note


def test_precision_of_a_two_by_two_layout() -> None:
    x = np.array([0.0, 2.0, 4.0, 6.0])
    errors = np.stack([x, 0.0 * x, 0.0 * x], axis=1)
    clusters = Clusters.of(np.zeros(4, dtype=np.int64), np.random.default_rng(0))
    found = precision(errors, clusters, np.array([0, 0, 1, 1]))
    # Mean squares 2 within and 16 between along x, a third of that per axis; s_L^2 = (16 - 2) / 2 / 3.
    assert found.within.value**2 == pytest.approx(2.0 / 3.0)
    assert found.between.value**2 == pytest.approx(7.0 / 3.0)
    assert found.total.value**2 == pytest.approx(3.0)
    assert found.limits[1].value == pytest.approx(2.8 * 3.0**0.5)
    assert "at least 8" in found.within.note
    assert "2 runs" in found.total.note
    assert np.isinf(found.total.high)


def test_one_run_has_no_reproducibility_and_says_so() -> None:
    errors = np.random.default_rng(1).normal(size=(30, 3))
    clusters = Clusters.of(np.repeat(np.arange(10), 3), np.random.default_rng(0))
    found = precision(errors, clusters, np.zeros(30, dtype=np.int64))
    # 30 values of one deviation, 20 degrees by 3 axes: 1 within three of its own deviations, 1 / root 120 = 0.09.
    assert found.within.value == pytest.approx(1.0, abs=0.3)
    assert found.within.low < found.within.value < found.within.high
    assert np.isnan(found.total.value)
    assert "one run" in found.total.note
    single = precision(errors[:10], Clusters.of(np.arange(10), np.random.default_rng(0)), np.zeros(10, dtype=np.int64))
    assert np.isnan(single.within.value)


def test_drift_is_told_from_what_differs_between_places() -> None:
    place = np.tile(np.arange(6), 4)
    t_s = np.arange(24.0)
    levels = np.random.default_rng(2).normal(size=(6, 3))
    steady = levels[place]
    moving = steady + t_s[:, None] * np.array([3e-3, 0.0, 4e-3])
    found = drift(moving, t_s, place, np.arange(24), 23.0)
    # 5e-3 per second over 23 s, exactly.
    assert found.value == pytest.approx(0.115, abs=1e-9)
    assert found.high - found.low < 1e-9
    assert drift(steady, t_s, place, np.arange(24), 23.0).value == pytest.approx(0.0, abs=1e-9)
    once = drift(steady[:6], t_s[:6], place[:6], np.arange(6), 5.0)
    assert np.isnan(once.value)
    assert "visited again" in once.note
    few = drift(moving[:12], t_s[:12], place[:12], np.arange(12), 11.0)
    assert np.isinf(few.high)


def test_every_pair_of_places_is_met_once() -> None:
    for count in (2, 5, 6, 11):
        pairs = place_pairs(np.arange(count))
        met = {frozenset(pair) for pair in zip(pairs.i.tolist(), pairs.j.tolist(), strict=True)}
        assert pairs.count == len(met) == count * (count - 1) // 2
    many = place_pairs(np.arange(300))
    used = np.bincount(np.concatenate([many.i, many.j]), minlength=300)
    # Twenty offsets of 300 places, the last of half a turn or less.
    assert used.min() >= 39
    assert used.max() <= 40
    assert place_pairs(np.zeros(5, dtype=np.int64)).count == 0
