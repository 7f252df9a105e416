"""The budget on benches whose sum is known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.planted_bench import Noise, planted_observations
from uvgs_bench.accuracy import error_table, fit_registration, judge
from uvgs_bench.accuracy.blind_bench import observe, random_bench, standard_stations
from uvgs_bench.accuracy.uncertainty import Budget, BudgetInputs, uncertainty_budget


def budget_of(noise: Noise, inputs: BudgetInputs = BudgetInputs(), gantry_sigma_m: float = 0.0) -> Budget:  # noqa: B008
    obs = planted_observations("3T", 60, 4, np.random.default_rng(8), noise, register_every=2)
    registers = obs.has_role("register")
    registration = fit_registration(obs.select(registers), gantry_sigma_m=gantry_sigma_m)
    judged = obs.select(~registers)
    table = error_table(judged, registration)
    found = uncertainty_budget(judged, table, registration, obs.select(registers), inputs, np.random.default_rng(0))
    assert found is not None
    return found


def test_noise_alone_gives_its_own_size_and_the_known_factor() -> None:
    found = budget_of(Noise(capture_m=(1e-3, 1e-3, 1e-3), capture_rad=(1e-3, 1e-3, 1e-3)))
    noise = next(line for line in found.lines if line.name == "sensor noise")
    # Root of 3 mm^2; 90 degrees of freedom of repeats per component know it to 4 %.
    assert noise.position_m == pytest.approx(3.0**0.5 * 1e-3, rel=0.12)
    assert (noise.kind, noise.degrees_of_freedom) == ("A", 6.0 * 90)
    assert found.dominant == "sensor noise"
    # Length of three alike components: root of chi-squared 7.815 over 3, a little more for the finite scatter.
    assert found.coverage_factor == pytest.approx((7.815 / 3.0) ** 0.5, rel=0.03)
    assert found.is_confirmed
    assert found.observed_position_m == pytest.approx(found.combined_position_m, rel=0.15)


def test_the_sum_of_squares_and_what_is_not_stated() -> None:
    found = budget_of(Noise(), gantry_sigma_m=2e-4)
    known = [line for line in found.lines if line.is_known]
    assert found.combined_position_m**2 == pytest.approx(sum(line.position_m**2 for line in known))
    assert found.reference_position_m < found.combined_position_m
    gantry = next(line for line in known if line.name == "gantry positioning")
    assert gantry.position_m == pytest.approx(3.0**0.5 * 2e-4)
    assert {line.name for line in found.lines if not line.is_known} == {
        "camera calibration",
        "LED positions",
        "axis scale and squareness",
        "temperature of the gantry",
    }
    assert sum("nothing is stated" in text for text in found.advice) == 4


def test_what_no_line_explains_is_said_first() -> None:
    found = budget_of(Noise(place_m=(2e-3, 2e-3, 2e-3)))
    assert "larger than all lines explain" in found.advice[0]


def test_common_errors_count_with_what_the_registration_leaves() -> None:
    """A shift of the principal point is nearly a turn of the camera: hardly anything is left of it."""
    rng = np.random.default_rng(12)
    bench = random_bench(rng)
    obs = observe(bench, standard_stations(rng, moving=0), rng)
    sigma = np.zeros((2, 9))
    sigma[0, 2:4], sigma[1, :2] = 2.0, 2.0  # px
    position = []
    for each in sigma:
        known = BudgetInputs(bench.lens, np.diag(each**2), bench.leds_m, 1e-10 * np.eye(12))
        budget = judge(obs, [], np.random.default_rng(0), known=known).budget
        assert budget is not None
        position.append(next(line.position_m for line in budget.lines if line.name == "camera calibration"))
    shifted_px_m = 2.0 / 1002.0 * 0.95
    # Before registration the shift moves a beacon at 0.95 m by 2.7 mm in both directions together.
    assert position[0] < 0.2 * 2.0**0.5 * shifted_px_m
    # 2 px of focal length are 0.2 % of depth: about 0.16 mm over +-0.14 m of travel.
    assert 3e-5 < position[1] < 5e-4
