"""Which topic is meant, and which ``CameraInfo`` belongs to it."""

from __future__ import annotations

import pytest

from uvgs_bench.errors import ConfigError, FormatError
from uvgs_bench.interop.bag_topics import (
    CAMERA_INFO,
    COMPRESSED,
    RAW,
    camera_info_topic,
    choose_image_topic,
    is_rectified,
)

TYPES = {
    "/bumble/hw/cam_nav": RAW,
    "/bumble/hw/cam_sci/compressed": COMPRESSED,
    "/bumble/hw/cam_sci_info": CAMERA_INFO,
    "/front/image_rect": RAW,
    "/front/image_rect/compressed": COMPRESSED,
    "/front/image_rect/compressedDepth": COMPRESSED,
    "/front/camera_info": CAMERA_INFO,
    "/back/image_raw": RAW,
    "/back/image_raw/camera_info": CAMERA_INFO,
    "/never": RAW,
    "/imu": "sensor_msgs/msg/Imu",
}
COUNTS = dict.fromkeys(TYPES, 5) | {"/never": 0}


@pytest.mark.parametrize(
    ("wanted", "found"),
    [
        ("/bumble/hw/cam_nav", "/bumble/hw/cam_nav"),
        ("cam_nav", "/bumble/hw/cam_nav"),
        ("/front", "/front/image_rect"),
        ("front", "/front/image_rect"),
        ("/front/image_rect/compressed", "/front/image_rect/compressed"),
        ("image_raw", "/back/image_raw"),
    ],
)
def test_a_topic_its_end_or_its_namespace(wanted, found):
    assert choose_image_topic(TYPES, COUNTS, wanted, "a.bag") == found


@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        ("", "several topics of images, choose one: /back/image_raw, /bumble/hw/cam_nav,"),
        ("/bumble", "choose one: /bumble/hw/cam_nav, /bumble/hw/cam_sci/compressed"),
        ("/never", "no topic '/never' of images"),
        ("/imu", "no topic '/imu' of images"),
        ("/front/image_rec", "did you mean '/front/image_rect'"),
        ("ront/image_rect", "no topic 'ront/image_rect'"),
    ],
)
def test_what_is_not_clear_is_asked(wanted, said):
    with pytest.raises(ConfigError, match=said):
        choose_image_topic(TYPES, COUNTS, wanted, "a.bag")
    with pytest.raises(FormatError, match="holds no images, only sensor_msgs/msg/Imu"):
        choose_image_topic({"/imu": "sensor_msgs/msg/Imu"}, {"/imu": 1}, wanted, "a.bag")


@pytest.mark.parametrize(
    ("topic", "info"),
    [
        ("/bumble/hw/cam_sci/compressed", "/bumble/hw/cam_sci_info"),
        ("/front/image_rect/compressed", "/front/camera_info"),
        ("/back/image_raw", "/back/image_raw/camera_info"),
        ("/bumble/hw/cam_nav", None),
    ],
)
def test_the_camera_info_of_the_same_namespace_only(topic, info):
    assert camera_info_topic(TYPES, COUNTS, topic) == info


def test_rectified_pictures_are_told_by_their_name():
    assert is_rectified("/front/image_rect")
    assert is_rectified("/front/image_rect_color/compressed")
    assert not is_rectified("/image_rect/image_raw")
