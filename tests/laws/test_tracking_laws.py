"""Laws of tracking: a prior may shorten the search, never change the answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers import spots
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.sensor import Capture, PoseEstimate, Uvgs, UvgsConfig

SEEDS = st.integers(0, 2**32 - 1)
LENS, BEACON = spots.lens(), spots.beacon()
UVGS = Uvgs(spots.calibration(), BEACON)
ALONE = Uvgs(spots.calibration(), BEACON, UvgsConfig(track=False))
STEP_NS = 20_000_000


def picture(pose: Pose, rng: np.random.Generator, others: np.ndarray | None = None) -> np.ndarray:
    px = LENS.project(pose.apply(BEACON.positions_m))
    return spots.draw(px if others is None else np.vstack([px, others]), rng)


def moved(pose: Pose, rng: np.random.Generator) -> Pose:
    """A step of at most 0.2 m/s and 0.4 rad/s."""
    turn = so3_exp(rng.uniform(-1.0, 1.0, 3) * 0.4 * STEP_NS * 1e-9 / np.sqrt(3.0))
    shift = rng.uniform(-1.0, 1.0, 3) * 0.2 * STEP_NS * 1e-9 / np.sqrt(3.0)
    return Pose(turn @ pose.R, pose.t_m + shift, "camera", "beacon")


def first(rng: np.random.Generator) -> tuple[Pose, PoseEstimate]:
    for _ in range(20):
        pose = spots.random_pose(rng)
        got = UVGS.solve(Capture(picture(pose, rng), 0))
        if isinstance(got, PoseEstimate) and not got.flags:
            return pose, got
    raise AssertionError("no clear view among twenty")


@settings(max_examples=12, deadline=None)
@given(SEEDS)
def test_windows_and_the_whole_picture_give_one_answer(seed):
    rng = np.random.default_rng(seed)
    pose, prior = first(rng)
    for k in range(1, 5):
        pose = moved(pose, rng)
        capture = Capture(picture(pose, rng), k * STEP_NS)
        got, whole = UVGS.solve(capture, prior), ALONE.solve(capture, prior)
        if isinstance(got, PoseEstimate) and got.tracked_count:
            # Two solutions of one minimum differ by rounding; 1e-8 is a thousandth of the noise.
            assert isinstance(whole, PoseEstimate)
            np.testing.assert_allclose(got.camera_from_beacon.t_m, whole.camera_from_beacon.t_m, atol=1e-8)
            np.testing.assert_allclose(got.camera_from_beacon.R, whole.camera_from_beacon.R, atol=1e-8)
            np.testing.assert_allclose(got.covariance, whole.covariance, rtol=1e-5)
        else:
            assert type(got) is type(whole)
        if not isinstance(got, PoseEstimate):
            break
        prior = got


def test_a_clear_sequence_is_followed_and_searched_anew_now_and_then():
    rng = np.random.default_rng(4)
    config = UvgsConfig(track_captures=6)
    uvgs = Uvgs(spots.calibration(), BEACON, config)
    pose = Pose(so3_exp(np.array([0.3, -0.2, 0.5])), np.array([0.02, -0.03, 0.8]), "camera", "beacon")
    counts, prior = [], None
    for k in range(14):
        prior = uvgs.solve(Capture(picture(pose, rng), k * STEP_NS), prior)
        assert isinstance(prior, PoseEstimate)
        counts.append(prior.tracked_count)
        pose = moved(pose, rng)
    assert counts == [0, 1, 2, 3, 4, 5, 0, 1, 2, 3, 4, 5, 0, 1]


def test_the_same_picture_and_prior_give_the_same_bits():
    rng = np.random.default_rng(5)
    pose, prior = first(rng)
    capture = Capture(picture(moved(pose, rng), rng), STEP_NS)
    a, b = (Uvgs(spots.calibration(), BEACON).solve(capture, prior) for _ in range(2))
    assert isinstance(a, PoseEstimate)
    assert isinstance(b, PoseEstimate)
    assert a.tracked_count == 1
    assert (a.camera_from_beacon.matrix() == b.camera_from_beacon.matrix()).all()
    assert (a.covariance == b.covariance).all()


@pytest.mark.parametrize("offset_px", [(9.0, 0.0), (0.0, 14.0), (-13.0, 13.0)])
def test_a_second_light_in_a_window_sends_it_to_the_whole_picture(offset_px):
    rng = np.random.default_rng(6)
    pose, prior = first(rng)
    glint = LENS.project(pose.apply(BEACON.positions_m))[1] + offset_px
    got = UVGS.solve(Capture(picture(pose, rng, glint[None]), STEP_NS), prior)
    assert not (isinstance(got, PoseEstimate) and got.tracked_count)


def test_a_light_in_the_place_of_an_led_is_not_believed():
    rng = np.random.default_rng(7)
    pose, prior = first(rng)
    px = LENS.project(pose.apply(BEACON.positions_m))
    # The second LED is hidden, and a glint stands near.
    px[1] += (6.0, -5.0)
    got = UVGS.solve(Capture(spots.draw(px, rng), STEP_NS), prior)
    assert not (isinstance(got, PoseEstimate) and got.tracked_count)


@pytest.mark.parametrize(
    "change",
    [
        {"t_ns": 2 * STEP_NS},
        {"t_ns": -10_000_000_000},
        {"beacon": "another"},
        {"margin": 1.0},
        {"flags": ("weak_evidence",)},
        {"covariance": np.eye(6)},
    ],
)
def test_a_prior_that_says_too_little_is_not_followed(change):
    rng = np.random.default_rng(8)
    pose, prior = first(rng)
    got = UVGS.solve(Capture(picture(pose, rng), STEP_NS), replace(prior, **change))
    assert not (isinstance(got, PoseEstimate) and got.tracked_count)


def test_a_jump_beyond_the_windows_is_found_in_the_whole_picture():
    rng = np.random.default_rng(9)
    _, prior = first(rng)
    pose, _ = first(rng)
    got, whole = (u.solve(Capture(picture(pose, np.random.default_rng(1)), STEP_NS), prior) for u in (UVGS, ALONE))
    assert isinstance(got, PoseEstimate)
    assert isinstance(whole, PoseEstimate)
    assert got.tracked_count == 0
    assert got.camera_from_beacon.is_close(whole.camera_from_beacon, 0.0, 0.0)
