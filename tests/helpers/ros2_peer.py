"""Run by a Python with rclpy: a camera driver, a listener and an operator beside a node, all in real rclpy.

Usage: ros2_peer.py PICTURES.npy INFO.json OUT.json, as ``ros1_peer.py``.
"""

import json
import sys
import time

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image

_WAIT_S = 60.0


def main(pictures_file, info_file, out_file):
    pictures = np.load(pictures_file)
    with open(info_file) as stream:
        info = {key.lower(): value for key, value in json.load(stream).items()}
    rclpy.init()
    node = rclpy.create_node("peer")
    images = node.create_publisher(Image, "/cam/image_raw", qos_profile_sensor_data)
    infos = node.create_publisher(CameraInfo, "/cam/camera_info", qos_profile_sensor_data)
    poses, statuses = {}, []

    def on_pose(message):
        stamp = message.header.stamp
        poses[stamp.sec * 10**9 + stamp.nanosec] = message

    node.create_subscription(PoseWithCovarianceStamped, "/uvgs/test/pose", on_pose, 10)
    node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: statuses.append(m.status[0].message), 10)

    def publish(k):
        message = Image(
            height=int(pictures.shape[1]), width=int(pictures.shape[2]), encoding="mono8", step=int(pictures.shape[2])
        )
        message.header.stamp.sec, message.header.stamp.nanosec = 100, k
        message.header.frame_id = "camera"
        message.data = pictures[k].tobytes()
        images.publish(message)
        infos.publish(CameraInfo(**info))

    def publish_until(is_true):
        until = time.monotonic() + _WAIT_S
        while time.monotonic() < until:
            for k in range(len(pictures)):
                publish(k)
                rclpy.spin_once(node, timeout_sec=0.05)
                rclpy.spin_once(node, timeout_sec=0.0)
            if is_true():
                return True
        return False

    def call(service, name, request):
        client = node.create_client(service, name)
        client.wait_for_service(timeout_sec=20.0)
        future = client.call_async(request)
        rclpy.spin_until_future_complete(node, future, timeout_sec=20.0)
        return future.result()

    def set_value(name, value):
        wanted = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
        request = SetParameters.Request(parameters=[Parameter(name=name, value=wanted)])
        return call(SetParameters, "/uvgs/set_parameters", request).results[0]

    told = {"answered": publish_until(lambda: len(poses) == len(pictures))}
    told["poses"] = {
        stamp: {
            "frame": m.header.frame_id,
            "t_m": [m.pose.pose.position.x, m.pose.pose.position.y, m.pose.pose.position.z],
            "q": [
                m.pose.pose.orientation.x, m.pose.pose.orientation.y,
                m.pose.pose.orientation.z, m.pose.pose.orientation.w,
            ],
            "covariance": [float(value) for value in m.pose.covariance],
        }
        for stamp, m in poses.items()
    }  # fmt: skip
    refused = set_value("threshold_k", -5.0)
    told["refused"], told["reason"] = not refused.successful, refused.reason
    kept = call(GetParameters, "/uvgs/get_parameters", GetParameters.Request(names=["threshold_k"]))
    told["parameter"] = kept.values[0].double_value
    statuses.clear()
    told["taken"] = set_value("min_contrast", 0.99).successful
    told["changed"] = publish_until(lambda: any("contrast" in text for text in statuses))
    with open(out_file, "w") as stream:
        json.dump(told, stream)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main(*sys.argv[1:4])
