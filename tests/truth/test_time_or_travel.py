"""Places visited in order along an axis make time and travel one thing: then neither is blamed alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uvgs_bench.accuracy import fit_registration
from uvgs_bench.accuracy.blind_bench import PlannedStations, observe, planted, random_bench, standard_stations
from uvgs_bench.accuracy.diagnosis import Suspect, diagnose

NAMES = ("bottom", "left", "right", "apex")
BENCHES = 12
OF_AXES, OF_TIME = {"axis_scale", "squareness"}, {"drift", "slip"}
# Together they lie along one axis' travel as a drift does, each alone near what such a run can show.
AXIS_TERMS = (("squareness", 5e-4, 0), ("squareness", -5e-4, 1), ("axis_scale", 5e-4, 0))


def along_x(stations: PlannedStations) -> PlannedStations:
    """The same stations at the same instants, taken in slices of x."""
    order = np.lexsort((stations.position_m[:, 1], np.round(stations.position_m[:, 0], 2)))
    return replace(
        stations,
        position_m=stations.position_m[order],
        velocity_mps=stations.velocity_mps[order],
        approach=stations.approach[order],
        shots=stations.shots[order],
        place=stations.place[order],
        role=tuple(stations.role[k] for k in order),
        R_gs=stations.R_gs[order],
    )


def diagnosed(number: int, *causes: tuple[str, float, int], in_order: bool) -> tuple[Suspect, ...]:
    rng = np.random.default_rng([31, number])
    bench = random_bench(rng)
    for cause, size, index in causes:
        bench = planted(bench, cause, size, index)
    stations = standard_stations(rng)
    obs = observe(bench, along_x(stations) if in_order else stations, rng)
    return diagnose(obs, fit_registration(obs), bench.lens, bench.leds_m, NAMES)


def named(suspect: Suspect) -> set[str]:
    return {suspect.cause, *suspect.alternative_causes}


def test_axis_terms_of_an_ordered_run_are_not_called_a_drift() -> None:
    found = [diagnosed(number, *AXIS_TERMS, in_order=True) for number in range(BENCHES)]
    assert all(found)
    # Never time alone; a single-cause search named it alone in 5 of these 12.
    assert all(named(suspects[0]) & OF_AXES for suspects in found)
    assert sum(suspects[0].cause in OF_AXES for suspects in found) >= BENCHES // 2


def test_a_drift_of_an_ordered_run_is_named_if_only_as_one_of_two() -> None:
    found = [diagnosed(number, ("drift", 1e-6, 0), in_order=True) for number in range(BENCHES)]
    assert all(found)
    # One of these benches shows a scale clearly better than the drift that made it: noise decides near a tie.
    assert sum(bool(named(suspects[0]) & OF_TIME) for suspects in found) >= BENCHES - 1


def test_a_drift_among_shuffled_places_is_named_alone() -> None:
    for number in range(3):
        suspect = diagnosed(number, ("drift", 1e-6, 0), in_order=False)[0]
        assert suspect.cause == "drift"
        assert not named(suspect) & OF_AXES


def test_clean_ordered_runs_raise_no_alarm() -> None:
    # Twelve benches at 5 %: two alarms or fewer with 98 %.
    assert sum(bool(diagnosed(number, in_order=True)) for number in range(BENCHES)) <= 2
