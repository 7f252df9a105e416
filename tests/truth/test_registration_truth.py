"""Registration recovers planted poses within its own stated doubt, and says what it cannot see."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from tests.helpers.planted_bench import NOISELESS, Noise, planted_observations, planted_poses
from uvgs_bench.accuracy import Registration, error_table, fit_registration
from uvgs_bench.accuracy.observations import Mount
from uvgs_bench.geometry import FloatArray, Pose

MOUNTS: tuple[Mount, ...] = ("beacon_on_carriage", "camera_on_carriage")
RANKS = {"3T": 9, "2T": 9, "line": 8, "3T1R": 11, "2T1R": 11, "1R": 10, "3T2R": 12}


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize(("kind", "rank"), RANKS.items())
def test_exact_data_give_exact_predictions_and_the_known_rank(kind: str, rank: int, mount: Mount) -> None:
    obs = planted_observations(kind, 12, 2, np.random.default_rng(3), NOISELESS, mount=mount)
    registration = fit_registration(obs, gantry_sigma_m=0.0)
    assert registration.rank == rank
    assert registration.null_directions.shape == (12 - rank, 12)
    R, t_m = registration.predict(obs)
    # Rounding only: 1e-12 m and 1e-12 rad at 1.5 m.
    np.testing.assert_allclose(t_m, obs.t_cb_m, atol=1e-12)
    np.testing.assert_allclose(R, obs.R_cb, atol=1e-12)


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("kind", ["3T", "3T1R", "1R", "line"])
def test_null_directions_do_not_change_predictions(kind: str, mount: Mount) -> None:
    obs = planted_observations(kind, 10, 1, np.random.default_rng(8), mount=mount)
    registration = fit_registration(obs)
    effect = registration.prediction_jacobian(obs) @ registration.null_directions.T
    # Directions have unit length; the blind ones move no prediction by more than the eigen solver's rounding.
    np.testing.assert_allclose(effect, 0.0, atol=1e-6)


def test_gauge_holds_the_mounted_part_at_its_nominal_pose() -> None:
    obs = planted_observations("3T", 12, 2, np.random.default_rng(5))
    nominal = Pose(np.eye(3), np.array([0.03, -0.02, 0.10]), "carriage", "beacon")
    free, drawn = fit_registration(obs), fit_registration(obs, nominal=nominal)
    # 1e-9 m: where the slide along the unseen directions stops.
    np.testing.assert_allclose(free.right.t_m, 0.0, atol=1e-9)
    np.testing.assert_allclose(drawn.right.t_m, nominal.t_m, atol=1e-9)
    np.testing.assert_allclose(free.sigmas("right")[1], 0.0, atol=1e-9)
    assert (free.sigmas("left")[1] > 1e-5).all()
    np.testing.assert_allclose(free.predict(obs)[1], drawn.predict(obs)[1], atol=1e-9)
    # The doubt of a prediction does not depend on the gauge.
    J_free, J_drawn = free.prediction_jacobian(obs), drawn.prediction_jacobian(obs)
    doubt_free = J_free @ free.covariance @ J_free.transpose(0, 2, 1)
    doubt_drawn = J_drawn @ drawn.covariance @ J_drawn.transpose(0, 2, 1)
    np.testing.assert_allclose(doubt_free, doubt_drawn, rtol=1e-5, atol=1e-14)


def truth_in_gauge(registration: Registration) -> tuple[Pose, Pose]:
    """The planted poses, slid along unseen offsets to where the registration's gauge holds the beacon."""
    left, right = planted_poses()
    twists = registration.null_directions[:, 6:]
    basis = np.linalg.qr(twists[:, 3:].T)[0] if len(twists) else np.zeros((3, 0))
    slide = basis @ (basis.T @ right.t_m)
    shift = Pose(np.eye(3), slide, "gantry", "gantry")
    return left @ shift, Pose(right.R, right.t_m - slide, "carriage", "beacon")


def normalised_error(registration: Registration) -> float:
    """Squared deviation from the truth over the stated covariance, over the rank."""
    left, right = truth_in_gauge(registration)
    xi: FloatArray = np.concatenate(
        [(registration.left @ left.inverse()).log(), (registration.right @ right.inverse()).log()]
    )
    values, vectors = np.linalg.eigh(registration.covariance)
    along = vectors[:, -registration.rank :].T @ xi
    return float((along**2 / values[-registration.rank :]).sum()) / registration.rank


def covered(kind: str, trials: int, captures: int) -> float:
    """Fraction of benches whose truth lies in the 95 % region."""
    # Shared and own noise in one proportion, so that the variance factor alone can repair the stated covariance.
    noise = Noise(place_m=(1e-4, 1e-4, 5e-4), place_rad=(2e-3, 2e-3, 5e-4))
    inside = 0
    for k in range(trials):
        obs = planted_observations(kind, 10, captures, np.random.default_rng([11, k]), noise)
        registration = fit_registration(obs, gantry_sigma_m=0.0)
        bound = stats.f.ppf(0.95, registration.rank, registration.degrees_of_freedom)
        inside += normalised_error(registration) <= bound
    return inside / trials


@pytest.mark.parametrize("kind", ["3T", "3T1R", "3T2R"])
def test_truth_lies_in_the_stated_region(kind: str) -> None:
    # 95 % of 60 benches, less three standard deviations of the count (2.8 %).
    assert covered(kind, 60, 3) >= 0.865


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["3T", "3T1R", "3T2R"])
def test_truth_lies_in_the_stated_region_long(kind: str) -> None:
    # 95 % of 500 benches within three standard deviations of the count (1 %).
    assert covered(kind, 500, 3) == pytest.approx(0.95, abs=0.03)


def test_variance_factor_sees_that_captures_are_averaged() -> None:
    independent = fit_registration(planted_observations("3T", 60, 4, np.random.default_rng(1)), gantry_sigma_m=0.0)
    # 1/4 for four independent captures; 351 degrees of freedom know it to 0.02.
    assert independent.variance_factor == pytest.approx(0.25, abs=0.06)
    shared = Noise((1e-9,) * 3, (1e-9,) * 3, (2e-4, 2e-4, 1e-3), (4e-3, 4e-3, 1e-3))
    common = fit_registration(planted_observations("3T", 60, 4, np.random.default_rng(1), shared), gantry_sigma_m=0.0)
    # 1 when the captures of a place err together.
    assert common.variance_factor == pytest.approx(1.0, abs=0.24)


def test_a_place_with_many_captures_does_not_dominate() -> None:
    shared = Noise((1e-6,) * 3, (1e-6,) * 3, (2e-4, 2e-4, 1e-3), (4e-3, 4e-3, 1e-3))
    obs = planted_observations("3T", 10, 40, np.random.default_rng(6), shared)
    few = obs.select((obs.station > 0) & (np.arange(obs.count) % 40 < 2) | (obs.station == 0))
    balanced = obs.select(np.arange(obs.count) % 40 < 2)
    lopsided, even = fit_registration(few), fit_registration(balanced)
    # The 40 captures of place 0 say nothing that its 2 do not: predictions differ by the captures' own 1 um,
    # through robust weights that follow a slightly different usual distance, by less than 10 um.
    np.testing.assert_allclose(lopsided.predict(obs)[1], even.predict(obs)[1], atol=1e-5)


def test_outliers_are_counted_and_hardly_move_the_fit() -> None:
    clean = planted_observations("3T", 20, 3, np.random.default_rng(9))
    R, t_m = clean.R_cb.copy(), clean.t_cb_m.copy()
    wrong = [7, 25, 44]
    t_m[wrong] += np.array([0.15, -0.10, 0.30])
    R[wrong] = R[wrong] @ np.diag([-1.0, -1.0, 1.0])
    dirty = type(clean)(
        **{name: getattr(clean, name) for name in clean.__dataclass_fields__ if name not in ("R_cb", "t_cb_m")},
        R_cb=R,
        t_cb_m=t_m,
    )
    registration = fit_registration(dirty)
    assert registration.outlier_count == 3
    assert registration.downweighted_count >= 3
    moved_m = np.abs(registration.predict(clean)[1] - fit_registration(clean).predict(clean)[1]).max()
    # Three gross errors of 0.35 m and half a turn in 60 captures: bounded to the order of the noise (1 mm in depth).
    assert moved_m < 1.5e-3


def test_in_sample_errors_flatter_and_held_out_ones_do_not() -> None:
    """Positions of 5 mm per axis, aligned on 8 stations: 7.5 mm in sample, about 10 mm held out, 8.66 mm in truth."""
    noise = Noise(capture_m=(5e-3, 5e-3, 5e-3), capture_rad=(1e-3, 1e-3, 1e-3))
    inside, outside = [], []
    for k in range(60):
        obs = planted_observations("3T", 24, 1, np.random.default_rng([21, k]), noise, register_every=3)
        registers = obs.has_role("register")
        registration = fit_registration(obs.select(registers), gantry_sigma_m=0.0)
        inside.append((error_table(obs.select(registers), registration).position_error_m ** 2).mean())
        outside.append((error_table(obs.select(~registers), registration).position_error_m ** 2).mean())
    in_sample_mm, held_out_mm = 1e3 * np.sqrt(np.mean(inside)), 1e3 * np.sqrt(np.mean(outside))
    # Expected in-sample mean square: sigma^2 (3n - 6)/n = 7.5 mm squared; 60 benches know it to 2 %.
    assert in_sample_mm == pytest.approx(7.5, abs=0.4)
    assert held_out_mm == pytest.approx(10.0, abs=0.6)
