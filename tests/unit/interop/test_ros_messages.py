"""Messages of pictures and cameras: every encoding, both ways, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.camera import Lens
from uvgs_bench.errors import FormatError
from uvgs_bench.interop.ros_messages import (
    ENCODINGS,
    Window,
    camera_info_from_lens,
    compressed_from_image,
    image_from_compressed,
    image_from_message,
    lens_from_camera_info,
    message_fields_from_image,
)

cv2 = pytest.importorskip("cv2")
pytestmark = pytest.mark.opencv
GREY = np.arange(24, dtype=np.uint8).reshape(4, 6) * 10
COLOUR = np.stack([GREY, GREY + 1, GREY + 2], axis=-1)
WIDE = GREY.astype(np.uint16) * 257


def rows(pixels: np.ndarray, padding: int = 0) -> tuple[int, bytes]:
    flat = np.ascontiguousarray(pixels).view(np.uint8).reshape(pixels.shape[0], -1)
    flat = np.pad(flat, ((0, 0), (0, padding)), constant_values=99)
    return flat.shape[1], flat.tobytes()


@pytest.mark.parametrize("padding", [0, 10])
@pytest.mark.parametrize(
    ("encoding", "sent", "expected", "big"),
    [
        ("mono8", GREY, GREY, 0),
        ("8UC1", GREY, GREY, 1),
        ("mono16", WIDE.astype("<u2"), WIDE, 0),
        ("16UC1", WIDE.astype(">u2"), WIDE, 1),
        ("bgr8", COLOUR, COLOUR, 0),
        ("8UC3", COLOUR, COLOUR, 0),
        ("rgb8", COLOUR[:, :, ::-1], COLOUR, 0),
        ("bgra8", np.dstack([COLOUR, GREY]), COLOUR, 0),
        ("8UC4", np.dstack([COLOUR, GREY]), COLOUR, 0),
        ("rgba8", np.dstack([COLOUR[:, :, ::-1], GREY]), COLOUR, 0),
        ("rgb16", (COLOUR[:, :, ::-1].astype(np.uint16) * 257).astype(">u2"), COLOUR.astype(np.uint16) * 257, 1),
    ],
)
def test_pixels_of_plain_encodings(encoding, sent, expected, big, padding):
    step, data = rows(sent, padding)
    for given in (data, np.frombuffer(data, dtype=np.uint8)):
        read = image_from_message(encoding, 6, 4, step, big, given)
        np.testing.assert_array_equal(read.image, expected)
        assert read.image.dtype == expected.dtype
        assert read.image.flags.writeable
        assert read.image.flags.c_contiguous
        assert read.bayer is None


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "grbg", "gbrg"])
@pytest.mark.parametrize("bits", [8, 16])
def test_a_mosaic_shows_each_colour_where_its_pattern_says(pattern, bits):
    # One colour alone is lit: after development every pixel has that colour and no other.
    for channel, letter in enumerate("bgr"):
        mask = np.array([[letter == cell for cell in pattern[:2]], [letter == cell for cell in pattern[2:]]])
        mosaic = (np.tile(mask, (4, 4)) * 200).astype(f"uint{bits}")
        step, data = rows(mosaic)
        read = image_from_message(f"bayer_{pattern}{bits}", 8, 8, step, 0, data)
        assert read.bayer == pattern
        assert (read.image[2:-2, 2:-2, channel] == 200).all()
        assert read.image.sum() == read.image[:, :, channel].sum()


@pytest.mark.parametrize(("encoding", "luma"), [("yuv422", 1), ("uyvy", 1), ("yuv422_yuy2", 0), ("yuyv", 0)])
def test_yuv_keeps_the_brightness_of_every_pixel(encoding, luma):
    packed = np.full((4, 6, 2), 128, dtype=np.uint8)
    bright = 16 + GREY // 2
    packed[:, :, luma] = bright
    read = image_from_message(encoding, 6, 4, 12, 0, packed.tobytes())
    # ITU-R BT.601: 16 is black and 235 is white; a grey value may be rounded by 1.
    expected = (bright.astype(float) - 16.0) * 255.0 / 219.0
    assert np.abs(read.image - expected[:, :, None]).max() <= 1.0


def test_red_is_red_in_yuv():
    # ITU-R BT.601 studio range: pure red is Y 81, U 90, V 240.
    uyvy = np.tile(np.array([90, 81, 240, 81], dtype=np.uint8), 6)
    blue, green, red = image_from_message("yuv422", 6, 2, 12, 0, uyvy.tobytes()).image[0, 0].astype(int)
    assert red > 250
    assert max(blue, green) < 5


def test_all_encodings_are_read_by_their_names():
    for encoding in ENCODINGS:
        assert image_from_message(encoding, 2, 2, 64, 0, bytes(128)).image.shape[:2] == (2, 2)


@pytest.mark.parametrize(
    ("encoding", "width", "height", "step", "said"),
    [
        ("32FC1", 2, 2, 8, "has encoding '32FC1', expected one of mono8"),
        ("mono8", 4, 7, 4, "4x7 px of mono8 in rows of 4 bytes, but holds 16 bytes"),
        ("mono16", 4, 4, 4, "rows of 4 bytes"),
        ("mono8", 0, 4, 4, "0x4 px"),
        ("bayer_rggb8", 3, 4, 4, "even sides"),
        ("yuv422", 1, 4, 4, "even sides"),
    ],
)
def test_what_cannot_be_an_image_is_refused(encoding, width, height, step, said):
    with pytest.raises(FormatError, match=said):
        image_from_message(encoding, width, height, step, 0, bytes(16), "a.bag/cam#3")


@pytest.mark.parametrize("image", [GREY, WIDE, COLOUR, COLOUR.astype(np.uint16) * 257])
def test_a_picture_goes_into_a_message_and_back_unchanged(image):
    fields = message_fields_from_image(image)
    back = image_from_message(
        fields.encoding, fields.width, fields.height, fields.step, fields.is_bigendian, fields.data
    )
    np.testing.assert_array_equal(back.image, image)
    image_format, data = compressed_from_image(image)
    np.testing.assert_array_equal(image_from_compressed(image_format, data).image, image)
    with pytest.raises(FormatError, match="expected mono or BGR"):
        message_fields_from_image(image.astype(np.float32))


def test_compressed_formats_as_image_transport_writes_them():
    payload = cv2.imencode(".png", COLOUR)[1].ravel()
    for image_format in ("png", "bgr8; png compressed bgr8", "rgb8; png compressed bgr8", ""):
        np.testing.assert_array_equal(image_from_compressed(image_format, payload).image, COLOUR)
    swapped = image_from_compressed("rgb8; png compressed rgb8", payload).image
    np.testing.assert_array_equal(swapped, COLOUR[:, :, ::-1])
    mosaic = cv2.imencode(".png", GREY)[1].tobytes()
    assert image_from_compressed("bayer_rggb8; png compressed ", mosaic).bayer == "rggb"
    with pytest.raises(FormatError, match="depth image"):
        image_from_compressed("16UC1; compressedDepth", payload)
    with pytest.raises(FormatError, match="truncated"):
        image_from_compressed("png", payload[:50])
    with pytest.raises(FormatError, match="expected png, or jpeg of 8 bit"):
        compressed_from_image(WIDE, "jpeg")
    jpeg_format, jpeg = compressed_from_image(GREY, "jpeg")
    assert jpeg_format == "mono8; jpeg compressed "
    assert image_from_compressed(jpeg_format, jpeg).image.shape == GREY.shape


def lens(model: str = "plumb_bob", coefficients=(-0.1, 0.02, 1e-4, -2e-4, 0.003)) -> Lens:
    return Lens(model, 640, 480, np.array([500.0, 510.0, 321.5, 238.25, *coefficients]))


@pytest.mark.parametrize(
    "given",
    [
        lens(),
        lens("rational_polynomial", np.arange(8) / 100),
        lens("thin_prism", np.arange(12) / 1000),
        lens("equidistant", (0.01, 0.002, 0.0, 0.0)),
        lens("equidistant", (0.0, 0.0, 0.0, 0.0)),
        lens("fov", (0.98,)),
    ],
)
def test_a_lens_goes_into_a_message_and_back_unchanged(given):
    fields = camera_info_from_lens(given)
    back = lens_from_camera_info(fields.width, fields.height, fields.distortion_model, fields.d, fields.k, fields.p)
    assert (back.lens.model, back.lens.width_px, back.lens.height_px) == (given.model, 640, 480)
    np.testing.assert_array_equal(back.lens.parameters, given.parameters)
    # A message has no place for it, so nothing may be claimed.
    assert back.covariance is None
    assert back.rms_px is None


def test_binning_and_region_move_the_lens_with_the_pixels():
    fields = camera_info_from_lens(lens())
    whole = lens_from_camera_info(640, 480, "plumb_bob", fields.d, fields.k).lens
    window = Window(2, 2, x_offset=100, y_offset=40, width=400, height=300)
    part = lens_from_camera_info(640, 480, "plumb_bob", fields.d, fields.k, window=window).lens
    assert (part.width_px, part.height_px) == (200, 150)
    points = np.array([[0.1, -0.05, 1.0], [-0.2, 0.1, 1.5]])
    # A pixel of the part covers two by two of the whole: its centre lies between theirs.
    back = (part.project(points) + 0.5) * 2.0 - 0.5 + np.array([100.0, 40.0])
    np.testing.assert_allclose(back, whole.project(points), atol=1e-9)  # px, rounding only
    same = lens_from_camera_info(640, 480, "plumb_bob", fields.d, fields.k, window=Window(0, 0)).lens
    np.testing.assert_array_equal(same.parameters, whole.parameters)


def test_rectified_pictures_have_the_lens_of_p():
    fields = camera_info_from_lens(lens())
    p = (450.0, 0.0, 300.0, 0.0, 0.0, 460.0, 200.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    rectified = lens_from_camera_info(640, 480, "plumb_bob", fields.d, fields.k, p, is_rectified=True).lens
    assert rectified.parameters.tolist() == [450.0, 460.0, 300.0, 200.0, 0.0, 0.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"k": [0.0] * 9}, "K is zero: this camera was never calibrated"),
        ({"k": [1.0] * 4}, "K has 4 numbers, expected 9"),
        ({"k": [500.0, 1.0, 3.0, 0.0, 500.0, 2.0, 0.0, 0.0, 1.0]}, "without skew"),
        ({"distortion_model": "omni"}, "'omni' with 5 coefficients is no lens here"),
        ({"d": [0.1] * 3}, "'plumb_bob' with 3 coefficients"),
        ({"width": 0}, "picture"),
        ({"is_rectified": True, "p": ()}, "P has 0 numbers, expected 12"),
    ],
)
def test_what_cannot_be_a_lens_is_refused(change, said):
    fields = camera_info_from_lens(lens())
    given = {"width": 640, "height": 480, "distortion_model": "plumb_bob", "d": fields.d, "k": fields.k} | change
    with pytest.raises(FormatError, match=said):
        lens_from_camera_info(**given, source="/cam/camera_info")
