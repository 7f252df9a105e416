"""Laws of the sensor: what must not matter, does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers import spots
from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.geometry import Pose
from uvgs_bench.interop.trajectories import CsvPoses, TumPoses, read_poses
from uvgs_bench.sensor import Capture, Miss, PoseEstimate, Uvgs, UvgsConfig
from uvgs_bench.sensor.correspondence import LedMatch, LedTable, match_leds

SEEDS = st.integers(0, 2**32 - 1)
LENS, BEACON, CONFIG = spots.lens(), spots.beacon(), UvgsConfig()


def observed(seed: int) -> tuple[Pose, np.ndarray, np.random.Generator]:
    rng = np.random.default_rng(seed)
    pose = spots.random_pose(rng)
    px = LENS.project(pose.apply(BEACON.positions_m)) + rng.normal(size=(4, 2)) * 0.02
    return pose, px, rng


def match(px: np.ndarray, beacon: Beacon = BEACON) -> object:
    return match_leds(px, np.full(len(px), 0.15), LENS, LedTable.of(beacon, CONFIG), CONFIG)


@settings(max_examples=60, deadline=None)
@given(SEEDS)
def test_the_order_of_blobs_does_not_matter(seed):
    _, px, rng = observed(seed)
    order = rng.permutation(4)
    a, b = match(px), match(px[order])
    assert type(a) is type(b)
    if isinstance(a, LedMatch) and isinstance(b, LedMatch):
        assert (order[b.blob_of_led] == a.blob_of_led).all()
        # The same minimum from other starts: 1e-7 m and rad are far below any noise.
        assert a.start.is_close(b.start, 1e-7, 1e-7)


@settings(max_examples=60, deadline=None)
@given(SEEDS)
def test_the_order_of_leds_in_the_file_does_not_matter(seed):
    _, px, rng = observed(seed)
    order = rng.permutation(4)
    shuffled = replace(BEACON, leds=tuple(BEACON.leds[i] for i in order))
    a, b = match(px), match(px, shuffled)
    assert type(a) is type(b)
    if isinstance(a, LedMatch) and isinstance(b, LedMatch):
        assert a.start.is_close(b.start, 1e-7, 1e-7)


@settings(max_examples=60, deadline=None)
@given(SEEDS)
def test_right_labels_or_a_refusal_never_a_wrong_pose(seed):
    pose, px, _ = observed(seed)
    got = match(px)
    if isinstance(got, LedMatch):
        assert got.blob_of_led.tolist() == [0, 1, 2, 3]
        # 0.02 px at up to 1.5 m moves the attitude by up to some 5 mrad.
        assert got.start.is_close(pose, 0.05, 0.05)
    else:
        assert got.reason in ("ambiguous", "chance_fit")


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.floats(0.3, 3.0))
def test_beacon_and_range_scale_together(seed, scale):
    _, px, _ = observed(seed)
    leds = tuple(replace(led, position_m=led.position_m * scale) for led in BEACON.leds)
    a, b = match(px), match(px, replace(BEACON, leds=leds))
    if isinstance(a, LedMatch) and isinstance(b, LedMatch):
        np.testing.assert_allclose(b.start.t_m, a.start.t_m * scale, rtol=1e-6)
        np.testing.assert_allclose(b.start.R, a.start.R, atol=1e-6)


def test_a_picture_turned_by_half_a_turn_gives_the_pose_turned():
    # A lens without tangential distortion and centred is the same upside down.
    lens = type(LENS)("plumb_bob", 1280, 960, np.array([1000.0, 1000.0, 639.5, 479.5, -0.08, 0.03, 0.0, 0.0, 0.0]))
    uvgs = Uvgs(Calibration(lens), BEACON)
    half = np.diag([-1.0, -1.0, 1.0])
    for seed in range(5):
        rng = np.random.default_rng(seed)
        pose = spots.random_pose(rng)
        image = spots.draw(lens.project(pose.apply(BEACON.positions_m)), rng)
        a, b = uvgs.solve(Capture(image, 0)), uvgs.solve(Capture(np.ascontiguousarray(image[::-1, ::-1]), 0))
        assert type(a) is type(b)
        if isinstance(a, PoseEstimate) and isinstance(b, PoseEstimate):
            # The same pixels in another order of summation; the centroid iteration stops at 2e-5 px.
            np.testing.assert_allclose(b.camera_from_beacon.t_m, half @ a.camera_from_beacon.t_m, atol=2e-6)
            np.testing.assert_allclose(b.camera_from_beacon.R, half @ a.camera_from_beacon.R, atol=2e-5)


@pytest.mark.parametrize("quarters", [1, 3])
def test_a_picture_and_its_lens_turned_by_a_quarter_give_the_pose_turned(quarters):
    width, height = LENS.width_px, LENS.height_px
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = LENS.parameters
    # x' = y, y' = -x for one quarter, and the reverse for three; the tangential terms turn as a vector.
    if quarters == 1:
        numbers, turn = [fy, fx, cy, width - 1.0 - cx, k1, k2, -p2, p1, k3], [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    else:
        numbers, turn = [fy, fx, height - 1.0 - cy, cx, k1, k2, p2, -p1, k3], [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]
    R = np.array([*turn, [0.0, 0.0, 1.0]])
    lens = type(LENS)("plumb_bob", height, width, np.array(numbers))
    straight, turned = Uvgs(Calibration(LENS), BEACON), Uvgs(Calibration(lens), BEACON)
    solved = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        image = spots.draw(LENS.project(spots.random_pose(rng).apply(BEACON.positions_m)), rng)
        a = straight.solve(Capture(image, 0))
        b = turned.solve(Capture(np.ascontiguousarray(np.rot90(image, quarters)), 0))
        assert type(a) is type(b)
        if isinstance(a, PoseEstimate) and isinstance(b, PoseEstimate):
            solved += 1
            # The same pixels in another order of summation; the centroid iteration stops at 2e-5 px.
            np.testing.assert_allclose(b.camera_from_beacon.t_m, R @ a.camera_from_beacon.t_m, atol=2e-6)
            np.testing.assert_allclose(b.camera_from_beacon.R, R @ a.camera_from_beacon.R, atol=2e-5)
            both = np.kron(np.eye(2), R)
            # Noise around a spot is taken from the same pixels: a part in a thousand is rounding of places.
            np.testing.assert_allclose(
                b.covariance, both @ a.covariance @ both.T, atol=1e-3 * np.abs(a.covariance).max()
            )
    assert solved >= 4


def test_the_same_picture_gives_the_same_bits_with_or_without_prior():
    rng = np.random.default_rng(9)
    uvgs = Uvgs(spots.calibration(), BEACON)
    image = spots.draw(LENS.project(spots.random_pose(rng).apply(BEACON.positions_m)), rng)
    a = uvgs.solve(Capture(image, 0))
    assert isinstance(a, PoseEstimate)
    b = uvgs.solve(Capture(image, 0), prior=a)
    assert isinstance(b, PoseEstimate)
    assert (a.camera_from_beacon.matrix() == b.camera_from_beacon.matrix()).all()
    assert (a.covariance == b.covariance).all()


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.integers(0, 2**62))
def test_pose_files_keep_every_digit(seed, t_ns):
    import tempfile
    from pathlib import Path

    rng = np.random.default_rng(seed)
    pose = spots.random_pose(rng, cone_deg=179.0)
    estimate = PoseEstimate(pose, np.eye(6) * 1e-6, t_ns, "b", np.zeros((4, 2)), np.zeros((4, 2)), 0.1, np.inf, 4)
    missed = Miss("blobs", "too_many_blobs", 'why, "indeed"', t_ns, "b", 7)
    capture = Capture(np.zeros((2, 2), dtype=np.uint8), t_ns, 'a "b", c.png', 3)
    with tempfile.TemporaryDirectory() as folder:
        for kind, name in ((CsvPoses, "p.csv"), (TumPoses, "p.tum")):
            path = Path(folder) / name
            with kind(path) as writer:
                writer.write(capture, estimate)
                writer.write(capture, missed)
            records = read_poses(path)
            assert records[0].t_ns == t_ns
            # Quaternion to matrix and back rounds a few times in the last digit.
            assert records[0].pose.is_close(pose, 1e-14, 0.0)
            assert (records[0].pose.t_m == pose.t_m).all()
            if kind is CsvPoses:
                assert records[0].source == capture.source
                assert records[1].pose is None
                assert records[1].reason == "blobs/too_many_blobs"
            else:
                assert len(records) == 1
