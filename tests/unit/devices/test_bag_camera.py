"""ROS bags as cameras: encodings, stamps, topics, and what is wrong with a bag."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.helpers.bag_files import camera_info_note, image_note, png_note, write_bag
from uvgs_bench.camera import Lens
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


def test_compressed_images_are_decoded_and_broken_ones_left_out_by_name(tmp_path):
    types = store()
    header = types.types["std_msgs/msg/Header"](0, types.types["builtin_interfaces/msg/Time"](1, 0), "cam")
    payload = cv2.imencode(".png", GREY)[1].ravel()
    kind = types.types["sensor_msgs/msg/CompressedImage"]
    good, broken = kind(header, "png", payload), kind(header, "png", payload[: len(payload) // 2])
    path = write(tmp_path / "c.bag", {"/cam/compressed": [good, broken, good]})
    with open_camera(f"bag:{path}") as camera:
        captures = list(camera)
        assert [capture.index for capture in captures] == [0, 1]
        assert "c.bag/cam/compressed#1: is truncated" in camera.remarks[-1]
    np.testing.assert_array_equal(captures[1].image, GREY)
    path = write(tmp_path / "d.bag", {"/cam/compressed": [broken, broken]})
    camera = open_camera(f"bag:{path}")
    with pytest.raises(CaptureError, match=r"no image can be read: d\.bag/cam/compressed#0: is truncated"):
        camera.grab()
    camera.close()
    camera.close()


def test_topics_are_chosen_and_mistakes_are_one_line(tmp_path):
    types = store()
    one = image(types, "mono8", GREY, 1)
    path = write(tmp_path / "two.bag", {"/left": [one], "/right": [image(types, "mono8", GREY + 1, 1)]})
    with open_camera(f"bag:{path}?topic=/right") as camera:
        assert camera.grab().image[0, 0] == 1
    with pytest.raises(ConfigError, match=r"several topics of images, choose one: /left, /right"):
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
    path = write(tmp_path / "b.bag", {"/cam": [image(types, "32FC1", GREY, 1)]})
    with open_camera(f"bag:{path}") as camera, pytest.raises(CaptureError, match="'32FC1', expected one of mono8"):
        camera.grab()
    torn = image(types, "mono8", GREY, 1)
    torn.height = 7
    path = write(tmp_path / "t.bag", {"/cam": [torn]})
    said = "4x7 px of mono8 in rows of 4 bytes, but holds 12 bytes"
    with open_camera(f"bag:{path}") as camera, pytest.raises(CaptureError, match=said):
        camera.grab()


def test_stamps_never_run_backwards(tmp_path):
    def bag(name: str, stamps_ns: list[int]) -> Path:
        notes = [image_note(GREY, t_ns, log_ns=10**10 + i) for i, t_ns in enumerate(stamps_ns)]
        return write_bag(tmp_path, "ros1", notes, name)

    second = 10**9
    path = bag("late", [3 * second, 3 * second + 50, 3 * second + 20, 4 * second])
    with open_camera(f"bag:{path}") as camera:
        assert [capture.t_ns for capture in camera] == [3 * second, 3 * second + 50, 4 * second]
        assert "#2: left out, its header stamp is earlier" in camera.remarks[-1]
    path = bag("jump", [9 * second, 2 * second])
    with open_camera(f"bag:{path}") as camera:
        camera.grab()
        with pytest.raises(CaptureError, match=r"earlier than that of the image before, by 7\.000 s; \?stamps=log"):
            camera.grab()
    with open_camera(f"bag:{path}?stamps=log") as camera:
        assert [capture.t_ns for capture in camera] == [10**10, 10**10 + 1]


def test_stamps_that_were_never_set_or_lag_behind_are_said(tmp_path):
    notes = [image_note(GREY, 0, log_ns=5 * 10**9), image_note(GREY, 0, log_ns=6 * 10**9)]
    with open_camera(f"bag:{write_bag(tmp_path, 'mcap', notes)}") as camera:
        assert [capture.t_ns for capture in camera] == [5 * 10**9, 6 * 10**9]
        assert "never set" in camera.remarks[0]
    notes = [image_note(GREY, 10**9, log_ns=2_250_000_000)]
    with open_camera(f"bag:{write_bag(tmp_path, 'ros1', notes)}") as camera:
        assert camera.grab().t_ns == 10**9
        assert "recorded 1.250 s later than the header stamps" in camera.remarks[0]


def test_mosaics_keep_their_pattern_and_several_bags_are_one(tmp_path):
    even = GREY[:2]
    first = image_note(even, 10**9)
    first.fields["encoding"] = "bayer_grbg8"
    path = write_bag(tmp_path, "db3", [first])
    later = write_bag(tmp_path, "ros1", [image_note(even, 2 * 10**9)])
    with open_camera(f"bag:{path},{later}") as camera:
        captures = list(camera)
    assert [capture.bayer for capture in captures] == ["grbg", None]
    assert [capture.source for capture in captures] == ["a.db3/cam/image_raw#0", "a.bag/cam/image_raw#1"]
    # The path of a bag alone will do, with or without options.
    with open_camera(f"{path}?topic=image_raw") as camera:
        assert camera.length == 1


def test_topics_by_namespace_and_transport(tmp_path):
    notes = [image_note(GREY, 1, f"/{name}/image_raw") for name in ("bumble", "queen")]
    notes.append(png_note(GREY, 1, "/queen/image_raw/compressed"))
    path = write_bag(tmp_path, "mcap", notes)
    for wanted, found in (("/bumble", "/bumble"), ("queen", "/queen"), ("/queen/image_raw", "/queen")):
        with open_camera(f"bag:{path}?topic={wanted}") as camera:
            # The raw pictures, where the compressed ones are the same.
            assert camera.grab().source.endswith(f"{found}/image_raw#0")
    with pytest.raises(ConfigError, match="several topics of images"):
        open_camera(f"bag:{path}?topic=image_raw")


def lens(fx: float = 500.0) -> Lens:
    return Lens("plumb_bob", 4, 3, np.array([fx, 500.0, 2.0, 1.5, 0.1, 0.0, 0.0, 0.0, 0.0]))


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_the_lens_comes_from_the_camera_info_beside_the_pictures(tmp_path, kind):
    other = camera_info_note(lens(900.0), 1, "/other/camera_info")
    notes = [other, camera_info_note(lens(), 1), image_note(GREY, 1), camera_info_note(lens(), 2), image_note(GREY, 2)]
    path = write_bag(tmp_path, kind, notes)
    with open_camera(str(path)) as camera:
        found = camera.camera_info()
        np.testing.assert_array_equal(found.lens.parameters, lens().parameters)
        assert found.covariance is None
        assert len(list(camera)) == 2
    with open_camera(f"bag:{path}?info=/other/camera_info") as camera:
        assert camera.camera_info().lens.fx_px == 900.0
    with pytest.raises(ConfigError, match="no CameraInfo '/nowhere', expected one of: /"):
        open_camera(f"bag:{path}?info=/nowhere")
    # A lens that is set anew on the way makes all poses after it wrong.
    path = write_bag(tmp_path, kind, [*notes, camera_info_note(lens(510.0), 3), image_note(GREY, 3)])
    with open_camera(f"bag:{path}") as camera:
        camera.camera_info()
        with pytest.raises(CaptureError, match="/cam/camera_info: changes after 2 images"):
            list(camera)
    with open_camera(f"bag:{path}") as camera:
        # Nobody asked for it, so it does not matter.
        assert len(list(camera)) == 3
    never = camera_info_note(lens(), 1, k=np.zeros(9))
    with (
        open_camera(f"bag:{write_bag(tmp_path, kind, [never, image_note(GREY, 1)])}") as camera,
        pytest.raises(CaptureError, match="never calibrated"),
    ):
        camera.camera_info()
    with open_camera(f"bag:{write_bag(tmp_path, kind, [image_note(GREY, 1)])}") as camera:
        assert camera.camera_info() is None


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
