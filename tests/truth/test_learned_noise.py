"""Noise learned from a run is that of the bench, however wrong the sensor's own word of it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.accuracy import fit_registration
from uvgs_bench.accuracy.blind_bench import observe, random_bench, standard_stations
from uvgs_bench.accuracy.centroid_noise import learn_noise
from uvgs_bench.errors import RegistrationError


def test_both_parts_of_the_noise_are_learned() -> None:
    found = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        bench = replace(random_bench(rng), centroid_sigma_px=0.06, place_sigma_px=0.04, gantry_repeatability_m=1e-5)
        obs = observe(bench, standard_stations(rng, places=40, revisits=20, moving=6, shots=4), rng)
        # The sensor states half of its sigma.
        told = replace(obs, covariance=0.25 * obs.covariance)
        noise = learn_noise(told, fit_registration(told, gantry_sigma_m=1e-5), bench.lens, bench.leds_m)
        assert noise.is_parted
        assert noise.visit_count == 60
        found.append([noise.centroid_sigma_px, noise.place_sigma_px])
    # 180 captures about their visits know the first to 2 %, 40 places the second to 6 %; means of eight are better.
    np.testing.assert_allclose(np.mean(found, axis=0), [0.06, 0.04], rtol=0.1)


def test_too_few_visits_teach_nothing() -> None:
    rng = np.random.default_rng(1)
    bench = random_bench(rng)
    obs = observe(bench, standard_stations(rng, places=8, revisits=0, moving=6), rng)
    with pytest.raises(RegistrationError, match="12 stations with a pose or more, got 8"):
        learn_noise(obs, fit_registration(obs), bench.lens, bench.leds_m)
