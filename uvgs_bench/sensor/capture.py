"""What a camera hands to the sensor: one image with its instant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

ImageArray = NDArray[np.uint8] | NDArray[np.uint16]
BayerPattern = Literal["rggb", "bggr", "grbg", "gbrg"]


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """An image with its instant.

    Args:
        image: Mono (H, W) or BGR (H, W, 3), uint8 or uint16.
        t_ns: Instant of mid-exposure on the source's clock, ns.
        source: Where it comes from: file name, topic or device; for people.
        index: Running number within the source.
        exposure_s: Exposure time, s, or None when unknown.
        bayer: Pattern of the colour mosaic a BGR image was made of (``mosaic.develop``), or None when every pixel saw
            every colour. A raw mosaic itself is refused: each of its pixels has another gain.
        full_scale_dn: Largest value a pixel can have, DN, for example 4095 of 12 bits in 16; None when unknown.

    Raises:
        ValueError: The image has another shape or type, no pixels, or is a raw mosaic; the full scale is not possible.
    """

    image: ImageArray
    t_ns: int
    source: str = ""
    index: int = 0
    exposure_s: float | None = None
    bayer: BayerPattern | None = None
    full_scale_dn: float | None = None

    def __post_init__(self) -> None:
        image = self.image
        is_shaped = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
        if not is_shaped or image.dtype not in (np.uint8, np.uint16) or image.size == 0:
            raise ValueError(
                f"expected a mono (H, W) or BGR (H, W, 3) image of uint8 or uint16, got {image.shape} {image.dtype}"
            )
        if self.bayer is not None and image.ndim == 2:
            raise ValueError(f"expected a BGR image made of the {self.bayer} mosaic, got the raw mosaic")
        full = self.full_scale_dn
        if full is not None and not 0.0 < full <= np.iinfo(image.dtype).max:
            raise ValueError(f"expected a full scale of {image.dtype} pixels, got {full} DN")

    @property
    def width_px(self) -> int:
        """Image width, px."""
        return int(self.image.shape[1])

    @property
    def height_px(self) -> int:
        """Image height, px."""
        return int(self.image.shape[0])
