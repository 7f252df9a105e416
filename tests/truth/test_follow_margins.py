"""The margin against latency: next to the textbook, to a simulation of its own, and to law, filter and body."""

from __future__ import annotations

from math import atan, sqrt

import numpy as np
import pytest

from uvgs_bench.devices.sim.free_flyer import FlyerConfig
from uvgs_bench.navigation.follower import FollowerConfig
from uvgs_bench.navigation.margins import Loop, find_margins, largest_latency, spectral_radius, transition
from uvgs_bench.navigation.pose_filter import PoseFilterConfig
from uvgs_bench.sessions.follow_margin import simulated_largest_latency


def textbook(w: float, zeta: float) -> tuple[float, float]:
    """Crossover (rad/s) and delay margin (s) of (w^2 + 2 zeta w s) / s^2: |L| = 1 is x^2 - (2 zeta w)^2 x - w^4 = 0."""
    kd2 = (2.0 * zeta * w) ** 2
    crossover = sqrt(0.5 * (kd2 + sqrt(kd2**2 + 4.0 * w**4)))
    return crossover, atan(2.0 * zeta * crossover / w) / crossover


@pytest.mark.parametrize(("w", "zeta"), [(1.0, 1.0), (2.0, 0.7), (0.5, 1.5)])
def test_quick_sampling_comes_to_the_textbook(w: float, zeta: float):
    crossover, delay_s = textbook(w, zeta)
    coarse, fine = Loop(w, zeta, 0.04 / w, 2), Loop(w, zeta, 0.02 / w, 2)
    # Hold and velocity are late in proportion to the period; what is left is its square, 0.04 % of 1/w.
    assert 2.0 * largest_latency(fine) - largest_latency(coarse) == pytest.approx(delay_s, rel=2e-3)
    found = [find_margins(loop, 0.0) for loop in (coarse, fine)]
    assert 2.0 * found[1].crossover_radps - found[0].crossover_radps == pytest.approx(crossover, rel=2e-3)
    phase_rad = 2.0 * found[1].phase_margin_rad - found[0].phase_margin_rad
    assert phase_rad == pytest.approx(delay_s * crossover, rel=2e-3)


@pytest.mark.parametrize(
    ("period_s", "window", "latency_s"), [(0.05, 5, 0.13), (0.1, 3, 0.0), (0.1, 5, 0.1), (0.05, 2, 0.241)]
)
def test_the_matrix_moves_as_a_fine_simulation(period_s: float, window: int, latency_s: float):
    """Captures, line, gains and a held, late command in steps of a hundredth: nothing is shared but the law."""
    loop = Loop(1.5, 0.9, period_s, window)
    fine, place, velocity, push = 100, 1.0, 0.0, 0.0
    dt = period_s / fine
    kept: list[float] = [place] * window
    due: list[tuple[float, float]] = []
    track = []
    for i in range(300 * fine):
        now = i * dt
        if i % fine == 0:
            track.append(place)
            kept = [*kept[1:], place]
            slope, value = np.polyfit(period_s * np.arange(-window + 1, 1), kept, 1)
            due.append((now + latency_s, -(1.5**2) * value - 2.0 * 0.9 * 1.5 * slope))
        while due and due[0][0] <= now + 1e-12:
            push = due.pop(0)[1]
        place, velocity = place + dt * velocity + 0.5 * dt * dt * push, velocity + dt * push
    A = transition(loop, latency_s)
    state = np.zeros(len(A))
    state[0] = 1.0
    state[2 : window + 1] = 1.0
    told = []
    for _ in track:
        told.append(state[0])
        state = A @ state
    # Rounding of 100 steps a capture; every number is at most of the order of 1.
    np.testing.assert_allclose(told, track, atol=1e-9)


def test_just_below_the_latency_it_is_stable_and_just_above_not():
    loop = Loop(1.5, 1.0, 0.05, 5)
    borne_s = largest_latency(loop)
    assert spectral_radius(loop, borne_s - 1e-5) < 1.0 < spectral_radius(loop, borne_s + 1e-5)
    found = find_margins(loop, borne_s)
    # At the border phase and gain margin vanish together.
    assert found.phase_margin_rad == pytest.approx(0.0, abs=2e-3)
    assert found.gain_margin == pytest.approx(1.0, abs=5e-3)
    assert find_margins(loop, 0.1).delay_margin_s == pytest.approx(borne_s - 0.1)


def test_a_loop_that_is_unstable_by_itself_bears_nothing():
    loop = Loop(2.0, 1.0, 0.1, 7)
    assert largest_latency(loop) == 0.0
    assert not find_margins(loop, 0.0).is_stable


@pytest.mark.parametrize("change", [{"frequency_radps": 0.0}, {"period_s": -1.0}, {"window": 1}])
def test_loops_that_cannot_be_meant_are_refused(change: dict[str, float]):
    values: dict[str, float] = {"frequency_radps": 1.0, "damping": 1.0, "period_s": 0.1, "window": 5}
    with pytest.raises(ValueError, match="must be"):
        Loop(**{**values, **change})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="latency"):
        spectral_radius(Loop(1.0, 1.0, 0.1, 3), -0.1)


def test_law_filter_and_body_bear_what_the_loop_says():
    law, filtering, period_s = FollowerConfig(), PoseFilterConfig(), 0.1
    computed_s = largest_latency(Loop(law.frequency_radps, law.damping, period_s, filtering.window))
    tried_s = simulated_largest_latency(law, filtering, FlyerConfig(), period_s, 1.5 * computed_s)
    # Bisected to a 64th of 1.5 times that; limits and pulses of the thrusters take some more.
    assert tried_s == pytest.approx(computed_s, rel=0.1)
