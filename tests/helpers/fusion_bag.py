"""A drawn mission as a ROS bag: readings, sensor poses, poses of another localiser."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from uvgs_bench.geometry import Pose
from uvgs_bench.interop.bag_writer import NewBag
from uvgs_bench.interop.navigation_messages import IMU, ODOMETRY, POSE_WITH_COVARIANCE
from uvgs_bench.navigation.fusion_data import FusionInput
from uvgs_bench.navigation.imu import ImuSamples
from uvgs_bench.navigation.states import SensedPose, place_from_tangent

SWAP = np.array([3, 4, 5, 0, 1, 2])
START_NS = 1_700_000_000_000_000_000


def pose_message(types, pose, covariance):
    point = types["geometry_msgs/msg/Point"](*pose.t_m.tolist())
    turn = types["geometry_msgs/msg/Quaternion"](*pose.quaternion_xyzw().tolist())
    plain = types["geometry_msgs/msg/Pose"](point, turn)
    matrix = np.zeros(36) if covariance is None else covariance[np.ix_(SWAP, SWAP)].ravel().copy()
    return types["geometry_msgs/msg/PoseWithCovariance"](plain, matrix)


def imu_message(types, header, acceleration, rate, missing=False):
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    unknown = np.zeros(9)
    unknown[0] = -1.0
    turned = unknown.copy() if missing else np.zeros(9)
    return types[IMU](
        header, quaternion(0.0, 0.0, 0.0, 1.0), unknown, vector(*rate.tolist()), turned,
        vector(*acceleration.tolist()), np.zeros(9),
    )  # fmt: skip


def write_bag(path: Path, source: FusionInput, *, doubted: bool = True, with_imu: bool = True, missing: bool = False):
    """Write a mission; log times are arrival times."""
    bag = NewBag(path)
    types, make = bag.make.types, bag.make
    messages = []
    imu: ImuSamples = source.imu
    for t, a, w in zip(imu.t_ns.tolist(), imu.acceleration_mps2, imu.rate_radps, strict=True):
        if with_imu:
            stamp = START_NS + t
            messages.append((stamp, "/hw/imu", imu_message(types, make.header(stamp, "body"), a, w, missing)))
    for pose in source.sensed:
        stamp = START_NS + pose.t_ns
        covariance = place_from_tangent(pose.camera_from_beacon, pose.covariance) if doubted else None
        body = types[POSE_WITH_COVARIANCE](make.header(stamp), pose_message(types, pose.camera_from_beacon, covariance))
        messages.append((stamp + pose.delay_ns, "/uvgs/tetra/pose", body))
    twist = types["geometry_msgs/msg/Twist"](*(types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0) for _ in range(2)))
    still = types["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36))
    for m in source.native:
        stamp = START_NS + m.t_ns
        body = pose_message(types, m.world_from_body, m.covariance)
        odometry = types[ODOMETRY](make.header(stamp, "world"), "body", body, still)
        messages.append((stamp + m.delay_ns, "/loc/pose", odometry))
    for log_ns, topic, message in sorted(messages, key=lambda entry: entry[0]):
        bag.write(topic, log_ns, message)
    bag.close()


def drawn_source(flight, world_from_beacon: Pose, body_from_camera: Pose, seed: int = 0) -> FusionInput:
    """A flight of ``fusion_flight`` as an input of fusion, with poses of the sensor drawn, not rendered."""
    from tests.helpers.fusion_flight import GRAVITY, state_at

    rng = np.random.default_rng(seed)
    covariance = np.diag(np.repeat((1e-3**2, 5e-4**2), 3))
    sensed = []
    for m in flight.poses[1:]:
        true = body_from_camera.inverse() @ state_at(m.t_ns).pose.inverse() @ world_from_beacon
        xi = rng.standard_normal(6) * np.sqrt(np.diag(covariance))
        sensed.append(SensedPose(m.t_ns, true.perturbed(xi), covariance, 20_000_000))
    native = tuple(
        type(m)(m.t_ns + 3_000_000, state_at(m.t_ns + 3_000_000).pose, m.covariance, "native", 100_000_000)
        for m in flight.poses[5::10]
    )
    return FusionInput(
        name="drawn", words="a drawn flight", imu=flight.unit.samples, sensed=tuple(sensed), native=native,
        world_from_beacon=world_from_beacon, body_from_camera=body_from_camera, leds_m=np.eye(4, 3) * 0.1,
        focal_px=1000.0, noise=flight.imu_truth.noise, gravity_mps2=GRAVITY, rest_s=0.8, truth=state_at,
        is_simulated=True,
    )  # fmt: skip
