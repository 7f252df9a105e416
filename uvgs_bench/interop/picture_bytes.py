"""The bytes of a picture file as pixels: PNG, JPEG and what else OpenCV reads; torn ones are refused, not filled."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uvgs_bench.errors import FormatError

if TYPE_CHECKING:
    from uvgs_bench.sensor.capture import ImageArray


def decode_picture(payload: bytes, source: str = "") -> ImageArray:
    """Decode the bytes of a picture file as it is: mono (H, W) or BGR (H, W, 3), uint8 or uint16.

    Args:
        payload: The bytes.
        source: Where they come from, for messages.

    Returns:
        The pixels; transparency is dropped.

    Raises:
        FormatError: They are unreadable, truncated, or of another depth.
    """
    import cv2

    if truncation := _truncation(payload):
        raise FormatError(f"is truncated: {truncation}", source)
    try:
        image = cv2.imdecode(np.frombuffer(payload, dtype=np.uint8), cv2.IMREAD_UNCHANGED) if payload else None
    except cv2.error:
        image = None
    if image is None:
        raise FormatError("is no readable picture" if payload else "is an empty file", source)
    if image.dtype not in (np.uint8, np.uint16):
        raise FormatError(f"has pixels of type {image.dtype}, expected 8 or 16 bit", source)
    if image.ndim == 3:
        channels = image.shape[2]
        image = image[:, :, 0] if channels in (1, 2) else image[:, :, :3]
    pixels: ImageArray = np.ascontiguousarray(image)
    return pixels


def _truncation(payload: bytes) -> str:
    """Why a file ends too early, or empty. Decoders fill the missing part with grey without a word.

    In JPEG data no marker can occur by chance, so the last end marker must follow the last start of a scan.
    """
    if payload.startswith(b"\xff\xd8"):
        if payload.rfind(b"\xff\xd9") < payload.rfind(b"\xff\xda") or b"\xff\xda" not in payload:
            return "the JPEG end marker is missing"
    elif payload.startswith(b"\x89PNG"):
        if b"IEND" not in payload[-64:]:
            return "the PNG end chunk is missing"
    elif payload.startswith(b"BM") and len(payload) >= 6:
        said = int.from_bytes(payload[2:6], "little")
        if len(payload) < said:
            return f"{len(payload)} bytes of {said}"
    return ""
