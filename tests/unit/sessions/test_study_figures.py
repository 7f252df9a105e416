"""The tables of studies: intervals of shares, verdicts, and what counts as what."""

from __future__ import annotations

import pytest

from uvgs_bench.accuracy.clusters import Estimate
from uvgs_bench.sessions.study import Share, Target, coverage_table, diagnosis_table, planning_table, wilson_interval
from uvgs_bench.sessions.study_tasks import PLANNING_KINDS, planning_name, relative_half

BAND = Target(0.935, 0.965)


@pytest.mark.parametrize(
    ("hits", "count", "low", "high"),
    # R. Newcombe, Two-sided confidence intervals for the single proportion (1998), table 1, method 3; four decimals.
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_intervals_are_the_published_ones(hits: int, count: int, low: float, high: float) -> None:
    found = wilson_interval(hits, count)
    assert found == pytest.approx((low, high), abs=5e-5)
    mirrored = wilson_interval(count - hits, count)
    assert mirrored == pytest.approx((1.0 - high, 1.0 - low), abs=5e-5)


def test_nothing_says_nothing() -> None:
    assert wilson_interval(0, 0) == (0.0, 1.0)
    assert Share.of("x", 0, 0, BAND).verdict == "inconclusive"


@pytest.mark.parametrize(
    ("hits", "count", "target", "verdict"),
    [
        (950, 1000, BAND, "pass"),
        (940, 1000, BAND, "pass"),
        (931, 1000, BAND, "inconclusive"),
        (900, 1000, BAND, "fail"),
        (995, 1000, BAND, "fail"),
        (95, 100, BAND, "inconclusive"),
        (200, 200, Target(0.95, 1.0), "pass"),
        (191, 200, Target(0.95, 1.0), "inconclusive"),
        (170, 200, Target(0.95, 1.0), "fail"),
        (2, 200, Target(0.0, 0.05), "pass"),
        (10, 200, Target(0.0, 0.05), "inconclusive"),
        (30, 200, Target(0.0, 0.05), "fail"),
        (30, 200, None, ""),
    ],
)
def test_verdicts(hits: int, count: int, target: Target | None, verdict: str) -> None:
    assert Share.of("x", hits, count, target).verdict == verdict


def test_targets_are_said_as_people_say_them() -> None:
    assert [target.text for target in (BAND, Target(0.95, 1.0), Target(0.0, 0.05))] == [
        "93.5 to 96.5 %",
        "at least 95 %",
        "at most 5 %",
    ]


def test_coverage_counts_benches_without_a_figure_apart() -> None:
    rows = [
        {"inside": {"a": True, "b": False}, "open": ["b"], "failed": {}},
        {"inside": {"a": False}, "open": [], "failed": {"terms": "none"}},
    ]
    a, b, failed = coverage_table(rows)
    assert (a.name, a.hits, a.count, a.note) == ("a", 1, 2, "")
    assert (b.hits, b.count, b.note) == (0, 1, "1 open above, 1 benches without it")
    assert (failed.name, failed.hits, failed.count, failed.verdict) == ("not stated: terms", 1, 2, "")


def test_a_bench_that_cannot_be_registered_names_nothing() -> None:
    rows = [
        {"kind": "clean", "named": ["drift"], "right": False, "alike": []},
        {"kind": "clean", "named": [], "right": False, "alike": []},
        {"kind": "latency", "named": ["latency", "drift"], "right": True, "alike": []},
        {"kind": "latency", "named": ["drift", "latency"], "right": False, "alike": []},
        {"kind": "latency", "failed": "no registration"},
    ]
    shares = {share.name: share for share in diagnosis_table(rows)}
    assert (shares["false alarm on a clean bench"].hits, shares["false alarm on a clean bench"].count) == (1, 2)
    latency = shares["latency named first"]
    assert (latency.hits, latency.count) == (1, 3)
    assert latency.note == "named at all 2, alone 0, right part first 1"


def test_along_an_axis_saying_why_not_counts() -> None:
    kind = "squareness_seen_along_an_axis"
    rows = [
        {"kind": kind, "named": ["squareness"], "right": True, "alike": [], "beyond": False},
        {"kind": kind, "named": ["principal_point"], "right": False, "alike": ["squareness"], "beyond": True},
        {"kind": kind, "named": [], "right": False, "alike": [], "beyond": True},
        {"kind": kind, "named": [], "right": False, "alike": [], "beyond": False},
        {"kind": kind, "named": ["drift"], "right": False, "alike": [], "beyond": True},
    ]
    share = next(share for share in diagnosis_table(rows) if "along" in share.name)
    assert (share.hits, share.count) == (3, 5)
    assert share.note == "named first 1, with what looks alike 1, said to be beyond this run 1"


def test_planning_counts_open_intervals_as_too_wide() -> None:
    name = planning_name(*PLANNING_KINDS[0])
    rows = [
        {"kind": name, "half": 0.1, "share": 0.2},
        {"kind": name, "half": None, "share": 0.2},
        {"kind": name, "failed": "no registration"},
    ]
    first = planning_table(rows)[0]
    assert (first.hits, first.count, first.note) == (1, 3, "10%, worst tenth 10%; registration 20%; 2 without a bound")


def test_half_of_an_open_interval_is_infinite() -> None:
    assert relative_half(Estimate(2.0, 1.0, 4.0, 9, 9)) == 0.75
    assert relative_half(Estimate(2.0, 1.0, float("inf"), 9, 9)) == float("inf")
