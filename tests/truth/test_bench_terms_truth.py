"""Planted axis errors and delays are found as far as they can be told from the sensor, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.accuracy import error_table, fit_registration
from uvgs_bench.accuracy.blind_bench import observe, planted, random_bench, standard_stations
from uvgs_bench.accuracy.registration import Registration
from uvgs_bench.geometry import FloatArray

ALL = ("axis_scale", "squareness", "time_offset", "time_rate")
# 1 and rad: scales of 2000, -1000, 500 ppm, leans of 1, -0.5, 0.3 mrad.
TRUTH = np.array([2e-3, -1e-3, 5e-4, 1e-3, -5e-4, 3e-4])


def registered(seed: int, terms: FloatArray, delay_s: float, *, is_oblique: bool = True) -> Registration:
    rng = np.random.default_rng([31, seed])
    bench = random_bench(rng, is_oblique=is_oblique)
    bench = replace(bench, axis_scale=tuple(terms[:3]), shear_rad=tuple(terms[3:]), delay_s=delay_s)
    return fit_registration(observe(bench, standard_stations(rng), rng), terms=ALL)


@pytest.mark.parametrize("is_oblique", [True, False])
def test_planted_terms_are_found_where_the_sensor_cannot_hide_them(is_oblique: bool) -> None:
    registration = registered(1, TRUTH, 0.02, is_oblique=is_oblique)
    axes = registration.axis_terms
    assert axes is not None
    assert registration.time_offset_s is not None
    held = axes.null_directions
    error = TRUTH - held.T @ (held @ TRUTH) - np.concatenate([axes.scale, axes.shear_rad])
    # Four standard deviations, and 2e-5 for directions that are hardly free.
    assert np.all(np.abs(error) < 4.0 * axes.sigmas + 2e-5)
    assert registration.time_offset_s.low - 1e-3 < 0.02 < registration.time_offset_s.high + 1e-3
    assert registration.time_rate is None
    assert any("cannot be told from the sensor's own scale" in note for note in registration.term_notes)


def test_a_clean_bench_keeps_its_nominal_axes() -> None:
    registration = registered(2, np.zeros(6), 0.0)
    assert registration.axis_terms is None
    assert registration.time_offset_s is None
    assert all("left at nominal" in note for note in registration.term_notes)
    assert not np.any(registration.terms)


def test_a_wrong_focal_length_stays_in_the_errors() -> None:
    """An axis term must never hide an error of the sensor's scale: 0.5 % of depth is left as it was."""
    rng = np.random.default_rng([31, 3])
    bench = planted(random_bench(rng, is_oblique=False), "focal_length", 5e-3)
    obs = observe(bench, standard_stations(rng, moving=0), rng)
    plain, asked = fit_registration(obs), fit_registration(obs, terms=("axis_scale", "squareness"))
    shown, hidden = (float(np.sqrt((error_table(obs, r).depth_error_m ** 2).mean())) for r in (plain, asked))
    # Terms may take up a tenth by chance, no more.
    assert hidden > 0.9 * shown


def test_terms_that_nothing_can_show_are_said_not_to_be() -> None:
    rng = np.random.default_rng([31, 4])
    obs = observe(random_bench(rng), standard_stations(rng, moving=0, is_turning=False), rng)
    registration = fit_registration(obs, terms=("time_offset",))
    assert registration.term_notes == ("time offset: not fitted, no capture was taken in motion",)


def test_a_zero_elsewhere_changes_no_prediction() -> None:
    rng = np.random.default_rng([31, 5])
    bench = replace(random_bench(rng), axis_scale=(2e-3, 0.0, 0.0), shear_rad=(0.0, 1e-3, 0.0))
    obs = observe(bench, standard_stations(rng, moving=0), rng)
    moved = replace(obs, t_gs_m=obs.t_gs_m + np.array([0.3, -0.2, 0.1]))
    here, there = (fit_registration(o, terms=("axis_scale", "squareness")) for o in (obs, moved))
    # 1e-8 m: where the least squares stops.
    np.testing.assert_allclose(here.predict(obs)[1], there.predict(moved)[1], atol=1e-8)
    F, G = here.prediction_factor(obs), there.prediction_factor(moved)
    # Standard deviations to 1 %: the doubt of a prediction is none of the zero's.
    np.testing.assert_allclose(np.linalg.norm(F, axis=2), np.linalg.norm(G, axis=2), rtol=1e-2, atol=1e-7)
