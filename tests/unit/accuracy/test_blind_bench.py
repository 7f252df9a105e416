"""Blind benches tell the truth when nothing is planted, and act as said when something is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.accuracy import Limit, judge
from uvgs_bench.accuracy.blind_bench import PLANTABLE, BlindBench, observe, planted, random_bench, standard_stations
from uvgs_bench.accuracy.variance_components import Scatter, fit_scatter, visits_of
from uvgs_bench.beacon import Beacon
from uvgs_bench.beacon.geometry import Led


def quiet(seed: int = 1) -> BlindBench:
    bench = random_bench(np.random.default_rng(seed))
    return replace(bench, centroid_sigma_px=1e-9, place_sigma_px=0.0, gantry_repeatability_m=0.0)


def test_without_noise_the_sensor_answers_the_true_pose() -> None:
    bench = quiet()
    rng = np.random.default_rng(2)
    obs = observe(bench, standard_stations(rng, is_turning=True), rng)
    assert obs.is_solved.all()
    R = bench.left.R @ obs.R_gs
    t = bench.left.t_m + obs.t_gs_m @ bench.left.R.T + R @ bench.right.t_m
    # A pixel noise of 1e-9 at 1 m and 1000 px focal length, times 1000 for the worst direction: 1e-9.
    np.testing.assert_allclose(obs.t_cb_m, t, atol=1e-8)
    np.testing.assert_allclose(obs.R_cb, R @ bench.right.R, atol=1e-7)


def test_same_seed_same_observations() -> None:
    bench = random_bench(np.random.default_rng(3))
    stations = standard_stations(np.random.default_rng(4))
    one, two = (observe(bench, stations, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(one.t_cb_m, two.t_cb_m)


def test_stated_covariance_is_that_of_the_noise() -> None:
    bench = replace(random_bench(np.random.default_rng(6)), place_sigma_px=0.0, gantry_repeatability_m=0.0)
    stations = standard_stations(np.random.default_rng(7), places=4, revisits=0, moving=0, shots=400)
    obs = observe(bench, stations, np.random.default_rng(8))
    first = obs.station == 0
    spread = np.cov(obs.t_cb_m[first].T)
    t = obs.t_cb_m[first].mean(axis=0)
    hat = np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])
    K = np.concatenate([-hat, np.eye(3)], axis=1)
    stated = np.mean(K @ obs.covariance[first] @ K.T, axis=0)
    # A variance of 400 samples is known to 7 %: four standard deviations.
    np.testing.assert_allclose(np.diag(spread) / np.diag(stated), 1.0, atol=0.28)


@pytest.mark.parametrize("cause", PLANTABLE)
def test_every_cause_can_be_planted_and_shows(cause: str) -> None:
    sizes = {"wrong_labels": 0.5, "latency": 0.02, "principal_point": 2.0, "saturation": 0.5, "distortion": 0.02}
    clean, rng = quiet(), np.random.default_rng(9)
    stations = standard_stations(rng)
    before = observe(clean, stations, np.random.default_rng(10))
    after = observe(planted(clean, cause, sizes.get(cause, 1e-4), 1), stations, np.random.default_rng(10))
    both = before.is_solved & after.is_solved
    shifted_m = np.abs(after.t_cb_m[both] - before.t_cb_m[both]).max(initial=0.0)
    assert shifted_m > 1e-5 or not after.is_solved.all()


def test_an_unknown_cause_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown cause 'rust'"):
        planted(quiet(), "rust", 1.0)


def test_standard_stations_expose_every_cause() -> None:
    stations = standard_stations(np.random.default_rng(11))
    moving = np.abs(stations.velocity_mps).max(axis=1) > 0.0
    assert (stations.shots[moving] == 1).all()
    for axis in range(3):
        assert {-1, 1} <= set(np.sign(stations.velocity_mps[moving, axis]).astype(int).tolist())
        assert set(stations.approach[~moving, axis].tolist()) == {-1, 1}
    places, visits = np.unique(stations.place[~moving], return_counts=True)
    assert (visits == 2).sum() == 12
    assert {"register", "judge"} == set(stations.role)
    for place in places[visits == 2]:
        first, second = np.flatnonzero(stations.place == place)
        np.testing.assert_array_equal(stations.approach[first], -stations.approach[second])


def test_parts_of_the_scatter_are_found_again() -> None:
    rng = np.random.default_rng(12)
    places, visits, shots = 60, 2, 4
    station = np.repeat(np.arange(places * visits), shots)
    place = station // visits
    base = np.diag([4e-3, 4e-3, 1e-3, 1e-4, 1e-4, 4e-4]) ** 2
    L = np.linalg.cholesky(base)
    true = Scatter(noise=1.5, place=0.5, stopping_m2=(2e-4) ** 2)
    stop = np.concatenate([np.zeros((places * visits, 3)), rng.normal(scale=2e-4, size=(places * visits, 3))], axis=1)
    residual = (
        np.sqrt(true.noise) * rng.normal(size=(len(station), 6)) @ L.T
        + np.sqrt(true.place) * (rng.normal(size=(places, 6)) @ L.T)[place]
        + stop[station]
    )
    found, _ = visits_of(residual, np.broadcast_to(base, (len(station), 6, 6)), station, place)
    scatter = fit_scatter(found, np.broadcast_to(np.eye(6), (places * visits, 6, 6)), 1e-4)
    # 2160 degrees of freedom for the noise (3 %), 354 for the places (8 %, half of it the noise's), some 250 for the
    # stops (9 %): four standard deviations.
    assert scatter.noise == pytest.approx(true.noise, rel=0.12)
    assert scatter.place == pytest.approx(true.place, rel=0.6)
    assert scatter.stopping_m2 == pytest.approx(true.stopping_m2, rel=0.36)


def test_judging_diagnoses_only_what_the_sensor_was_told() -> None:
    rng = np.random.default_rng(13)
    bench = planted(random_bench(rng), "latency", 0.02)
    obs = observe(bench, standard_stations(rng), rng)
    leds = tuple(Led(str(k), position) for k, position in enumerate(bench.leds_m))
    limits = (Limit.of("position_rms_mm", 1.0),)
    told = judge(obs, limits, np.random.default_rng(1), lens=bench.lens, beacon=Beacon("plain", leds))
    assert [suspect.cause for suspect in told.diagnosis][:1] == ["latency"]
    assert judge(obs, limits, np.random.default_rng(1)).diagnosis == ()
