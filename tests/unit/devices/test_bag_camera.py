"""ROS bags as cameras: encodings, stamps, topics, and what is wrong with a bag."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from uvgs_bench.devices.cameras import open_camera
from uvgs_bench.errors import CaptureError, ConfigError

cv2 = pytest.importorskip("cv2")
rosbag1 = pytest.importorskip("rosbags.rosbag1")
pytestmark = pytest.mark.opencv
BAGS = Path(__file__).parents[4] / "shared" / "data" / "bags"
GREY = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20


def store():
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC)


def image(types, encoding: str, data: np.ndarray, sec: int, *, step: int = 0, big: int = 0):
    header = types.types["std_msgs/msg/Header"](0, types.types["builtin_interfaces/msg/Time"](sec, 250), "cam")
    rows = np.ascontiguousarray(data).view(np.uint8).reshape(data.shape[0], -1)
    if step:
        rows = np.pad(rows, ((0, 0), (0, step - rows.shape[1])), constant_values=99)
    kind = types.types["sensor_msgs/msg/Image"]
    return kind(header, data.shape[0], data.shape[1], encoding, big, rows.shape[1], rows.ravel())


def write(path: Path, messages: dict[str, list]) -> Path:
    """A ROS 1 bag whose own times are two seconds later than the headers'."""
    types = store()
    with rosbag1.Writer(path) as writer:
        for topic, entries in messages.items():
            connection = writer.add_connection(topic, entries[0].__msgtype__, typestore=types)
            for message in entries:
                stamp = message.header.stamp
                raw = types.serialize_ros1(message, message.__msgtype__)
                writer.write(connection, (stamp.sec + 2) * 10**9 + stamp.nanosec, raw)
    return path


def colour() -> np.ndarray:
    return np.stack([GREY, GREY + 1, GREY + 2], axis=-1)


@pytest.mark.parametrize(
    ("encoding", "data", "expected", "options"),
    [
        ("mono8", GREY, GREY, {}),
        ("mono8", GREY, GREY, {"step": 8}),
        ("bgr8", colour(), colour(), {}),
        ("rgb8", colour(), colour()[:, :, ::-1], {"step": 16}),
        ("rgba8", np.dstack([colour(), GREY]), colour()[:, :, ::-1], {}),
        ("mono16", GREY.astype("<u2") * 200, GREY.astype(np.uint16) * 200, {}),
        ("mono16", (GREY.astype(np.uint16) * 200).astype(">u2"), GREY.astype(np.uint16) * 200, {"big": 1}),
    ],
)
def test_pixels_are_those_of_the_message(tmp_path, encoding, data, expected, options):
    path = write(tmp_path / "a.bag", {"/cam": [image(store(), encoding, data, 5, **options)]})
    with open_camera(f"bag:{path}") as camera:
        assert camera.length == 1
        capture = camera.grab()
        assert camera.grab() is None
    np.testing.assert_array_equal(capture.image, expected)
    assert capture.image.dtype == expected.dtype
    # The instant of the exposure, not that of the recording.
    assert capture.t_ns == 5 * 10**9 + 250
    assert capture.source == "a.bag/cam#0"


def test_compressed_images_are_decoded_and_broken_ones_named(tmp_path):
    types = store()
    header = types.types["std_msgs/msg/Header"](0, types.types["builtin_interfaces/msg/Time"](1, 0), "cam")
    payload = cv2.imencode(".png", GREY)[1].ravel()
    kind = types.types["sensor_msgs/msg/CompressedImage"]
    good, broken = kind(header, "png", payload), kind(header, "png", payload[: len(payload) // 2])
    path = write(tmp_path / "c.bag", {"/cam/compressed": [good, broken]})
    camera = open_camera(f"bag:{path}")
    np.testing.assert_array_equal(camera.grab().image, GREY)
    with pytest.raises(CaptureError, match=r"c\.bag/cam/compressed#1: is truncated"):
        camera.grab()
    camera.close()
    camera.close()


def test_topics_are_chosen_and_mistakes_are_one_line(tmp_path):
    types = store()
    one = image(types, "mono8", GREY, 1)
    path = write(tmp_path / "two.bag", {"/left": [one], "/right": [image(types, "mono8", GREY + 1, 1)]})
    with open_camera(f"bag:{path}?topic=/right") as camera:
        assert camera.grab().image[0, 0] == 1
    with pytest.raises(ConfigError, match=r"several topics of images, say \?topic= one of: /left, /right"):
        open_camera(f"bag:{path}")
    with pytest.raises(ConfigError, match="did you mean '/right'"):
        open_camera(f"bag:{path}?topic=/rigt")
    info = one.header
    plain = types.types["geometry_msgs/msg/PointStamped"](info, types.types["geometry_msgs/msg/Point"](1.0, 2.0, 3.0))
    path = write(tmp_path / "none.bag", {"/point": [plain]})
    with pytest.raises(CaptureError, match="holds no images, only geometry_msgs/msg/PointStamped"):
        open_camera(f"bag:{path}")
    (tmp_path / "junk.bag").write_bytes(b"this is no bag")
    with pytest.raises(CaptureError, match=r"junk\.bag: is no ROS bag"):
        open_camera(f"bag:{tmp_path / 'junk.bag'}")
    with pytest.raises(CaptureError, match="no such file"):
        open_camera("bag:/nowhere.bag")


def test_unknown_encodings_and_torn_images_are_named(tmp_path):
    types = store()
    path = write(tmp_path / "b.bag", {"/cam": [image(types, "bayer_rggb8", GREY, 1)]})
    with (
        open_camera(f"bag:{path}") as camera,
        pytest.raises(CaptureError, match="'bayer_rggb8', expected one of mono8"),
    ):
        camera.grab()
    torn = image(types, "mono8", GREY, 1)
    torn.height = 7
    path = write(tmp_path / "t.bag", {"/cam": [torn]})
    said = "4x7 px of mono8 in rows of 4 bytes, but holds 12 bytes"
    with open_camera(f"bag:{path}") as camera, pytest.raises(CaptureError, match=said):
        camera.grab()


def test_stamps_never_run_backwards(tmp_path):
    types = store()
    messages = [image(types, "mono8", GREY, sec) for sec in (3, 2)]
    path = tmp_path / "back.bag"
    with rosbag1.Writer(path) as writer:
        connection = writer.add_connection("/cam", messages[0].__msgtype__, typestore=types)
        for i, message in enumerate(messages):
            writer.write(connection, (10 + i) * 10**9, types.serialize_ros1(message, message.__msgtype__))
    with open_camera(f"bag:{path}") as camera:
        camera.grab()
        with pytest.raises(CaptureError, match="earlier than that of the image before"):
            camera.grab()


@pytest.mark.shared_data
@pytest.mark.parametrize(
    ("name", "count", "size"), [("aruco_images.bag", 1, (960, 1280)), ("zstd_messages.mcap", 2, (480, 640))]
)
def test_bags_of_others(name, count, size):
    if not BAGS.is_dir():
        pytest.skip(f"no recorded bags at {BAGS}")
    with open_camera(f"bag:{BAGS / name}") as camera:
        captures = list(camera)
    assert len(captures) == count
    assert all(capture.image.shape == (*size, 3) for capture in captures)
    if name.startswith("aruco"):
        # As the header says; the bag recorded it 1.24 s later.
        assert captures[0].t_ns == 1491682360314066469
