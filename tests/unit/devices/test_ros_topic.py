"""Topics of a running ROS as cameras, and answers as messages, over a middleware that only exists in this file."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.devices.cameras import open_camera
from uvgs_bench.devices.cameras.source import CarriesCamera, FreeRunning, OwnClock
from uvgs_bench.devices.ros import ParameterValue, RosMessages, door
from uvgs_bench.errors import CaptureError, ConfigError
from uvgs_bench.interop.pose_messages import MessageMaker, ros_store
from uvgs_bench.interop.ros_messages import camera_info_from_lens, compressed_from_image, message_fields_from_image

pytestmark = pytest.mark.opencv
STAMP_NS = 12_000_000_345
RAW, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
COMPRESSED = "sensor_msgs/msg/CompressedImage"


class FakeDoor:
    """Delivers what was put on a topic as soon as somebody subscribes."""

    name = "/fake"

    def __init__(self, is_ros1: bool, kinds: Mapping[str, str]) -> None:
        self.is_ros1 = is_ros1
        self.is_alive = True
        self.kinds = dict(kinds)
        self.kept: dict[str, list[bytes]] = {}
        self.published: list[tuple[str, str, bytes]] = []
        self.takers: dict[str, Callable[[bytes], None]] = {}

    def now_ns(self) -> int:
        return STAMP_NS + 5_000_000

    def topics(self) -> dict[str, str]:
        return dict(self.kinds)

    def subscribe(self, topic: str, _msgtype: str, take: Callable[[bytes], None]) -> Callable[[], None]:
        self.takers[topic] = take
        for payload in self.kept.get(topic, []):
            take(payload)
        return lambda: None

    def publish(self, topic: str, msgtype: str, payload: bytes, definition: str) -> None:
        assert bool(definition) == self.is_ros1
        self.published.append((topic, msgtype, payload))

    def offer_parameters(
        self, values: Mapping[str, ParameterValue], check: Callable[[dict[str, ParameterValue]], str | None]
    ) -> None:
        raise NotImplementedError

    def warn(self, text: str) -> None:
        raise NotImplementedError

    def close(self) -> None:
        self.is_alive = False


@pytest.fixture(params=["ros1", "ros2"])
def fake(request, monkeypatch) -> tuple[str, FakeDoor, MessageMaker, Callable[[object], bytes]]:
    is_ros1 = request.param == "ros1"
    made = FakeDoor(is_ros1, {"/cam/image_raw": RAW, "/cam/camera_info": INFO, "/odom": "nav_msgs/msg/Odometry"})
    monkeypatch.setitem(door._open, request.param, made)
    store = ros_store(is_ros1=is_ros1)

    def packed(message: object) -> bytes:
        write = store.serialize_ros1 if is_ros1 else store.serialize_cdr
        return bytes(write(message, message.__msgtype__))  # type: ignore[attr-defined]

    return request.param, made, MessageMaker(store, is_ros1=is_ros1), packed


def test_pictures_and_lens_of_a_topic(fake) -> None:
    version, made, make, packed = fake
    image = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32)
    made.kept["/cam/image_raw"] = [packed(make.image(STAMP_NS, message_fields_from_image(image)))]
    made.kept["/cam/camera_info"] = [packed(make.camera_info(STAMP_NS, camera_info_from_lens(spots.lens())))]
    with open_camera(f"{version}:") as camera:
        assert isinstance(camera, FreeRunning)
        assert isinstance(camera, OwnClock)
        assert isinstance(camera, CarriesCamera)
        capture = camera.next_capture()
        assert np.array_equal(capture.image, image)
        assert (capture.t_ns, capture.source, capture.index) == (STAMP_NS, "/cam/image_raw", 0)
        assert camera.now_ns() - capture.t_ns == 5_000_000
        calibration = camera.camera_info()
    assert calibration is not None
    assert np.array_equal(calibration.lens.parameters, spots.lens().parameters)


def test_a_compressed_topic(fake) -> None:
    version, made, make, packed = fake
    made.kinds = {"/a/image_raw/compressed": COMPRESSED}
    image = np.arange(20 * 30, dtype=np.uint8).reshape(20, 30)
    message = make.compressed(STAMP_NS, *compressed_from_image(image, "png"))
    made.kept["/a/image_raw/compressed"] = [packed(message)]
    camera = open_camera(f"{version}:/a/image_raw/compressed")
    assert np.array_equal(camera.next_capture().image, image)  # type: ignore[attr-defined]
    assert camera.camera_info() is None  # type: ignore[attr-defined]


def test_the_newest_pictures_wait(fake) -> None:
    version, made, make, packed = fake
    camera = open_camera(f"{version}:/cam/image_raw")
    image = message_fields_from_image(np.zeros((4, 4), dtype=np.uint8))
    for k in range(5):
        made.takers["/cam/image_raw"](packed(make.image(STAMP_NS + k, image)))
    assert [camera.next_capture().t_ns - STAMP_NS for _ in range(2)] == [3, 4]  # type: ignore[attr-defined]


def test_what_is_wrong_with_a_topic(fake) -> None:
    version, made, _, _ = fake
    with pytest.raises(ConfigError, match="no topic '/odom' of images"):
        open_camera(f"{version}:/odom?wait_s=0.1")
    made.kinds |= {"/right/image_raw": RAW}
    with pytest.raises(ConfigError, match=r"/cam/image_raw, /right/image_raw"):
        open_camera(f"{version}:?wait_s=0.1")
    made.kinds = {"/odom": "nav_msgs/msg/Odometry"}
    with pytest.raises(CaptureError, match="holds no images, only nav_msgs/msg/Odometry"):
        open_camera(f"{version}:?wait_s=0.1")


def test_a_middleware_that_goes_away_ends_the_wait(fake) -> None:
    version, made, _, _ = fake
    camera = open_camera(f"{version}:/cam/image_raw")
    threading.Timer(0.1, made.close).start()
    with pytest.raises(CaptureError, match="ROS is gone"):
        camera.next_capture()  # type: ignore[attr-defined]


def test_messages_are_published_as_bags_have_them(fake) -> None:
    _, made, _, _ = fake
    messages = RosMessages(made, camera_frame="optical")
    messages.write(
        "/uvgs/camera_info", STAMP_NS, messages.make.camera_info(STAMP_NS, camera_info_from_lens(spots.lens()))
    )
    topic, kind, payload = made.published[0]
    assert (topic, kind) == ("/uvgs/camera_info", INFO)
    read = messages.read(kind, payload)
    assert read.header.frame_id == "optical"
    assert read.width == spots.lens().width_px
