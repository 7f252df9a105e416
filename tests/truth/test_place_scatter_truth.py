"""The scatter of places is parted into the sensor's and the carriage's as they were planted."""

from __future__ import annotations

import numpy as np

from uvgs_bench.accuracy import fit_registration
from uvgs_bench.accuracy.blind_bench import observe, random_bench, standard_stations
from uvgs_bench.accuracy.place_scatter import PlaceMeans, fit_covariance, fit_parts
from uvgs_bench.geometry import FloatArray


def places(rng: np.random.Generator, size: FloatArray, count: int = 200) -> tuple[PlaceMeans, FloatArray]:
    """Places whose errors are drawn from two parts, with a design of three columns whose coefficients are 0."""
    root = rng.normal(size=(count, 6, 6)) * np.array([1.0, 1.0, 1.0, 0.3, 0.3, 2.0])[:, None]
    shaped = root @ root.transpose(0, 2, 1)
    shifts = np.broadcast_to(np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]), shaped.shape)
    parts = np.stack([shaped, shifts])
    V = np.einsum("k,ksij->sij", size, parts)
    residual = (np.linalg.cholesky(V) @ rng.normal(size=(count, 6, 1)))[:, :, 0]
    # Weights as if both parts were as stated, which they are not.
    return PlaceMeans(residual, rng.normal(size=(count, 6, 3)), np.linalg.inv(parts.sum(axis=0)), parts), size


def test_both_parts_are_found() -> None:
    rng = np.random.default_rng(4)
    found = np.array([fit_parts(places(rng, np.array([0.25, 4.0]))[0])[1] for _ in range(20)])
    # 200 places: a part is known to a tenth each time, to a fortieth in the mean of 20.
    np.testing.assert_allclose(found.mean(axis=0), [0.25, 4.0], rtol=0.08)


def test_few_places_share_one_factor() -> None:
    common, parts = fit_parts(places(np.random.default_rng(2), np.array([3.0, 3.0]), count=8)[0])
    assert parts.tolist() == [common, common]


def test_covariance_is_that_of_the_estimate_with_these_weights() -> None:
    rng = np.random.default_rng(9)
    errors, stated = [], []
    for _ in range(400):
        means, size = places(rng, np.array([0.25, 4.0]), count=40)
        weighted = means.information @ means.design
        normal = np.einsum("sik,sil->kl", means.design, weighted)
        errors.append(np.linalg.solve(normal, np.einsum("sik,si->k", weighted, means.residual)))
        stated.append(np.diag(fit_covariance(means, size, 3)))
    # 400 draws know a variance to 7 %.
    np.testing.assert_allclose(np.var(errors, axis=0), np.mean(stated, axis=0), rtol=0.2)


def test_a_bench_shows_how_well_its_carriage_stops() -> None:
    rng = np.random.default_rng(12)
    bench = random_bench(rng)
    obs = observe(bench, standard_stations(rng, places=150, revisits=0, moving=0, shots=4), rng)
    # Stated far too large: what is found must not follow.
    found = fit_registration(obs, gantry_sigma_m=4.0 * bench.gantry_repeatability_m)
    # 150 places with three axes each: a standard deviation to 5 %, and the sensor's part beside it.
    np.testing.assert_allclose(found.stopping_sigma_m, bench.gantry_repeatability_m, rtol=0.2)
    # One capture's noise over four, and what all four share.
    expected = 0.25 + (bench.place_sigma_px / bench.centroid_sigma_px) ** 2
    np.testing.assert_allclose(found.sensor_factor, expected, rtol=0.2)
