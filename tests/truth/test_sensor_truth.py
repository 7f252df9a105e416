"""Simulate what is known, recover it, and hold the sensor to its own stated doubt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from tests.helpers import spots
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import rotation_angle, se3_log, so3_exp
from uvgs_bench.sensor import Capture, Miss, PoseEstimate, Uvgs, UvgsConfig
from uvgs_bench.sensor.correspondence import LedMatch, LedTable, match_leds
from uvgs_bench.store.beacons import read_beacon


def twist_error(found: Pose, true: Pose) -> np.ndarray:
    R = np.ascontiguousarray(found.R @ true.R.T)
    return np.asarray(se3_log(R, found.t_m - R @ true.t_m))


def nees(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, int]:
    rng = np.random.default_rng(seed)
    lens, beacon = spots.lens(), spots.beacon()
    uvgs = Uvgs(spots.calibration(), beacon)
    squares, errors, misses = [], [], 0
    for _ in range(count):
        pose = spots.random_pose(rng)
        true = lens.project(pose.apply(beacon.positions_m))
        got = uvgs.solve(Capture(spots.draw(true, rng), 0))
        if isinstance(got, Miss):
            misses += 1
            continue
        xi = twist_error(got.camera_from_beacon, pose)
        squares.append(float(xi @ np.linalg.solve(got.covariance, xi)))
        errors.append(got.led_px - true)
    return np.array(squares), np.array(errors), misses


def check_nees(count: int, seed: int) -> None:
    squares, errors, misses = nees(count, seed)
    n = len(squares)
    low, high = chi2.ppf([0.005, 0.995], 6 * n) / (6 * n)
    assert low < squares.mean() / 6.0 < high
    assert float(np.sqrt((errors**2).mean())) < 0.03  # px
    assert misses <= 0.05 * count  # two LEDs in one line of sight, or outside the picture


def test_poses_are_as_uncertain_as_they_say():
    check_nees(320, 20261122)


@pytest.mark.slow
@pytest.mark.timeout(3600)  # ten thousand pictures with noise in every pixel take six minutes on a quiet machine
def test_poses_are_as_uncertain_as_they_say_over_many():
    check_nees(10_000, 5)


def test_a_beacon_known_only_roughly_widens_the_covariance_rightly():
    rng = np.random.default_rng(4)
    lens = spots.lens()
    spread_m = 2e-4
    stated = spots.beacon(np.eye(12) * spread_m**2)
    uvgs = Uvgs(spots.calibration(), stated, UvgsConfig(model_error_px=0.3))
    squares = []
    for _ in range(80):
        pose = spots.random_pose(rng, near_m=0.8, far_m=1.2)
        truly = stated.positions_m + rng.normal(size=(4, 3)) * spread_m
        got = uvgs.solve(Capture(spots.draw(lens.project(pose.apply(truly)), rng), 0))
        if isinstance(got, PoseEstimate):
            xi = twist_error(got.camera_from_beacon, pose)
            squares.append(float(xi @ np.linalg.solve(got.covariance, xi)))
    assert len(squares) > 70
    # Planted 0.2 mm is ten times the noise; leaving it out would give a mean of some hundreds. 99.9 % band of the mean,
    # widened by a tenth for what the first order leaves out.
    low, high = chi2.ppf([0.0005, 0.9995], 6 * len(squares)) / (6 * len(squares))
    assert 0.9 * low < np.mean(squares) / 6.0 < 1.1 * high


def label_study(count: int, seed: int, others: int, pytestconfig_root) -> tuple[float, float]:
    """Share of wrong poses published and of views refused: 60 deg cone, 0.5 to 3 m, f = 608 px, 0.2 px."""
    rng = np.random.default_rng(seed)
    beacon = read_beacon(pytestconfig_root / "calib/beacons/tetra_small.toml")
    lens = Lens("plumb_bob", 1280, 960, np.array([608.0, 608.0, 639.5, 479.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
    config = UvgsConfig(model_error_px=0.0)
    table = LedTable.of(beacon, config)
    wrong = refused = 0
    for _ in range(count):
        tilt, azimuth = np.arccos(rng.uniform(0.5, 1.0)), rng.uniform(0.0, 2.0 * np.pi)
        turn = so3_exp(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])) @ so3_exp(
            tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        )
        ray = lens.unproject(rng.uniform([150, 150], [1130, 810])[None])[0]
        axis = np.cross([0.0, 0.0, 1.0], ray)
        angle = np.arctan2(np.linalg.norm(axis), ray[2])
        pose = Pose(
            so3_exp(axis / np.linalg.norm(axis) * angle) @ turn, ray * rng.uniform(0.5, 3.0), "camera", "beacon"
        )
        px = lens.project(pose.apply(beacon.positions_m)) + rng.normal(size=(4, 2)) * 0.2
        px = np.vstack([px, rng.uniform([0, 0], [1279, 959], (others, 2))])
        got = match_leds(px, np.full(len(px), 0.2), lens, table, config)
        if not isinstance(got, LedMatch):
            refused += 1
        elif rotation_angle(got.start.R.T @ pose.R) > 0.2 and got.blob_of_led.tolist() != [0, 1, 2, 3]:
            wrong += 1
    return wrong / count, refused / count


def test_the_shipped_beacon_is_never_taken_for_another_pose(pytestconfig):
    wrong, refused = label_study(2500, 1, 0, pytestconfig.rootpath)
    assert wrong == 0.0
    # 0.2 % expected; 1 % is the promise.
    assert refused < 0.01


def test_other_lights_do_not_turn_into_a_pose(pytestconfig):
    wrong, _ = label_study(400, 2, 3, pytestconfig.rootpath)
    assert wrong == 0.0


@pytest.mark.slow
def test_the_shipped_beacon_over_many_views(pytestconfig):
    wrong, refused = label_study(100_000, 3, 0, pytestconfig.rootpath)
    assert wrong <= 1e-4
    assert refused <= 0.01


def test_an_led_that_shines_away_is_not_used_to_explain_a_blob():
    beacon = spots.beacon()
    narrow = replace(beacon, leds=tuple(replace(led, half_angle_rad=np.radians(20.0)) for led in beacon.leds))
    lens = spots.lens()
    pose = Pose(so3_exp(np.array([np.radians(40.0), 0.0, 0.0])), np.array([0.0, 0.0, 0.8]), "camera", "beacon")
    image = spots.draw(lens.project(pose.apply(beacon.positions_m)), np.random.default_rng(1))
    assert isinstance(Uvgs(spots.calibration(), beacon).solve(Capture(image, 0)), PoseEstimate)
    got = Uvgs(spots.calibration(), narrow).solve(Capture(image, 0))
    assert isinstance(got, Miss)
    assert got.stage in ("correspondence", "validate")


@pytest.mark.shared_data
@pytest.mark.opencv
def test_pictures_of_another_device_with_many_leds_never_give_a_pose(pytestconfig):
    from uvgs_bench.camera.calibration import Calibration
    from uvgs_bench.devices.cameras.images import read_image

    files = sorted((pytestconfig.rootpath.parent / "shared/data/leds_hdk").glob("*.tif"))
    if not files:
        pytest.skip("../shared/data/leds_hdk is not here")
    beacon = read_beacon(pytestconfig.rootpath / "calib/beacons/tetra_small.toml")
    lens = Lens("plumb_bob", 640, 480, np.array([576.0, 576.0, 319.5, 239.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
    # Two dozen LEDs: the search is allowed to try them all, and must not believe what fits by chance.
    for max_blobs in (16, 40):
        uvgs = Uvgs(Calibration(lens), beacon, UvgsConfig(max_blobs=max_blobs))
        for file in files:
            assert isinstance(uvgs.solve(Capture(read_image(file), 0, file.name)), Miss)


def test_lights_strewn_about_seldom_pass_for_a_beacon(pytestconfig):
    rng = np.random.default_rng(12)
    beacon = read_beacon(pytestconfig.rootpath / "calib/beacons/tetra_small.toml")
    lens = spots.lens()
    config = UvgsConfig()
    table = LedTable.of(beacon, config)
    published = 0
    for _ in range(300):
        px = rng.uniform([100, 100], [1180, 860], (6, 2))
        published += isinstance(match_leds(px, np.full(6, 0.15), lens, table, config), LedMatch)
    # Four LEDs leave two redundant numbers; what fits them by chance within 14 units of cost cannot be told apart.
    assert published <= 6
