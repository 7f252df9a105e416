"""Astrobee's messages: their sums, their pixels, their poses, and what its localizer drops in silence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.camera import Lens
from uvgs_bench.geometry import Pose
from uvgs_bench.interop import astrobee
from uvgs_bench.interop.astrobee import LocalizerSettings, VisualLandmarks, landmarks_from_pose, why_dropped
from uvgs_bench.sensor import PoseEstimate


def fov(fx, fy, cx, cy, w):
    return Lens("fov", 1280, 960, np.array([fx, fy, cx, cy, w]))


BUMBLE_NAV = fov(608.8073, 607.61439, 632.53684, 549.08386, 0.998693)
BUMBLE_DOCK = fov(753.51021, 751.3611, 631.11512, 508.69621, 1.00762)
QUEEN_NAV = fov(604.19903, 602.67924, 588.79562, 509.73835, 1.00201)
QUEEN_DOCK = fov(757.05068, 755.16581, 711.13238, 489.98967, 1.01007)
SCI = Lens(
    "plumb_bob", 1336, 1002,
    np.array([1023.6054, 1023.6054, 683.97547, 511.2185, -0.025598438, 0.048258987, -0.00041380657, 0.0056673533, 0.0]),
)  # fmt: skip


@pytest.mark.parametrize(
    ("lens", "point_m", "undistorted_px", "raw_px"),
    [
        (BUMBLE_NAV, (0.10, -0.05, 1.0), (60.880730, -30.380719), (698.712215, 516.061005)),
        (BUMBLE_NAV, (0.5, 0.3, 1.5), (202.935767, 121.522878), (842.194807, 674.632155)),
        (BUMBLE_NAV, (-0.8, 0.4, 1.0), (-487.045840, 243.045756), (210.996493, 759.441046)),
        (BUMBLE_DOCK, (0.5, 0.3, 1.5), (251.170070, 150.272220), (890.755396, 664.036059)),
        (BUMBLE_DOCK, (-0.8, 0.4, 1.0), (-602.808168, 300.544440), (110.464143, 768.279216)),
        (QUEEN_NAV, (0.5, 0.3, 1.5), (201.399677, 120.535848), (796.911255, 634.293637)),
        (QUEEN_DOCK, (0.10, -0.05, 1.0), (75.705068, -37.758291), (793.587838, 448.864588)),
        (SCI, (0.10, -0.05, 1.0), (102.360540, -51.180270), (786.496801, 459.988797)),
        (SCI, (0.5, 0.3, 1.5), (341.2018, 204.72108), (1026.342705, 716.048865)),
    ],
)
def test_worked_examples_of_real_robots(lens, point_m, undistorted_px, raw_px):
    # 1e-6 px: the examples are printed to six places.
    np.testing.assert_allclose(lens.project(point_m)[0], raw_px, atol=1e-6)
    np.testing.assert_allclose(astrobee.undistorted_from_raw(lens, lens.project(point_m))[0], undistorted_px, atol=1e-6)


def test_astrobees_own_test_camera():
    lens = Lens("fov", 1200, 600, np.array([300.0, 300.0, 660.5, 500.3, 0.7]))
    np.testing.assert_allclose(
        astrobee.undistorted_from_raw(lens, [[542.4, 182.5]]), [[-144.779236, -389.592219]], atol=1e-6
    )
    np.testing.assert_allclose(
        astrobee.undistorted_from_raw(lens, [[619.390018, 579.745040]]), [[-40.0, 77.3]], atol=2e-6
    )


@pytest.mark.parametrize("version", ["v1", "v2"])
def test_ros_1_knows_both_versions_by_their_sums(version):
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    astrobee.add_message_types(store, version)
    for name in (astrobee.LANDMARK, astrobee.LANDMARKS, astrobee.REGISTRATION):
        assert store.generate_msgdef(name)[1] == astrobee.ROS1_MD5[name, version]


def estimate(hidden: int = 0) -> PoseEstimate:
    beacon, lens = spots.beacon(), spots.lens()
    pose = spots.random_pose(np.random.default_rng(3), cone_deg=20.0)
    px = lens.project(pose.apply(beacon.positions_m))
    px[:hidden] = np.nan
    return PoseEstimate(
        pose, np.eye(6), 1_700_000_000_123_456_789, "b", px, 0 * px, 0.0, 9.0, 4, stage_s={"blobs": 0.25, "solve": 0.5}
    )


def test_the_pose_is_the_inverse_and_puts_the_landmarks_where_they_were_seen():
    beacon, lens, found = spots.beacon(), spots.lens(), estimate(hidden=1)
    message = landmarks_from_pose(found, beacon, lens)
    pose = message.dock_from_camera()
    assert pose.is_close(found.camera_from_beacon.inverse(), 1e-12, 1e-12)
    np.testing.assert_array_equal(message.points_m, beacon.positions_m[1:])
    np.testing.assert_allclose(astrobee.landmark_errors_px(message, lens.fx_px, lens.fy_px), 0.0, atol=1e-7)
    assert message.runtime_s == 0.75
    # Raw pixels, or the pose the other way round, show at once.
    raw = replace(message, undistorted_px=found.led_px[1:])
    assert astrobee.landmark_errors_px(raw, lens.fx_px, lens.fy_px).min() > 30.0
    wrong = found.camera_from_beacon
    turned = replace(message, position_m=wrong.t_m, quaternion_xyzw=wrong.quaternion_xyzw())
    assert astrobee.landmark_errors_px(turned, lens.fx_px, lens.fy_px).min() > 30.0


@pytest.mark.parametrize("ros", ["ROS1_NOETIC", "ROS2_JAZZY"])
@pytest.mark.parametrize("version", ["v1", "v2"])
def test_a_message_survives_the_wire(ros, version):
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores[ros])
    astrobee.add_message_types(store, version)
    types = store.types
    time = types["builtin_interfaces/msg/Time"](1_700_000_000, 123_456_789)
    seq = [7] if ros == "ROS1_NOETIC" else []
    header = types["std_msgs/msg/Header"](*seq, time, astrobee.FRAME_ID)
    sent = landmarks_from_pose(estimate(), spots.beacon(), spots.lens())
    message = astrobee.message_from_landmarks(types, header, sent, version)
    serialize, deserialize = (
        (store.serialize_ros1, store.deserialize_ros1) if seq else (store.serialize_cdr, store.deserialize_cdr)
    )
    got = astrobee.landmarks_from_message(deserialize(serialize(message, astrobee.LANDMARKS), astrobee.LANDMARKS))
    assert (got.t_ns, got.frame_id, got.camera_id) == (1_700_000_000_123_456_789, "dock/body", 0)
    assert got.runtime_s == (0.75 if version == "v2" else None)
    np.testing.assert_array_equal(got.position_m, sent.position_m)
    np.testing.assert_array_equal(got.points_m, sent.points_m.astype(np.float32))
    np.testing.assert_array_equal(got.undistorted_px, sent.undistorted_px.astype(np.float32))


def test_what_the_localizer_drops():
    four = landmarks_from_pose(estimate(), spots.beacon(), spots.lens())
    assert "4 landmarks" in why_dropped(four)
    assert "fewer than 5 (min_num_matches_per_measurement)" in why_dropped(four)
    lowered = LocalizerSettings(min_landmarks=4)
    assert why_dropped(four, lowered) is None
    assert "no pose" in why_dropped(replace(four, quaternion_xyzw=np.zeros(4)), lowered)
    assert "no pose" in why_dropped(replace(four, position_m=np.full(3, np.nan)), lowered)
    px = four.undistorted_px.copy()
    px[2, 0] = np.inf
    assert "not finite" in why_dropped(replace(four, undistorted_px=px), lowered)


def test_a_landmark_behind_the_camera_is_infinitely_far_off():
    pose = Pose.identity("beacon", "camera")
    message = VisualLandmarks(
        0, pose.t_m, pose.quaternion_xyzw(), np.array([[0.0, 0.0, -1.0], [0.1, 0.0, 1.0]]), np.zeros((2, 2))
    )
    np.testing.assert_allclose(astrobee.landmark_errors_px(message, 500.0, 500.0), [np.inf, 50.0])
