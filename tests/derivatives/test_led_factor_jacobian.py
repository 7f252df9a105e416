"""Derivatives of the LED factor, on the right as GTSAM takes them, against central differences."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import Pose
from uvgs_bench.navigation.led_factor import led_residual, pixel_covariance
from uvgs_bench.navigation.states import SensedPose

LEDS_M = np.array([[0.005, 0.077, -0.002], [-0.05, -0.068, -0.016], [0.054, -0.009, -0.013], [0.033, -0.048, -0.062]])
LENSES = {
    "plumb_bob": Lens("plumb_bob", 1280, 960, np.array([1002.4, 1001.7, 643.2, 476.9, -0.08, 0.045, 4e-4, -3e-4, 0.0])),
    "fov": Lens("fov", 1280, 960, np.array([608.8, 607.6, 632.5, 549.1, 0.998693])),
}
CAMERA_FROM_BODY = Pose.exp((1.2, -1.2, 1.2, 0.05, -0.04, 0.1), "camera", "body")
CAMERA_FROM_BEACON = Pose.exp((0.1, -0.2, 0.3, 0.05, -0.1, 0.9), "camera", "beacon")
WORLD_FROM_BEACON = Pose.exp((0.4, 0.2, -0.1, 1.0, 2.0, 3.0), "world", "beacon")
WORLD_FROM_BODY = WORLD_FROM_BEACON @ CAMERA_FROM_BEACON.inverse() @ CAMERA_FROM_BODY
STEP = 1e-6  # rad and m: at some 1000 px per rad central differences are good to about 1e-6 px


@pytest.mark.parametrize("name", LENSES)
def test_derivatives(name):
    lens = LENSES[name]
    px = lens.project(CAMERA_FROM_BEACON.apply(LEDS_M)) + 0.3
    e, by_body, by_beacon = led_residual(lens, CAMERA_FROM_BODY, WORLD_FROM_BODY, WORLD_FROM_BEACON, LEDS_M, px)
    np.testing.assert_allclose(e, -0.3, atol=1e-9)
    for k in range(6):
        columns = []
        for which in range(2):
            ends = []
            for sign in (1.0, -1.0):
                xi = np.zeros(6)
                xi[k] = sign * STEP
                poses = [WORLD_FROM_BODY, WORLD_FROM_BEACON]
                frame = poses[which].source
                poses[which] = poses[which] @ Pose.exp(xi, frame, frame)
                ends.append(led_residual(lens, CAMERA_FROM_BODY, *poses, LEDS_M, px)[0])
            columns.append((ends[0] - ends[1]) / (2.0 * STEP))
        np.testing.assert_allclose(by_body[:, k], columns[0], atol=2e-5)
        np.testing.assert_allclose(by_beacon[:, k], columns[1], atol=2e-5)


def test_an_led_the_lens_cannot_see_pulls_at_nothing():
    lens = LENSES["plumb_bob"]
    behind = WORLD_FROM_BEACON @ Pose(np.eye(3), np.array([0.0, 0.0, 9.0]), "beacon", "beacon")
    turned = behind @ Pose.exp((0.0, 0.0, 0.0, 0.0, 0.0, -20.0), "beacon", "beacon")
    e, by_body, _ = led_residual(lens, CAMERA_FROM_BODY, WORLD_FROM_BODY, turned, LEDS_M, np.zeros((4, 2)))
    assert np.isfinite(e).all()
    assert not by_body.any()


def test_centroid_noise_is_found_back_from_the_covariance_it_made():
    lens = LENSES["plumb_bob"]
    _, by_point, _ = lens.project_with_jacobians(CAMERA_FROM_BEACON.apply(LEDS_M))
    J = []
    for point, D in zip(CAMERA_FROM_BEACON.apply(LEDS_M), by_point, strict=True):
        x, y, z = point
        J.append(D @ np.hstack((-np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]), np.eye(3))))
    J = np.concatenate(J)
    noise = 0.05**2 * np.linalg.inv(J.T @ J)
    alone = pixel_covariance(lens, LEDS_M, SensedPose(0, CAMERA_FROM_BEACON, noise))
    np.testing.assert_allclose(alone, 0.05**2 * np.eye(8), rtol=1e-6, atol=1e-12)
    # What is the same in every capture comes on top, and gives the pose its whole covariance back.
    total = noise + np.diag(np.repeat((1e-8, 1e-6), 3))
    W = np.linalg.inv(pixel_covariance(lens, LEDS_M, SensedPose(0, CAMERA_FROM_BEACON, total, noise_covariance=noise)))
    np.testing.assert_allclose(np.linalg.inv(J.T @ W @ J), total, rtol=1e-6, atol=1e-12)
