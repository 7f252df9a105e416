"""ROS messages of pictures and cameras as plain values: ``Image``, ``CompressedImage``, ``CameraInfo``, both ways.

Nothing here needs ROS or a bag: the fields of a message go in, arrays and lenses come out, and back. The same code
serves bags, nodes and recordings. Pixels are never scaled. What ROS names by its encodings:

- ``yuv422`` and ``uyvy`` are U Y V Y, ``yuv422_yuy2`` and ``yuyv`` are Y U Y V; brightness has every pixel, colour
  every second one of a row. They become BGR by ITU-R BT.601 with studio range, as in ROS.
- ``bayer_*`` mosaics become BGR (``sensor.mosaic.develop``) and keep their pattern as a tag, because a centroid of made
  up colours is less sure.
- A ``CompressedImage`` whose format names a colour encoding but not ``compressed bgr`` has red and blue exchanged,
  as ROS's own subscriber takes it.

Source: sensor_msgs/Image, CompressedImage and CameraInfo; image_encodings; image_transport's compressed plug-in.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uvgs_bench.camera import LENSES, Lens
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.errors import CalibrationError, FormatError
from uvgs_bench.interop.picture_bytes import decode_picture
from uvgs_bench.sensor.capture import BayerPattern, ImageArray

# By encoding: bytes of a channel, channels, and whether red comes first.
_PLAIN: dict[str, tuple[int, int, bool]] = {
    "mono8": (1, 1, False),
    "mono16": (2, 1, False),
    "8UC1": (1, 1, False),
    "16UC1": (2, 1, False),
    "bgr8": (1, 3, False),
    "rgb8": (1, 3, True),
    "bgra8": (1, 4, False),
    "rgba8": (1, 4, True),
    "8UC3": (1, 3, False),
    "8UC4": (1, 4, False),
    "bgr16": (2, 3, False),
    "rgb16": (2, 3, True),
    "bgra16": (2, 4, False),
    "rgba16": (2, 4, True),
    "16UC3": (2, 3, False),
    "16UC4": (2, 4, False),
}
_BAYER: dict[str, tuple[int, BayerPattern]] = {
    "bayer_rggb8": (1, "rggb"),
    "bayer_bggr8": (1, "bggr"),
    "bayer_grbg8": (1, "grbg"),
    "bayer_gbrg8": (1, "gbrg"),
    "bayer_rggb16": (2, "rggb"),
    "bayer_bggr16": (2, "bggr"),
    "bayer_grbg16": (2, "grbg"),
    "bayer_gbrg16": (2, "gbrg"),
}
_YUV: dict[str, str] = {
    "yuv422": "COLOR_YUV2BGR_UYVY",
    "uyvy": "COLOR_YUV2BGR_UYVY",
    "yuv422_yuy2": "COLOR_YUV2BGR_YUY2",
    "yuyv": "COLOR_YUV2BGR_YUY2",
}
ENCODINGS: tuple[str, ...] = (*_PLAIN, *_BAYER, *_YUV)
"""Encodings of raw images that can be read."""

# Lens by the name in ``distortion_model`` and the number of coefficients.
CAMERA_INFO_MODELS: dict[str, dict[int, str]] = {
    "plumb_bob": {4: "plumb_bob", 5: "plumb_bob"},
    # ROS's own writer labels every list longer than five ``rational_polynomial``.
    "rational_polynomial": {8: "rational_polynomial", 12: "thin_prism"},
    "thin_prism": {12: "thin_prism"},
    "equidistant": {4: "equidistant"},
    "fisheye": {4: "equidistant"},
    "fov": {1: "fov"},
}


@dataclass(frozen=True, slots=True, eq=False)
class MessageImage:
    """The picture of a message.

    Args:
        image: Mono (H, W) or BGR (H, W, 3), uint8 or uint16; writeable and its own.
        bayer: Pattern of the mosaic it was developed from, or None.
    """

    image: ImageArray
    bayer: BayerPattern | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ImageFields:
    """The fields of a ``sensor_msgs/Image`` besides its header.

    Args:
        height: Rows.
        width: Columns.
        encoding: ROS's name of the layout.
        is_bigendian: 1 when values of 16 bit have their high byte first, else 0.
        step: Bytes of a row.
        data: The rows one after the other, shape (height * step,), uint8.
    """

    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class CameraInfoFields:
    """The fields of a ``sensor_msgs/CameraInfo`` besides its header; ROS 1 writes D, K, R, P in capitals.

    Args:
        height: Rows of the picture.
        width: Columns of the picture.
        distortion_model: Name of the lens.
        d: Coefficients.
        k: Camera matrix, 9 numbers row by row.
        r: Rectification, 9 numbers; identity, because nothing is rectified here.
        p: Projection matrix, 12 numbers; that of ``k``.
    """

    height: int
    width: int
    distortion_model: str
    d: tuple[float, ...]
    k: tuple[float, ...]
    r: tuple[float, ...]
    p: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Window:
    """The part of the sensor a camera reads out, as ``binning_x``, ``binning_y`` and ``roi`` of CameraInfo say it.

    Args:
        binning_x: Columns joined into one; 0 means 1.
        binning_y: Rows joined into one; 0 means 1.
        x_offset: First column of the region, in pixels of the whole sensor.
        y_offset: First row of the region.
        width: Columns of the region; 0 means all.
        height: Rows of the region; 0 means all.
    """

    binning_x: int = 1
    binning_y: int = 1
    x_offset: int = 0
    y_offset: int = 0
    width: int = 0
    height: int = 0


def image_from_message(
    encoding: str,
    width: int,
    height: int,
    step: int,
    is_bigendian: bool | int,
    data: ArrayLike | bytes,
    source: str = "",
) -> MessageImage:
    """The pixels of a ``sensor_msgs/Image``.

    Args:
        encoding: One of ``ENCODINGS``.
        width: Columns.
        height: Rows.
        step: Bytes of a row, padding included.
        is_bigendian: Whether values of 16 bit have their high byte first.
        data: The bytes: ``bytes``, or an array of uint8.
        source: What the message is, for errors.

    Returns:
        The picture; transparency is dropped.

    Raises:
        FormatError: The encoding is unknown, or the bytes are fewer than size and step say.
    """
    raw = np.frombuffer(data, dtype=np.uint8) if isinstance(data, bytes) else np.asarray(data, dtype=np.uint8).ravel()
    if encoding in _PLAIN:
        size, channels, is_red_first = _PLAIN[encoding]
    elif encoding in _BAYER:
        size, channels, is_red_first = _BAYER[encoding][0], 1, False
    elif encoding in _YUV:
        size, channels, is_red_first = 1, 2, False
    else:
        raise FormatError(f"has encoding {encoding!r}, expected one of {', '.join(ENCODINGS)}", source)
    used = width * channels * size
    if width < 1 or height < 1 or step < used or raw.size < height * step:
        said = f"{width}x{height} px of {encoding} in rows of {step} bytes"
        raise FormatError(f"says {said}, but holds {raw.size} bytes", source)
    if (encoding in _BAYER and (width % 2 or height % 2)) or (encoding in _YUV and width % 2):
        raise FormatError(f"is {width}x{height} px, but {encoding} has even sides", source)
    # A copy even where none is needed for the layout: messages lend their bytes read-only.
    rows = raw[: height * step].reshape(height, step)[:, :used].copy()
    values: Any = rows
    if size == 2:
        values = rows.view(np.dtype(">u2" if is_bigendian else "<u2")).astype(np.uint16, copy=False)
    if encoding in _BAYER:
        from uvgs_bench.sensor.mosaic import develop

        pattern = _BAYER[encoding][1]
        return MessageImage(develop(values, pattern), pattern)
    if encoding in _YUV:
        import cv2

        return MessageImage(cv2.cvtColor(values.reshape(height, width, 2), getattr(cv2, _YUV[encoding])))
    if channels == 1:
        return MessageImage(values)
    pixels = values.reshape(height, width, channels)
    pixels = pixels[:, :, 2::-1] if is_red_first else pixels[:, :, :3]
    return MessageImage(np.ascontiguousarray(pixels))


def message_fields_from_image(image: ImageArray) -> ImageFields:
    """A picture as the fields of a ``sensor_msgs/Image``, without loss.

    Args:
        image: Mono (H, W) or BGR (H, W, 3), uint8 or uint16.

    Returns:
        The fields; ``mono8``, ``mono16``, ``bgr8`` or ``bgr16`` in the byte order of this machine.

    Raises:
        FormatError: The array is no such picture.
    """
    is_shaped = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if not is_shaped or image.dtype not in (np.uint8, np.uint16) or image.size == 0:
        raise FormatError(f"expected mono or BGR pixels of 8 or 16 bit, got {image.shape} {image.dtype}")
    height, width = image.shape[:2]
    encoding = f"{'mono' if image.ndim == 2 else 'bgr'}{8 * image.dtype.itemsize}"
    step = width * image.dtype.itemsize * (1 if image.ndim == 2 else 3)
    is_big = int(image.dtype.itemsize == 2 and sys.byteorder == "big")
    return ImageFields(height, width, encoding, is_big, step, np.ascontiguousarray(image).view(np.uint8).ravel())


def image_from_compressed(image_format: str, data: ArrayLike | bytes, source: str = "") -> MessageImage:
    """The pixels of a ``sensor_msgs/CompressedImage``.

    Args:
        image_format: Its ``format``, such as ``png`` or ``bgr8; jpeg compressed bgr8``.
        data: The bytes of the picture file: ``bytes``, or an array of uint8.
        source: What the message is, for errors.

    Returns:
        The picture.

    Raises:
        FormatError: It is a depth image, or no readable picture of 8 or 16 bit.
    """
    encoding, _, how = (part.strip() for part in image_format.partition(";"))
    if "compressedDepth" in image_format:
        raise FormatError(f"is a depth image ('{image_format}'), expected a picture", source)
    payload = data if isinstance(data, bytes) else np.asarray(data, dtype=np.uint8).tobytes()
    image = decode_picture(payload, source)
    if encoding in _BAYER and image.ndim == 2:
        from uvgs_bench.sensor.mosaic import develop

        if image.shape[0] % 2 or image.shape[1] % 2:
            raise FormatError(f"is {image.shape[1]}x{image.shape[0]} px, but {encoding} has even sides", source)
        pattern = _BAYER[encoding][1]
        return MessageImage(develop(image, pattern), pattern)
    is_colour = encoding in _PLAIN and _PLAIN[encoding][1] >= 3 and "UC" not in encoding
    if how and image.ndim == 3 and is_colour and "compressed bgr" not in how:
        image = cast("ImageArray", np.ascontiguousarray(image[:, :, ::-1]))
    return MessageImage(image)


def compressed_from_image(image: ImageArray, kind: str = "png") -> tuple[str, NDArray[np.uint8]]:
    """A picture as ``format`` and ``data`` of a ``sensor_msgs/CompressedImage``.

    Args:
        image: Mono (H, W) or BGR (H, W, 3), uint8 or uint16.
        kind: ``png`` (without loss) or ``jpeg`` (8 bit, quality 95).

    Returns:
        The format as image_transport writes it, and the bytes, uint8.

    Raises:
        FormatError: The kind is unknown, or has no place for 16 bit.
    """
    import cv2

    if kind not in ("png", "jpeg") or (kind == "jpeg" and image.dtype != np.uint8):
        raise FormatError(f"cannot compress pixels of {image.dtype} as {kind}, expected png, or jpeg of 8 bit")
    fields = message_fields_from_image(image)
    # Level 1 costs a third of the time of the default, for files a tenth larger.
    options = [cv2.IMWRITE_PNG_COMPRESSION, 1] if kind == "png" else [cv2.IMWRITE_JPEG_QUALITY, 95]
    _, payload = cv2.imencode(f".{kind}", image, options)
    target = fields.encoding if image.ndim == 3 else ""
    return f"{fields.encoding}; {kind} compressed {target}", payload.ravel()


def lens_from_camera_info(
    width: int,
    height: int,
    distortion_model: str,
    d: Sequence[float] | NDArray[np.float64],
    k: Sequence[float] | NDArray[np.float64],
    p: Sequence[float] | NDArray[np.float64] = (),
    window: Window | None = None,
    *,
    is_rectified: bool = False,
    source: str = "camera_info",
) -> Calibration:
    """The lens a ``sensor_msgs/CameraInfo`` says.

    Binning joins whole pixels, so a pixel q of the sensor becomes (q + 0.5) / b - 0.5, not q / b.

    Args:
        width: Columns of the sensor.
        height: Rows of the sensor.
        distortion_model: Name of the model; empty with no coefficients is a lens without distortion.
        d: Coefficients.
        k: Camera matrix, 9 numbers row by row.
        p: Projection matrix, 12 numbers row by row; needed where ``is_rectified``.
        window: Binning and region, None for the whole sensor.
        is_rectified: The pictures are rectified ones (topic ``image_rect``): their lens is P, without distortion.
        source: What the message is, for errors and as the camera's name.

    Returns:
        The calibration; how sure it is, is unknown.

    Raises:
        FormatError: The camera is uncalibrated, or the numbers are none of a known lens.
    """
    numbers = [float(value) for value in d]
    matrix = np.asarray(p if is_rectified else k, dtype=np.float64).ravel()
    name, columns = ("P", 4) if is_rectified else ("K", 3)
    if matrix.size != 3 * columns:
        raise FormatError(f"{name} has {matrix.size} numbers, expected {3 * columns}", source)
    K = matrix.reshape(3, columns)[:, :3]
    if K[0, 0] == 0.0:
        raise FormatError(f"{name} is zero: this camera was never calibrated", source)
    if K[0, 1] != 0.0 or K[1, 0] != 0.0 or K[2].tolist() != [0.0, 0.0, 1.0]:
        raise FormatError(f"{name}: expected [fx 0 cx, 0 fy cy, 0 0 1] without skew, got {K.ravel().tolist()}", source)
    if is_rectified or not any(numbers):
        # Names of models vary for "no distortion"; all of them with zero coefficients but the fish-eyes are one map.
        is_wide = not is_rectified and distortion_model in ("equidistant", "fisheye", "fov")
        distortion_model, numbers = (distortion_model, numbers) if is_wide else ("plumb_bob", [0.0] * 5)
    model = CAMERA_INFO_MODELS.get(distortion_model, {}).get(len(numbers))
    if model is None:
        known = ", ".join(f"{name} ({' or '.join(map(str, sizes))})" for name, sizes in CAMERA_INFO_MODELS.items())
        raise FormatError(
            f"'{distortion_model}' with {len(numbers)} coefficients is no lens here, one of {known}", source
        )
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    if window is not None:
        x, y = max(window.binning_x, 1), max(window.binning_y, 1)
        fx, fy = fx / x, fy / y
        cx, cy = (cx - window.x_offset + 0.5) / x - 0.5, (cy - window.y_offset + 0.5) / y - 0.5
        width, height = (window.width or width) // x, (window.height or height) // y
    missing = len(LENSES[model].coefficient_names) - len(numbers)
    parameters = np.array([fx, fy, cx, cy, *numbers, *[0.0] * missing])
    try:
        return Calibration(Lens(model, int(width), int(height), parameters), source)
    except CalibrationError as error:
        raise FormatError(str(error), source) from None


def calibration_from_message(message: Any, source: str, *, is_rectified: bool = False) -> Calibration:
    """The lens of a decoded ``sensor_msgs/CameraInfo`` of ROS 1 or ROS 2.

    Args:
        message: Its fields as attributes; D, K, P in capitals or not.
        source: What it is, for errors and as the camera's name.
        is_rectified: As in ``lens_from_camera_info``.

    Returns:
        The calibration; how sure it is, is unknown.

    Raises:
        FormatError: As ``lens_from_camera_info``.
    """
    try:
        d, k, p = (
            getattr(message, name) if hasattr(message, name) else getattr(message, name.upper()) for name in "dkp"
        )
        roi = message.roi
        sizes = (message.binning_x, message.binning_y, roi.x_offset, roi.y_offset, roi.width, roi.height)
        window = Window(*(int(value) for value in sizes))
        width, height = int(message.width), int(message.height)
    except AttributeError as error:
        raise FormatError(f"is no CameraInfo: {error}", source) from None
    return lens_from_camera_info(
        width, height, str(message.distortion_model), d, k, p, window, is_rectified=is_rectified, source=source
    )


def camera_info_from_lens(lens: Lens) -> CameraInfoFields:
    """A lens as the fields of a ``sensor_msgs/CameraInfo``, with the names calibration files have.

    Args:
        lens: The lens.

    Returns:
        The fields. ROS itself knows ``plumb_bob``, ``rational_polynomial`` and ``equidistant``.
    """
    K = lens.camera_matrix()
    P = np.column_stack([K, np.zeros(3)])
    coefficients: Any = lens.coefficients.tolist()
    return CameraInfoFields(
        lens.height_px,
        lens.width_px,
        lens.model,
        tuple(coefficients),
        tuple(K.ravel().tolist()),
        tuple(np.eye(3).ravel().tolist()),
        tuple(P.ravel().tolist()),
    )
