"""Run by the system's Python: a camera driver, a listener and an operator beside a node, all in real rospy.

Usage: ros1_peer.py PICTURES.npy INFO.json OUT.json. Publishes the pictures over and over with their number as stamp,
keeps what the node answers, changes parameters, and tells it all as JSON.
"""

import json
import sys
import threading
import time

import numpy as np
import rospy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import CameraInfo, Image
from tf2_msgs.msg import TFMessage

_WAIT_S = 40.0


def main(pictures_file, info_file, out_file):
    pictures = np.load(pictures_file)
    with open(info_file) as stream:
        info = json.load(stream)
    rospy.init_node("peer", disable_signals=True)
    images = rospy.Publisher("/cam/image_raw", Image, queue_size=1)
    infos = rospy.Publisher("/cam/camera_info", CameraInfo, queue_size=1)
    poses, transforms, statuses, lock = {}, [], [], threading.Lock()

    def on_pose(message):
        with lock:
            poses[message.header.stamp.to_nsec()] = message

    def on_status(message):
        with lock:
            statuses.append((message.status[0].level, message.status[0].message))

    rospy.Subscriber("/uvgs/test/pose", PoseWithCovarianceStamped, on_pose)
    rospy.Subscriber("/tf", TFMessage, lambda m: transforms.append(m.transforms[0]))
    rospy.Subscriber("/diagnostics", DiagnosticArray, on_status)

    def publish(k):
        message = Image(height=pictures.shape[1], width=pictures.shape[2], encoding="mono8", step=pictures.shape[2])
        message.header.stamp = rospy.Time(100, k)
        message.header.frame_id = "camera"
        message.data = pictures[k].tobytes()
        images.publish(message)
        infos.publish(CameraInfo(**info))

    def publish_until(is_true):
        until = time.monotonic() + _WAIT_S
        while time.monotonic() < until:
            for k in range(len(pictures)):
                publish(k)
                time.sleep(0.05)
            if is_true():
                return True
        return False

    told = {"answered": publish_until(lambda: len(poses) == len(pictures) and bool(transforms))}
    with lock:
        told["poses"] = {
            stamp: {
                "frame": m.header.frame_id,
                "t_m": [m.pose.pose.position.x, m.pose.pose.position.y, m.pose.pose.position.z],
                "q": [
                    m.pose.pose.orientation.x, m.pose.pose.orientation.y,
                    m.pose.pose.orientation.z, m.pose.pose.orientation.w,
                ],
                "covariance": list(m.pose.covariance),
            }
            for stamp, m in poses.items()
        }  # fmt: skip
        told["transform"] = [transforms[0].header.frame_id, transforms[0].child_frame_id] if transforms else []
    told["parameter"] = rospy.get_param("/uvgs/threshold_k", None)

    # A wrong value is put back; a right one is used.
    rospy.set_param("/uvgs/threshold_k", -5.0)
    told["refused"] = publish_until(lambda: rospy.get_param("/uvgs/threshold_k") == told["parameter"])
    statuses.clear()
    rospy.set_param("/uvgs/min_contrast", 0.99)
    told["changed"] = publish_until(lambda: any("contrast" in text for _, text in statuses))
    told["levels"] = sorted({level for level, _ in statuses})
    with open(out_file, "w") as stream:
        json.dump(told, stream)
    rospy.signal_shutdown("done")


if __name__ == "__main__":
    main(*sys.argv[1:4])
