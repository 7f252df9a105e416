"""The figures of ISO 230-2 and ISO 9283 by hand, and fits that give back what was planted."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.accuracy.axis_tests import fit_dead_band, fit_drift, judge_positioning, played, scatter_of
from uvgs_bench.errors import RegistrationError


def test_positioning_by_hand() -> None:
    targets = np.array([0.0, 0.1, 0.2])
    # Deviations, um: from below 0+-1, 4+-2, 8+-1; from above 3+-1, 6+-1, 12+-3 with two runs each, s = range / sqrt 2.
    up = targets[:, None] + 1e-6 * np.array([[-1.0, 1.0], [2.0, 6.0], [7.0, 9.0]])
    down = targets[:, None] + 1e-6 * np.array([[2.0, 4.0], [5.0, 7.0], [9.0, 15.0]])
    p = judge_positioning(targets, up + 0.5, down + 0.5)
    root2 = np.sqrt(2.0)
    assert p.repeatability_up_m == pytest.approx(4e-6 * 2.0 * root2)
    assert p.repeatability_down_m == pytest.approx(4e-6 * 3.0 * root2)
    # Third target: 2 s up + 2 s down + |B| = 2 sqrt2 + 6 sqrt2 + 4 um, less than 4 s down = 12 sqrt2 um.
    assert p.repeatability_m == pytest.approx(12e-6 * root2)
    assert p.reversal_m == pytest.approx(-4e-6)
    assert p.mean_reversal_m == pytest.approx(-3e-6)
    assert p.systematic_m == pytest.approx(12e-6)
    assert p.mean_systematic_m == pytest.approx(8.5e-6)
    # High: 12 + 6 sqrt2 um; low: 0 - 2 sqrt2 um.
    assert p.accuracy_m == pytest.approx(1e-6 * (12.0 + 8.0 * root2))
    # Both distances from a barycentre of two are equal, so their spread is 0.
    assert p.pose_repeatability_m == pytest.approx(2e-6)
    assert p.slope == pytest.approx(42.5e-6)


def test_positioning_needs_enough() -> None:
    with pytest.raises(RegistrationError, match="2 targets and 2 approaches"):
        judge_positioning(np.zeros(1), np.zeros((1, 2)), np.zeros((1, 2)))
    with pytest.raises(RegistrationError, match="2 approaches"):
        judge_positioning(np.arange(3.0), np.zeros((3, 1)), np.zeros((3, 1)))


def to_and_fro(half_m: float = 4e-4, steps: int = 8, cycles: int = 2) -> np.ndarray:
    one = [*range(steps + 1), *range(steps - 1, -steps - 1, -1), *range(-steps + 1, 0)]
    return np.array(one * cycles) * half_m / steps


def test_play_stands_still_until_it_is_taken_up() -> None:
    got = played(np.array([0.0, 1.0, 0.5, 0.2, -1.0, -0.5, 0.0]), 1.0)
    np.testing.assert_allclose(got, [-0.5, 0.5, 0.5, 0.5, -0.5, -0.5, -0.5])


@pytest.mark.parametrize("width_m", [0.0, 2e-5, 1e-4, 3e-4])
def test_the_dead_band_is_found_whatever_origin_and_scale(width_m: float) -> None:
    commands = to_and_fro()
    band = fit_dead_band(commands, 0.7 + 0.997 * played(commands, width_m))
    # m; without noise to what a step of the numerical slope leaves.
    assert band.width_m == pytest.approx(width_m, abs=1e-8)
    assert band.scatter_m < 1e-8


def test_dead_band_to_ten_percent_and_its_interval_covers() -> None:
    """0.1 mm under 12 um of scatter: what axis and camera together do on the simulated bench."""
    commands = to_and_fro()
    errors, covered = [], []
    for seed in range(60):
        noise = np.random.default_rng(seed).normal(0.0, 12e-6, len(commands))
        band = fit_dead_band(commands, played(commands, 1e-4) + noise)
        errors.append(band.width_m - 1e-4)
        covered.append(band.low_m <= 1e-4 <= band.high_m)
    assert np.max(np.abs(errors)) < 1e-5
    # Of 60 intervals of 95 %, fewer than 52 cover with a chance below 0.5 %.
    assert sum(covered) >= 52


def test_steps_that_say_nothing_are_refused() -> None:
    with pytest.raises(RegistrationError, match="8 readings and a reversal"):
        fit_dead_band(np.arange(20.0), np.arange(20.0))


def test_drift_and_scatter() -> None:
    t_s = np.linspace(0.0, 3600.0, 20)
    drift = fit_drift(t_s, 0.3 + 1e-9 * t_s)
    assert drift.rate_mps == pytest.approx(1e-9)
    assert drift.range_m == pytest.approx(3.6e-6)
    with pytest.raises(RegistrationError, match="three visits"):
        fit_drift(t_s[:2], t_s[:2])
    scatter = scatter_of(np.array([1.0, 2.0, 3.0]))
    # chi2(2): 7.378 and 0.0506 at the 97.5 and 2.5 % points.
    assert (scatter.sigma_m, scatter.low_m, scatter.high_m) == pytest.approx(
        (1.0, np.sqrt(2 / 7.378), np.sqrt(2 / 0.0506)), rel=1e-3
    )
    with pytest.raises(RegistrationError, match="two readings"):
        scatter_of(np.ones(1))
