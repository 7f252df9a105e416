"""What the scatter of a run's poses says of its centroids: noise of a capture, and what captures of a place share.

Source: variance components by restricted maximum likelihood, as in ``variance_components``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.accuracy.bench_model import pose_residuals
from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.pose_sensitivity import pose_pixel_jacobian
from uvgs_bench.accuracy.registration import Registration
from uvgs_bench.accuracy.variance_components import fit_scatter, means, visits_of
from uvgs_bench.camera.lens import Lens
from uvgs_bench.errors import RegistrationError
from uvgs_bench.geometry import FloatArray

LEAST_VISITS = 12
"""With fewer visits too little is left of the scatter once the registration is fitted."""


@dataclass(frozen=True, slots=True)
class LearnedNoise:
    """Noise of a sensor on its bench.

    Args:
        centroid_sigma_px: Standard deviation of each centroid coordinate, new in every capture, px.
        place_sigma_px: The same for what all captures of a place share, px: all that is wrong with lens and beacon
            and differs from place to place counts as such.
        stopping_sigma_m: Standard deviation per axis of where a visit stops, m.
        visit_count: Visits it rests on.
        is_parted: Whether visits with several captures told the first two apart.
    """

    centroid_sigma_px: float
    place_sigma_px: float
    stopping_sigma_m: float
    visit_count: int
    is_parted: bool


def noise_at_predictions(
    obs: Observations, registration: Registration, lens: Lens, leds_m: FloatArray
) -> tuple[FloatArray, float]:
    """Covariance from centroid noise at the predicted poses, and the level of that noise.

    The stated covariance is taken where the pose was found, so it goes with the error and would lean a fit to one side;
    its level is kept, its shape is taken where the beacon should be.

    Args:
        obs: Captures, all with a pose.
        registration: Their registration.
        lens: The lens the sensor was told.
        leds_m: LED positions it was told, beacon frame, shape (L, 3), m.

    Returns:
        Covariances of the left tangents, shape (N, 6, 6), rad and m, and the standard deviation of a centroid
        coordinate by the sensor's own word, px.
    """
    J, _ = pose_pixel_jacobian(lens, leds_m, *registration.predict(obs))
    information = np.einsum("nkui,nkuj->nij", J, J)
    level_px2 = float(np.median(np.einsum("nij,nji->n", obs.noise_covariance, information) / 6.0))
    return np.asarray(level_px2 * np.linalg.inv(information)), level_px2**0.5


def learn_noise(obs: Observations, registration: Registration, lens: Lens, leds_m: FloatArray) -> LearnedNoise:
    """Learn the noise of a sensor from a run at rest.

    Args:
        obs: Captures of the run, misses included; those in motion are left out.
        registration: Their registration.
        lens: The lens the sensor was told.
        leds_m: LED positions it was told, beacon frame, shape (L, 3), m.

    Returns:
        The noise.

    Raises:
        RegistrationError: Fewer than ``LEAST_VISITS`` visits with a pose.
    """
    data = obs.select(obs.is_solved & ~np.any(obs.velocity_gs_mps, axis=1))
    count = len(np.unique(data.station))
    if count < LEAST_VISITS:
        raise RegistrationError(f"noise is learned from {LEAST_VISITS} stations with a pose or more, got {count}")
    covariance, level_px = noise_at_predictions(data, registration, lens, leds_m)
    residual = pose_residuals(data, *registration.predict(data))
    visits, of_visit = visits_of(residual, covariance, data.station, data.place)
    scatter = fit_scatter(visits, means(registration.prediction_jacobian(data), of_visit), registration.gantry_sigma_m)
    return LearnedNoise(
        centroid_sigma_px=level_px * scatter.noise**0.5,
        place_sigma_px=level_px * scatter.place**0.5,
        stopping_sigma_m=scatter.stopping_m2**0.5,
        visit_count=count,
        is_parted=visits.within_freedom >= count,
    )
