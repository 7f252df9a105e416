"""What errors that all captures share leave in the judged errors, once the registration has taken up its part.

A wrong lens, a wrong LED or a crooked axis moves every pose. The registration is fitted through the same error and
follows it; only what it cannot follow shows. Everything is linear in the small error, so it is a matrix per capture.
"""

from __future__ import annotations

import numpy as np

from uvgs_bench.accuracy.bench_model import gantry_covariance
from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.pose_sensitivity import pose_pixel_jacobian
from uvgs_bench.accuracy.registration import Registration
from uvgs_bench.accuracy.tangent import hats
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray

_RELATIVE_FLOOR = 1e-11


def sensor_sensitivities(
    lens: Lens, leds_m: FloatArray, R: FloatArray, t_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """How a solved pose moves when the lens or the LEDs are not what the sensor was told.

    Args:
        lens: The lens.
        leds_m: LED positions in the beacon frame, shape (L, 3), m.
        R: Rotations camera_from_beacon, shape (N, 3, 3).
        t_m: Translations, shape (N, 3), m.

    Returns:
        Derivatives of the left tangent by the lens parameters (N, 6, P), and by the LED positions (N, 6, 3L).

    Source: implicit function theorem on the normal equations of the pose.
    """
    N, L = len(R), len(leds_m)
    J, _ = pose_pixel_jacobian(lens, leds_m, R, t_m)
    points = (np.einsum("nij,lj->nli", R, leds_m) + t_m[:, None]).reshape(-1, 3)
    _, by_point, by_lens = lens.project_with_jacobians(points)
    flat = J.reshape(N, 2 * L, 6)
    answer = -np.linalg.pinv(flat)
    by_led = np.zeros((N, 2 * L, 3 * L))
    turned = by_point.reshape(N, L, 2, 3) @ R[:, None]
    for k in range(L):
        by_led[:, 2 * k : 2 * k + 2, 3 * k : 3 * k + 3] = turned[:, k]
    return answer @ by_lens.reshape(N, 2 * L, -1), answer @ by_led


def left_over(
    judged: Observations,
    fitted_on: Observations,
    registration: Registration,
    on_judged: FloatArray,
    on_fitted: FloatArray,
) -> FloatArray:
    """What a common error leaves in the errors of the captures that judge.

    Args:
        judged: Captures that judge.
        fitted_on: Captures the registration was fitted on, all with a pose.
        registration: The registration.
        on_judged: Effect of the error on the left tangent of the judged captures' poses, shape (N, 6, P).
        on_fitted: The same on the captures fitted on, shape (M, 6, P).

    Returns:
        Effect on the judged errors, left tangent, shape (N, 6, P).
    """
    A = registration.prediction_jacobian(fitted_on)
    _, of_place, count = np.unique(fitted_on.place, return_inverse=True, return_counts=True)
    doubt = fitted_on.covariance + gantry_covariance(registration.gantry_sigma_m)
    weighted = np.linalg.solve(doubt, A) / count[of_place][:, None, None]
    H = np.einsum("nki,nkj->ij", weighted, A)
    size = np.sqrt(np.maximum(np.diag(H), 1e-300))
    values, vectors = np.linalg.eigh(H / np.outer(size, size))
    good = values > _RELATIVE_FLOOR * float(values[-1])
    inverse = (vectors[:, good] / values[good]) @ vectors[:, good].T / np.outer(size, size)
    followed = inverse @ np.einsum("nki,nkp->ip", weighted, on_fitted)
    out: FloatArray = on_judged - registration.prediction_jacobian(judged) @ followed
    return out


def as_errors(tangent: FloatArray, t_m: FloatArray) -> FloatArray:
    """Left tangents as (rotation error, translation error) in camera axes.

    Args:
        tangent: Columns of left tangents, shape (N, 6, K).
        t_m: Translations of the predicted poses, shape (N, 3), m.

    Returns:
        The same effects, shape (N, 6, K): ``dt = v + omega x t``.
    """
    out = tangent.copy()
    out[:, 3:] -= hats(t_m) @ tangent[:, :3]
    return out
