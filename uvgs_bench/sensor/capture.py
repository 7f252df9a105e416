"""What a camera hands to the sensor: one image with its instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ImageArray = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """An image with its instant.

    Args:
        image: Mono (H, W) or BGR (H, W, 3), uint8 or uint16.
        t_ns: Instant of mid-exposure on the source's clock, ns.
        source: Where it comes from: file name, topic or device; for people.
        index: Running number within the source.
        exposure_s: Exposure time, s, or None when unknown.

    Raises:
        ValueError: The image has another shape or type, or no pixels.
    """

    image: ImageArray
    t_ns: int
    source: str = ""
    index: int = 0
    exposure_s: float | None = None

    def __post_init__(self) -> None:
        image = self.image
        is_shaped = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
        if not is_shaped or image.dtype not in (np.uint8, np.uint16) or image.size == 0:
            raise ValueError(
                f"expected a mono (H, W) or BGR (H, W, 3) image of uint8 or uint16, got {image.shape} {image.dtype}"
            )

    @property
    def width_px(self) -> int:
        """Image width, px."""
        return int(self.image.shape[1])

    @property
    def height_px(self) -> int:
        """Image height, px."""
        return int(self.image.shape[0])
