"""``uvgs compare`` on runs whose difference is known: changes are found, and nothing is found where nothing changed."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.planted_bench import Noise, planted_observations
from uvgs_bench.accuracy.comparison import Change, compare_tables, judged
from uvgs_bench.accuracy.pose_error import ErrorTable, error_table
from uvgs_bench.accuracy.registration import fit_registration

CAPTURE_M = np.array([0.0002, 0.0002, 0.001])
CAPTURE_RAD = np.array([0.004, 0.004, 0.001])
PLACE_M = np.array([0.0001, 0.0001, 0.0006])
PLACE_RAD = np.array([0.001, 0.001, 0.0005])


def table(rng: np.random.Generator, places: int, factor: float) -> ErrorTable:
    """Errors of a run whose sensor is ``factor`` times as noisy as planned."""
    noise = Noise(
        capture_m=tuple(factor * CAPTURE_M),
        capture_rad=tuple(factor * CAPTURE_RAD),
        place_m=tuple(factor * PLACE_M),
        place_rad=tuple(factor * PLACE_RAD),
    )
    obs = planted_observations("3T", places, 4, rng, noise, register_every=3)
    registration = fit_registration(obs.select(obs.has_role("register")))
    return error_table(obs.select(~obs.has_role("register")), registration)


def compared(seed: int, places: int, factor: float) -> tuple[Change, ...]:
    rng = np.random.default_rng([places, seed])
    first, second = table(rng, places, 1.0), table(rng, places, factor)
    return judged([compare_tables(first, second, rng, is_paired=bool(seed % 2))])[0]


def study(trials: int, places: int) -> None:
    covered: dict[str, int] = {}
    false_words = 0
    for seed in range(trials):
        changes = compared(seed, places, 1.0)
        false_words += any(change.word in ("worse", "better") for change in changes)
        for change in changes:
            true = 0.0 if change.unit == "percent" else 1.0
            covered[change.key] = covered.get(change.key, 0) + (change.low <= true <= change.high)
    print({key: count / trials for key, count in covered.items()}, "false words", false_words / trials)
    # At most 5 % of comparisons may say anything of unchanged runs, and each interval holds in 95 %; 4 sigma of
    # counting are allowed on top.
    assert false_words <= 0.05 * trials + 4.0 * np.sqrt(0.05 * 0.95 * trials)
    for key, count in covered.items():
        assert count >= 0.95 * trials - 4.0 * np.sqrt(0.05 * 0.95 * trials), key


def test_unchanged_runs_are_not_called_changed() -> None:
    study(20, 30)


@pytest.mark.slow
@pytest.mark.parametrize("places", [15, 36, 75])
def test_unchanged_runs_are_not_called_changed_at_length(places: int) -> None:
    study(400, places)


def test_a_doubled_error_is_found_and_measured() -> None:
    for seed in range(4):
        found = {change.key: change for change in compared(seed, 45, 2.0)}
        for key in ("position_rms", "depth_rms", "attitude_rms", "attitude_repeatability"):
            assert found[key].word == "worse", (seed, key)
            # A single 95 % interval fails once in twenty times: 1.5 to 2.7 is three times as wide.
            assert 1.5 < found[key].change < 2.7
        assert found["availability"].word == "no difference shown"


def test_a_halved_error_is_better_and_a_tolerated_one_not_worse() -> None:
    rng = np.random.default_rng(7)
    first, second = table(rng, 60, 1.0), table(rng, 60, 1.6)
    changes = compare_tables(first, second, rng, is_paired=False)
    named = {change.key: change.word for change in judged([changes])[0]}
    assert named["position_rms"] == "worse"
    tolerated = {change.key: change.word for change in judged([changes], allowed=1.0)[0]}
    assert tolerated["position_rms"] == "no difference shown"
    back = {change.key: change for change in judged([compare_tables(second, first, rng, is_paired=False)])[0]}
    assert back["position_rms"].word == "better"
    forth = next(change for change in changes if change.key == "position_rms")
    assert back["position_rms"].change == pytest.approx(1.0 / forth.change)
    assert back["position_rms"].p_value == pytest.approx(forth.p_value)


def test_few_places_are_inconclusive_not_unchanged() -> None:
    rng = np.random.default_rng(3)
    changes = judged([compare_tables(table(rng, 9, 1.0), table(rng, 9, 1.0), rng, is_paired=True)])[0]
    assert {change.word for change in changes} == {"inconclusive"}
    assert all("places" in change.note for change in changes)


def test_what_shifts_a_whole_run_is_no_evidence_of_places() -> None:
    """Two runs that differ only in the error of their registrations are not called different."""
    words = []
    for seed in range(6):
        rng = np.random.default_rng([1, seed])
        few = [planted_observations("3T", 40, 1, rng, Noise(), register_every=10) for _ in range(2)]
        tables = []
        for obs in few:
            registration = fit_registration(obs.select(obs.has_role("register")))
            tables.append(error_table(obs.select(~obs.has_role("register")), registration))
        words += [change.word for change in judged([compare_tables(*tables, rng, is_paired=False)])[0]]
    assert "worse" not in words
    assert "better" not in words
