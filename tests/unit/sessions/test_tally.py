"""Counts and times of a stream."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.geometry import Pose
from uvgs_bench.sensor import Miss, PoseEstimate
from uvgs_bench.sensor.handover import Held
from uvgs_bench.sessions.tally import ALL_STAGES, StageTimes, Tally

POSE = PoseEstimate(
    Pose(np.eye(3), np.array([0.0, 0.0, 1.0]), "camera", "beacon"), np.eye(6), 0, "a", np.zeros((4, 2)),
    np.zeros((4, 2)), 0.1, 9.0, 4, None, {"blobs": 1e-3, "solve": 2e-3}, ("weak_evidence",),
)  # fmt: skip
MISS = Miss("blobs", "too_many_blobs", "", 1, "a", 9, {"blobs": 3e-3})


def test_quantiles_are_right_to_a_bin_and_the_histogram_holds_everything():
    rng = np.random.default_rng(3)
    durations_s = 10.0 ** rng.uniform(-5.0, -2.0, 5000)
    times = StageTimes()
    for value in durations_s:
        times.add(float(value))
    for share in (0.5, 0.95, 0.99):
        # A bin is a hundredth of a decade wide: 1.2 % to each side of its middle.
        assert times.quantile_s(share) == pytest.approx(
            np.quantile(durations_s, share, method="inverted_cdf"), rel=0.012
        )
    assert times.longest_s == durations_s.max()
    bins = times.histogram()
    assert sum(count for _, count in bins) == 5000
    assert bins[0][0] <= durations_s.min()


def test_times_beyond_the_bins_and_none_at_all_are_borne():
    times = StageTimes()
    assert (times.quantile_s(0.5), times.histogram()) == (0.0, [])
    for value in (0.0, 1e-12, 5e4):
        times.add(value)
    assert times.count == 3
    assert times.quantile_s(1.0) <= 5e4


def test_held_poses_are_misses_that_are_counted_once_more():
    tally = Tally(("a", "b"))
    tally.add("a", POSE, ("saturated",))
    tally.add("a", Held(POSE, 5, MISS))
    tally.add("b", MISS, is_active=False)
    assert (tally.poses, tally.held, tally.misses.total()) == (1, 1, 2)
    assert tally.beacons["a"].misses == {"blobs/too_many_blobs": 1}
    assert tally.beacons["a"].flags == {"weak_evidence": 1, "saturated": 1}
    assert [tally.beacons[name].active for name in "ab"] == [2, 0]
    assert tally.stages["blobs"].count == 3
    assert tally.stages[ALL_STAGES].longest_s == pytest.approx(3e-3)
