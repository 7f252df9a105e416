"""An independent picture of spots: Gaussian light integrated over pixels by the error function, shot and read noise.

It shares nothing with the simulated camera, so that the sensor is not proved against the code it was tuned on.
"""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from uvgs_bench.beacon import Beacon, Led
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_exp

WIDTH, HEIGHT = 1280, 960


def lens() -> Lens:
    """A 1280 x 960 camera with mild distortion."""
    return Lens("plumb_bob", WIDTH, HEIGHT, np.array([1000.0, 1002.0, 641.3, 478.2, -0.08, 0.03, 4e-4, -3e-4, 0.0]))


def calibration() -> Calibration:
    """The lens above as a calibration."""
    return Calibration(lens(), "spots")


def beacon(covariance_m2: np.ndarray | None = None) -> Beacon:
    """A tetrahedron of clearly different edges, LEDs facing the camera at identity rotation, points without size."""
    positions = np.array(
        [[-0.062, 0.035, 0.005], [0.071, 0.022, -0.008], [-0.012, -0.058, 0.012], [0.018, 0.004, -0.07]]
    )
    leds = tuple(Led(f"led{i}", p, np.array([0.0, 0.0, -1.0]), np.radians(70.0)) for i, p in enumerate(positions))
    return Beacon("test", leds, covariance_m2=covariance_m2)


def random_pose(rng: np.random.Generator, cone_deg: float = 40.0, near_m: float = 0.5, far_m: float = 1.5) -> Pose:
    """A pose in view: direction within a cone about facing, any roll, centre well inside the picture."""
    tilt = np.arccos(rng.uniform(np.cos(np.radians(cone_deg)), 1.0))
    azimuth = rng.uniform(0.0, 2.0 * np.pi)
    R = so3_exp(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])) @ so3_exp(
        tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    )
    z = rng.uniform(near_m, far_m)
    return Pose(R, np.array([rng.uniform(-0.25, 0.25) * z, rng.uniform(-0.18, 0.18) * z, z]), "camera", "beacon")


def draw(
    centres_px: np.ndarray,
    rng: np.random.Generator | None,
    peak_dn: float | np.ndarray = 170.0,
    sigma_px: float | np.ndarray = 1.3,
    background_dn: float = 12.0,
    read_noise_dn: float = 1.0,
    gain_e_per_dn: float = 40.0,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    dtype: type = np.uint8,
    full_scale: int = 255,
) -> np.ndarray:
    """A mono picture of Gaussian spots; without a generator it has no noise but quantisation."""
    width, height = size
    image = np.full((height, width), background_dn)
    peaks = np.broadcast_to(peak_dn, (len(centres_px),))
    sigmas = np.broadcast_to(sigma_px, (len(centres_px),))
    for (u, v), peak, s in zip(centres_px, peaks, sigmas, strict=True):
        reach = int(7 * s) + 2
        xs = np.arange(max(0, int(u) - reach), min(width, int(u) + reach + 1))
        ys = np.arange(max(0, int(v) - reach), min(height, int(v) + reach + 1))
        if len(xs) == 0 or len(ys) == 0:
            continue
        gx = 0.5 * (erf((xs + 0.5 - u) / (s * np.sqrt(2))) - erf((xs - 0.5 - u) / (s * np.sqrt(2))))
        gy = 0.5 * (erf((ys + 0.5 - v) / (s * np.sqrt(2))) - erf((ys - 0.5 - v) / (s * np.sqrt(2))))
        image[np.ix_(ys, xs)] += peak * 2.0 * np.pi * s * s * np.outer(gy, gx)
    if rng is not None:
        variance = read_noise_dn**2 + np.maximum(image, 0.0) / gain_e_per_dn
        image = image + rng.standard_normal(image.shape, dtype=np.float32) * np.sqrt(variance)
    return np.clip(np.rint(image), 0, full_scale).astype(dtype)
