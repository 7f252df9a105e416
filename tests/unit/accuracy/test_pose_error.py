"""Errors are in camera axes, signed as documented, and misses stay visible."""

from __future__ import annotations

import numpy as np

from tests.helpers.planted_bench import NOISELESS, Noise, planted_observations, planted_poses
from uvgs_bench.accuracy import Observations, error_table, fit_registration
from uvgs_bench.accuracy.pose_error import concatenated
from uvgs_bench.geometry.se3 import so3_exp


def changed(obs: Observations, **fields: object) -> Observations:
    return Observations(**({name: getattr(obs, name) for name in obs.__dataclass_fields__} | fields))


def test_planted_error_comes_back_in_camera_axes() -> None:
    obs = planted_observations("3T", 12, 1, np.random.default_rng(1), NOISELESS)
    registration = fit_registration(obs, gantry_sigma_m=0.0)
    shift, turn = np.array([1e-3, -2e-3, 5e-3]), np.array([0.01, 0.02, -0.03])
    moved = changed(obs, t_cb_m=obs.t_cb_m + shift, R_cb=so3_exp(turn) @ obs.R_cb)
    table = error_table(moved, registration)
    # 1e-12 m and rad: rounding at 1.5 m.
    np.testing.assert_allclose(table.translation_error_m, np.tile(shift, (12, 1)), atol=1e-12)
    np.testing.assert_allclose(table.rotation_error_rad, np.tile(turn, (12, 1)), atol=1e-12)
    np.testing.assert_allclose(table.position_error_m, np.linalg.norm(shift), atol=1e-12)
    np.testing.assert_allclose(table.lateral_error_m, np.hypot(1e-3, 2e-3), atol=1e-12)
    np.testing.assert_allclose(table.depth_error_m, 5e-3, atol=1e-12)
    np.testing.assert_allclose(table.attitude_error_rad, np.linalg.norm(turn), atol=1e-12)


def test_misses_have_predictions_but_no_errors() -> None:
    obs = planted_observations("3T", 12, 2, np.random.default_rng(1))
    solved = np.ones(24, dtype=np.bool_)
    solved[[3, 17]] = False
    R, t_m, P = obs.R_cb.copy(), obs.t_cb_m.copy(), obs.covariance.copy()
    R[~solved], t_m[~solved], P[~solved] = np.nan, np.nan, np.nan
    reason = tuple("" if s else "blobs/too_few_blobs" for s in solved)
    holed = changed(obs, R_cb=R, t_cb_m=t_m, covariance=P, is_solved=solved, reason=reason)
    table = error_table(holed, fit_registration(holed))
    assert table.count == 24
    assert np.isnan(table.position_error_m[~solved]).all()
    assert np.isfinite(table.position_error_m[solved]).all()
    assert np.isfinite(table.range_m).all()
    assert np.isfinite(table.view_angle_rad).all()
    assert table.reason[3] == "blobs/too_few_blobs"


def test_nees_is_six_on_average_when_the_covariance_is_right() -> None:
    obs = planted_observations("3T", 120, 2, np.random.default_rng(2), register_every=3)
    registers = obs.has_role("register")
    registration = fit_registration(obs.select(registers), gantry_sigma_m=0.0)
    nees = error_table(obs.select(~registers), registration).nees
    # 160 captures of 6 degrees of freedom: the mean is known to 0.27.
    assert abs(nees.mean() - 6.0) < 0.9


def test_registration_factor_is_the_covariance_of_errors_from_the_registration() -> None:
    """Refit with fresh noise: predictions scatter as the factor says."""
    rng = np.random.default_rng(3)
    where = planted_observations("3T", 4, 1, np.random.default_rng(99), NOISELESS)
    predicted, claimed = [], []
    for _ in range(60):
        registration = fit_registration(planted_observations("3T", 10, 1, rng), gantry_sigma_m=0.0)
        table = error_table(where, registration)
        predicted.append(table.predicted_t_m)
        claimed.append(table.registration_sigma_m**2)
    seen = np.var(np.array(predicted), axis=0).sum(axis=1)
    # A variance from 60 fits, dominated by depth, is known to 18 % (one sigma); four points are correlated.
    np.testing.assert_allclose(seen, np.mean(claimed, axis=0), rtol=0.6)


def test_angles_of_view() -> None:
    obs = planted_observations("3T", 6, 1, np.random.default_rng(4), NOISELESS)
    table = error_table(obs, fit_registration(obs, gantry_sigma_m=0.0))
    left, right = planted_poses()
    t_m = (left.apply(obs.t_gs_m + right.t_m))[0]
    assert np.isclose(table.range_m[0], np.linalg.norm(t_m), rtol=1e-12)
    assert np.isclose(np.cos(table.field_angle_rad[0]), t_m[2] / np.linalg.norm(t_m), rtol=1e-12)
    z = (left.R @ right.R)[:, 2]
    assert np.isclose(np.cos(table.view_angle_rad[0]), z @ t_m / np.linalg.norm(t_m), rtol=1e-9)


def test_concatenated_puts_captures_back_where_they_were() -> None:
    obs = planted_observations("3T", 10, 2, np.random.default_rng(5), Noise())
    table = error_table(obs, fit_registration(obs))
    odd = np.arange(20) % 2 == 1
    rows = [np.flatnonzero(odd), np.flatnonzero(~odd)]
    again = concatenated([table.select(odd), table.select(~odd)], rows)
    for name in table.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, name), getattr(table, name))
