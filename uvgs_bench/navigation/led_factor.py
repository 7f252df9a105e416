"""LEDs of the sensor as measurements of their own: pixels through the exact lens, with derivatives for a graph."""

from __future__ import annotations

import numpy as np

from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import hat
from uvgs_bench.navigation.states import SensedPose


def led_residual(
    lens: Lens,
    camera_from_body: Pose,
    world_from_body: Pose,
    world_from_beacon: Pose,
    leds_m: FloatArray,
    px: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """LEDs as they should be seen minus as they were, with derivatives on the right.

    Args:
        lens: The camera's lens.
        camera_from_body: How the camera sits on the body.
        world_from_body: The body.
        world_from_beacon: The beacon.
        leds_m: LED positions in the beacon frame, shape (n, 3), m.
        px: Observed centres, shape (n, 2), raw px.

    Returns:
        Residuals, shape (2n,), px; derivatives by ``T <- T exp(xi)`` of the body and of the beacon, shape (2n, 6).
        Where the lens has no picture of an LED its residual is large and its derivative zero.
    """
    body_from_beacon = world_from_body.inverse() @ world_from_beacon
    in_body = body_from_beacon.apply(leds_m)
    in_camera = camera_from_body.apply(in_body)
    seen, by_point, _ = lens.project_with_jacobians(in_camera)
    lost = ~np.isfinite(seen).all(axis=1)
    e, D = seen - px, by_point.copy()
    e[lost], D[lost] = float(lens.width_px), 0.0
    R_c = camera_from_body.R
    R_cb = R_c @ body_from_beacon.R
    body, beacon = np.empty((len(px), 2, 6)), np.empty((len(px), 2, 6))
    for k in range(len(px)):
        body[k] = D[k] @ R_c @ np.hstack((hat(in_body[k]), -np.eye(3)))
        beacon[k] = D[k] @ R_cb @ np.hstack((-hat(leds_m[k]), np.eye(3)))
    return e.reshape(-1), body.reshape(-1, 6), beacon.reshape(-1, 6)


def pixel_covariance(lens: Lens, leds_m: FloatArray, sensed: SensedPose) -> FloatArray:
    """Covariance of the LEDs' places in the picture that gives a pose the covariance it states.

    Noise drawn anew in every capture is the same on every axis of every LED; what lens and beacon add moves the LEDs
    together, as the pose does.

    Args:
        lens: The camera's lens.
        leds_m: Positions of the LEDs it saw, beacon frame, shape (n, 3), m.
        sensed: The pose.

    Returns:
        Covariance of u, v of each LED in turn, shape (2n, 2n), px^2.
    """
    points = sensed.camera_from_beacon.apply(leds_m)
    _, by_point, _ = lens.project_with_jacobians(points)
    J = np.concatenate([D @ np.hstack((-hat(p), np.eye(3))) for D, p in zip(by_point, points, strict=True)])
    noise = sensed.covariance if sensed.noise_covariance is None else sensed.noise_covariance
    variance_px2 = float(np.trace(noise @ J.T @ J)) / 6.0
    together: FloatArray = J @ (sensed.covariance - noise) @ J.T
    return variance_px2 * np.eye(len(J)) + 0.5 * (together + together.T)
