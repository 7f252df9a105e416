"""The pixels name the misplaced LED, also where every fit was refused, and blame none of a clean beacon."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.accuracy.blind_bench import observe, planted, random_bench, standard_stations
from uvgs_bench.accuracy.diagnosis import diagnose
from uvgs_bench.accuracy.led_evidence import blamed_leds
from uvgs_bench.units import m_from_mm

NAMES = ("bottom", "left", "right", "apex")


@pytest.mark.parametrize("led", range(4))
def test_the_misplaced_led_is_named(led: int) -> None:
    rng = np.random.default_rng(30 + led)
    bench = random_bench(rng)
    obs = observe(planted(bench, "led_offset", m_from_mm(1.0), 3 * led), standard_stations(rng), rng)
    # Another LED may fit nearly as well where noise is high; it must not come first.
    assert blamed_leds(obs, bench.lens, bench.leds_m)[0] == led


def test_it_is_named_where_every_fit_was_refused() -> None:
    rng = np.random.default_rng(7)
    bench = replace(random_bench(rng), centroid_sigma_px=0.03)
    obs = observe(planted(bench, "led_offset", m_from_mm(2.0), 6), standard_stations(rng), rng)
    assert not obs.is_solved.any()
    found = diagnose(obs, None, bench.lens, bench.leds_m, NAMES)
    assert [suspect.cause for suspect in found] == ["led_offset"]
    assert "LED right " in found[0].title


def test_a_clean_beacon_leaves_all_in_question() -> None:
    rng = np.random.default_rng(3)
    bench = random_bench(rng)
    obs = observe(bench, standard_stations(rng), rng)
    assert blamed_leds(obs, bench.lens, bench.leds_m) == (0, 1, 2, 3)


def test_unknown_pixels_leave_all_in_question() -> None:
    rng = np.random.default_rng(3)
    bench = random_bench(rng)
    obs = replace(observe(bench, standard_stations(rng), rng), led_px=np.empty((0, 0, 2)))
    assert blamed_leds(obs, bench.lens, bench.leds_m) == (0, 1, 2, 3)
