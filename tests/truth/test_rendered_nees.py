"""Rendered captures of shining discs: poses scatter as they say, and the parts of their doubt are what they claim."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from tests.helpers import spots
from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.devices.sim.camera import SimulatedCamera
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import se3_log, so3_exp
from uvgs_bench.sensor import Capture, PoseEstimate, Uvgs, UvgsConfig
from uvgs_bench.sensor.doubt_kernels import disc_shift
from uvgs_bench.sensor.fit import FitTables, estimate_of, fit_named
from uvgs_bench.store.bench import read_passing_beacon

POSE = Pose(so3_exp(np.array([0.5, -0.3, 0.2])), np.array([0.05, -0.04, 0.7]), "camera", "beacon")


def twist(found: Pose, true: Pose) -> np.ndarray:
    R = np.ascontiguousarray(found.R @ true.R.T)
    return np.asarray(se3_log(R, found.t_m - R @ true.t_m))


def squares(root: Path, count: int, seed: int, track: bool = False) -> np.ndarray:
    scene = read_passing_beacon(root / "calib/bench.toml", seed)
    camera = SimulatedCamera(scene, "sim:", None, count=count, step_s=0.02 if track else 0.1)
    uvgs = Uvgs(Calibration(scene.true_lens, "simulated"), scene.true_beacon)
    out, prior = [], None
    for capture in camera:
        got = uvgs.solve(capture, prior)
        prior = got if track and isinstance(got, PoseEstimate) else None
        if isinstance(got, PoseEstimate):
            xi = twist(got.camera_from_beacon, scene.true_camera_from_beacon(capture.t_ns))
            out.append(float(xi @ np.linalg.solve(got.covariance, xi)))
    assert len(out) > 0.98 * count
    return np.array(out)


def check(values: np.ndarray) -> None:
    low, high = chi2.ppf([0.005, 0.995], 6 * len(values)) / (6 * len(values))
    assert low < values.mean() / 6.0 < high


def test_rendered_poses_are_as_uncertain_as_they_say(pytestconfig):
    check(squares(pytestconfig.rootpath, 500, 11))


def test_tracked_poses_are_as_uncertain_as_they_say(pytestconfig):
    check(squares(pytestconfig.rootpath, 200, 12, track=True))


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_rendered_poses_are_as_uncertain_as_they_say_over_many(pytestconfig):
    check(np.concatenate([squares(pytestconfig.rootpath, 2000, seed) for seed in range(20, 25)]))


def test_a_tilted_disc_shifts_by_the_centre_of_its_ellipse():
    lens, radius = replace(spots.lens(), parameters=np.array([1000.0, 1000.0, 640.0, 480.0, 0, 0, 0, 0, 0.0])), 0.01
    tilt, z = 0.6, 0.5
    R = so3_exp(np.array([0.0, tilt, 0.0]))
    shift = np.zeros((1, 2))
    disc_shift(
        lens.model_id, lens.kernel_parameters, np.zeros((1, 3)), np.array([[0.0, 0.0, -1.0]]), np.array([radius]),
        R, np.array([0.0, 0.0, z]), shift,
    )  # fmt: skip
    # Exact centre of the projected circle; the quadrature leaves out terms of (radius / z)^2 = 4e-4.
    ends = [1000.0 * s * radius * np.cos(tilt) / (z - s * radius * np.sin(tilt)) for s in (-1.0, 1.0)]
    assert shift[0, 0] == pytest.approx(0.5 * sum(ends), rel=2e-3)
    assert shift[0, 1] == pytest.approx(0.0, abs=1e-9)


def solved(beacon: Beacon, calibration: Calibration, px: np.ndarray) -> Pose:
    tables = FitTables.of(calibration, beacon, UvgsConfig())
    return fit_named(tables, np.arange(4), px, np.full(4, 0.01), POSE).camera_from_beacon


def test_the_parts_of_the_covariance_are_first_derivatives_times_their_causes():
    lens = spots.lens()
    rng = np.random.default_rng(2)
    A = rng.normal(size=(12, 12)) * 1e-4
    doubt_m2 = A @ A.T
    sigma = np.array([0.5, 0.5, 0.3, 0.3, 1e-3, 1e-3, 1e-4, 1e-4, 1e-3])
    mixed = np.eye(9) + 0.3 * (np.ones((9, 9)) - np.eye(9))
    C = sigma[:, None] * mixed * sigma
    beacon, calibration = spots.beacon(doubt_m2), Calibration(lens, "spots", covariance=C)
    px = lens.project(POSE.apply(beacon.positions_m))
    tables = FitTables.of(calibration, beacon, UvgsConfig())
    fit = fit_named(tables, np.arange(4), px, np.full(4, 0.01), POSE)
    got = estimate_of(fit, tables, 0, np.inf, None, 4, 0, {})
    assert got.beacon_covariance is not None
    assert got.calibration_covariance is not None
    np.testing.assert_allclose(got.noise_covariance + got.beacon_covariance, got.covariance, rtol=1e-12)
    np.testing.assert_allclose(got.total_covariance, got.covariance + got.calibration_covariance, rtol=1e-12)
    by_lens, by_led = np.zeros((6, 9)), np.zeros((6, 12))
    for k in range(9):
        step = 0.01 * sigma[k]
        ends = [
            solved(beacon, Calibration(lens.with_parameters(lens.parameters + s * step * np.eye(9)[k])), px)
            for s in (1.0, -1.0)
        ]
        by_lens[:, k] = twist(*ends) / (2.0 * step)
    for k in range(12):
        ends = []
        for s in (1.0, -1.0):
            places = beacon.positions_m + s * 1e-6 * np.eye(12)[k].reshape(4, 3)
            leds = tuple(replace(led, position_m=p) for led, p in zip(beacon.leds, places, strict=True))
            ends.append(solved(replace(beacon, leds=leds), Calibration(lens), px))
        by_led[:, k] = twist(*ends) / 2e-6
    for part, numeric in (
        (got.calibration_covariance, by_lens @ C @ by_lens.T),
        (got.beacon_covariance, by_led @ doubt_m2 @ by_led.T),
    ):
        scale = np.sqrt(np.outer(np.diag(numeric), np.diag(numeric)))
        # Central differences of a solver that stops at 1e-11 rad, over steps that move the pose by 1e-5 rad.
        assert (np.abs(part - numeric) < 1e-3 * scale).all()


def test_parts_that_nobody_stated_are_absent():
    px = spots.lens().project(POSE.apply(spots.beacon().positions_m))
    got = Uvgs(spots.calibration(), spots.beacon()).solve(Capture(spots.draw(px, np.random.default_rng(3)), 0))
    assert isinstance(got, PoseEstimate)
    assert got.beacon_covariance is None
    assert got.calibration_covariance is None
    assert got.noise_covariance is got.covariance
