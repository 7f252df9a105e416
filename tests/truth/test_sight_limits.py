"""What a run says it could have shown is what it shows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.accuracy import fit_registration
from uvgs_bench.accuracy.blind_bench import (
    BlindBench,
    PlannedStations,
    observe,
    planted,
    random_bench,
    standard_stations,
)
from uvgs_bench.accuracy.diagnosis import Diagnosis, examine
from uvgs_bench.units import fraction_from_percent

NAMES = ("bottom", "left", "right", "apex")


def examined(bench: BlindBench, stations: PlannedStations, rng: np.random.Generator) -> Diagnosis:
    obs = observe(bench, stations, rng)
    registration = fit_registration(obs, gantry_sigma_m=bench.gantry_repeatability_m)
    return examine(obs, registration, bench.lens, bench.leds_m, NAMES)


def named_at(share: float, tries: int) -> int:
    """How often a wrong axis is named whose size is a share of what a clean run said it could show."""
    rng = np.random.default_rng(8)
    bench, stations = random_bench(rng), standard_stations(rng)
    limit = next(x for x in examined(bench, stations, rng).limits if x.title.startswith("gantry axis x "))
    assert limit.unit == "%"
    bent = planted(bench, "axis_scale", share * fraction_from_percent(limit.least))
    found = [examined(bent, stations, rng).suspects for _ in range(tries)]
    return sum(any(s.cause == "axis_scale" for s in suspects) for suspects in found)


def test_a_cause_at_its_limit_is_named_and_one_far_below_is_not() -> None:
    # With 95 % each, and with hardly more than the false alarms of a clean bench.
    assert named_at(1.0, 4) >= 3
    assert named_at(0.15, 4) <= 1


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_cause_at_its_limit_is_named_long() -> None:
    # 95 % of 60 less three standard deviations of the count, as far as the scatter is known.
    assert named_at(1.0, 60) >= 51
    assert named_at(0.15, 60) <= 6


def test_looking_along_an_axis_hides_its_leans_and_a_run_says_so() -> None:
    leasts = []
    for is_oblique in (True, False):
        rng = np.random.default_rng(4)
        bench = random_bench(rng, is_oblique=is_oblique)
        found = examined(bench, standard_stations(rng), rng)
        leasts.append(next(x.least for x in found.limits if x.title == "gantry axes x and y are not square"))
    assert leasts[1] > 2.0 * leasts[0]


def test_what_was_not_tried_cannot_be_seen() -> None:
    rng = np.random.default_rng(4)
    bench = random_bench(rng)
    stations = standard_stations(rng, moving=0)
    one_side = replace(stations, approach=np.ones_like(stations.approach))
    leasts = {x.cause: x.least for x in examined(bench, one_side, rng).limits}
    assert math.isinf(leasts["latency"])
    assert math.isinf(leasts["backlash"])
