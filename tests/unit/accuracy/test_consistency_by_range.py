"""The check of the stated covariance is made for each range by itself: a lie about far captures shows there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uvgs_bench.accuracy import error_table, fit_registration
from uvgs_bench.accuracy.blind_bench import observe, random_bench, standard_stations
from uvgs_bench.accuracy.statistics import summarise


def test_a_lie_about_far_captures_shows_there_only() -> None:
    rng = np.random.default_rng(6)
    bench = replace(random_bench(rng), place_sigma_px=0.0)
    stations = standard_stations(rng, places=240, revisits=0, moving=0, shots=1)
    obs = observe(bench, stations, rng)
    registration = fit_registration(obs, gantry_sigma_m=bench.gantry_repeatability_m)
    table = error_table(obs, registration)
    far = table.range_m > np.median(table.range_m)
    # Far captures claim a third of their sigma.
    told = replace(obs, covariance=np.where(far[:, None, None], obs.covariance / 9.0, obs.covariance))
    summary = summarise(error_table(told, registration), rng)
    assert summary is not None
    found = summary.consistency_by_range
    assert len(found) >= 2
    # The last range holds a few places only, too few for a word.
    known = [part for _, part in found if part.mean_nees_over_6.station_count >= 20]
    near, distant = known[0], known[-1]
    assert near.verdict != "inconsistent"
    assert distant.verdict == "inconsistent"
    assert distant.mean_nees_over_6.value > 3.0
    total = sum(part.mean_nees_over_6.capture_count for _, part in found)
    assert total == summary.capture_count
