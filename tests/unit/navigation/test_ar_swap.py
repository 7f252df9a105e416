"""Poses alone: the gates and habits of the AR pipeline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.geometry import Pose
from uvgs_bench.navigation.ar_swap import ArSwap, AstroLocSettings
from uvgs_bench.navigation.states import PoseMeasurement, SensedPose

LEDS_M = np.array([[0.005, 0.077, -0.002], [-0.05, -0.068, -0.016], [0.054, -0.009, -0.013], [0.033, -0.048, -0.062]])
BODY_FROM_CAMERA = Pose.exp((-1.2, 1.2, -1.2, 0.1, 0.0, 0.05), "body", "camera")
BEACON = Pose.exp((-1.2, 1.2, -1.2, 1.2, 0.1, 0.0), "world", "beacon")
STEP_NS = 100_000_000


def body_at(t_ns):
    return Pose.exp((0.0, 0.0, 0.05 * t_ns / 1e9, 0.1 * t_ns / 1e9, 0.0, 0.0), "world", "body")


def sensed_at(t_ns, count=4, shift=(0.0, 0.0, 0.0)):
    pose = BODY_FROM_CAMERA.inverse() @ body_at(t_ns).inverse() @ BEACON
    pose = Pose(pose.R, pose.t_m + np.asarray(shift), "camera", "beacon")
    px = np.zeros((4, 2))
    px[count:] = np.nan
    return SensedPose(t_ns, pose, 1e-6 * np.eye(6), 0, px)


def native_at(t_ns):
    return PoseMeasurement(t_ns, body_at(t_ns), np.eye(6) * 1e-4, "native")


def swap(beacon=BEACON, **settings):
    return ArSwap(BODY_FROM_CAMERA, LEDS_M, 1000.0, beacon, AstroLocSettings(**settings))


def test_the_shipped_minimum_of_five_drops_every_beacon_of_four():
    shipped = swap(min_num_matches=5)
    assert shipped.add_sensed(sensed_at(0)) == "too_few_matches"
    assert shipped.state_at(0) is None
    assert swap().add_sensed(sensed_at(0)) == "fused"
    assert swap().add_sensed(sensed_at(0, count=3)) == "too_few_matches"


def test_between_poses_the_velocity_is_kept_for_a_second_at_most():
    pipeline = swap()
    for k in range(6):
        pipeline.add_sensed(sensed_at(k * STEP_NS))
    said = pipeline.state_at(5 * STEP_NS + 400_000_000)
    # A slow turn over 0.4 s bends the path by less than a millimetre.
    assert said.world_from_body.is_close(body_at(said.t_ns), 1e-3, 1e-3)
    assert said.age_s == pytest.approx(0.4)
    assert pipeline.state_at(5 * STEP_NS + 1_100_000_000) is None


def test_far_off_messages_are_refused_until_the_expectation_is_gone():
    pipeline = swap()
    for k in range(6):
        pipeline.add_sensed(sensed_at(k * STEP_NS))
    far = (0.3, 0.0, 0.0)  # some 300 px
    assert pipeline.add_sensed(sensed_at(6 * STEP_NS, shift=far)) == "reprojection"
    assert pipeline.add_sensed(sensed_at(17 * STEP_NS, shift=far)) == "fused"


def test_the_beacon_is_learned_once_and_its_error_stays():
    pipeline = swap(beacon=None)
    assert pipeline.add_sensed(sensed_at(0)) == "frame_unknown"
    off = Pose(body_at(0).R, body_at(0).t_m + np.array([0.0, 0.05, 0.0]), "world", "body")
    pipeline.add_native(replace(native_at(0), world_from_body=off))
    assert pipeline.add_sensed(sensed_at(STEP_NS)) == "fused"
    learned = pipeline.world_from_beacon
    for k in range(2, 30):
        pipeline.add_sensed(sensed_at(k * STEP_NS))
    assert pipeline.world_from_beacon is learned
    error = pipeline.state_at(29 * STEP_NS).world_from_body.t_m - body_at(29 * STEP_NS).t_m
    assert error[1] == pytest.approx(0.05, abs=0.01)


def test_a_stale_native_pose_does_not_teach():
    pipeline = swap(beacon=None)
    pipeline.add_native(native_at(0))
    assert pipeline.add_sensed(sensed_at(7 * STEP_NS)) == "frame_unknown"


def test_without_mixing_native_poses_wait_until_the_beacon_is_gone():
    pipeline = swap(is_mixed=False)
    pipeline.add_sensed(sensed_at(0))
    assert pipeline.add_native(native_at(STEP_NS)) == "not_mixed"
    assert pipeline.add_native(native_at(12 * STEP_NS)) == "fused"


def test_settings_that_cannot_be_meant():
    with pytest.raises(ValueError, match="min_num_matches"):
        AstroLocSettings(min_num_matches=2)
    with pytest.raises(ValueError, match="timeout_s"):
        AstroLocSettings(timeout_s=0.0)
