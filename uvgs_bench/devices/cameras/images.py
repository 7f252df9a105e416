"""A folder of pictures as a camera."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np

from uvgs_bench.devices.cameras.base import ClosingSource
from uvgs_bench.devices.clock import Clock
from uvgs_bench.errors import CaptureError, ConfigError, FormatError
from uvgs_bench.sensor.capture import BayerPattern, Capture

if TYPE_CHECKING:
    from uvgs_bench.devices.cameras.spec import CameraSpec
    from uvgs_bench.interop.stamp_file import PictureStamp
    from uvgs_bench.sensor.capture import ImageArray

_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm"})

STEP_NS = 100_000_000
"""Pictures of a folder without ``stamps.csv`` are stamped this far apart in the order of their names."""


class ImageFolder(ClosingSource):
    """Pictures of a folder in natural order (``img2`` before ``img10``), mono or BGR, 8 or 16 bit, values untouched.

    Args:
        spec: The spec string, for messages.
        files: The pictures in order.
        bayer: Pattern of the colour mosaic that the pictures are, to be made into colour; None when they are none.
        bits: Bits of a pixel that the camera filled; None when all.
        stamps: Instant and former mosaic of each picture, or None when nothing says them.
    """

    def __init__(
        self,
        spec: str,
        files: list[Path],
        bayer: BayerPattern | None = None,
        bits: int | None = None,
        stamps: tuple[PictureStamp, ...] | None = None,
    ) -> None:
        super().__init__(spec, is_live=False, length=len(files))
        self._files = files
        self._bayer = bayer
        self._bits = bits
        self._stamps = stamps
        self._next = 0
        self._first: tuple[str, int, int] | None = None

    @classmethod
    def open(cls, spec: CameraSpec, _clock: Clock) -> ImageFolder:
        """Open ``images:FOLDER`` with the options ``glob``, ``bayer`` (``rggb bggr grbg gbrg``) and ``bits`` (8 to 16).

        A file ``stamps.csv`` in the folder says the instants, and the order with them.

        Raises:
            CaptureError: The folder is missing, no picture in it matches, or ``stamps.csv`` does not fit the pictures.
            ConfigError: An option is unknown or has no meaning, or the pattern leaves the folder.
        """
        spec.check_options(("glob", "bayer", "bits"))
        if not spec.target:
            raise ConfigError("name the folder, images:. for this one", spec.text)
        folder = Path(spec.target)
        if not folder.is_dir():
            problem = "is no folder" if folder.exists() else "no such folder"
            raise CaptureError(f"{problem}, expected a folder of pictures", spec.target)
        pattern = spec.options.get("glob", "*")
        try:
            found = list(folder.glob(pattern))
        except (ValueError, NotImplementedError):
            raise ConfigError(
                f"expected a pattern within the folder like glob=left*.png, got '{pattern}'", spec.text
            ) from None
        files = sorted(
            (path for path in found if path.suffix.lower() in _SUFFIXES and path.is_file()),
            key=lambda path: natural_key(path.name),
        )
        if not files:
            wanted = f"no picture matches '{pattern}'" if "glob" in spec.options else "holds no pictures"
            raise CaptureError(f"{wanted}, expected files ending in {' '.join(sorted(_SUFFIXES))}", spec.target)
        bayer, bits, stamps = _bayer_of(spec), _bits_of(spec), _stamps_of(folder, files)
        if stamps is not None:
            files = [folder / stamp.file for stamp in stamps]
        return cls(spec.text, files, bayer, bits, stamps)

    def grab(self) -> Capture | None:
        """The next picture, or None after the last.

        Raises:
            CaptureError: It cannot be read, is truncated, differs in size from the first, or is not as the options say.
        """
        if self._next >= len(self._files):
            return None
        path, index = self._files[self._next], self._next
        image = read_image(path)
        height, width = image.shape[:2]
        if self._first is None:
            self._first = (path.name, width, height)
        first_name, first_width, first_height = self._first
        if (width, height) != (first_width, first_height):
            raise CaptureError(
                f"is {width}x{height} px, but {first_name} is {first_width}x{first_height} px; "
                "all pictures must have one size",
                str(path),
            )
        self._next += 1
        full_scale_dn = None if self._bits is None else float((1 << self._bits) - 1)
        if full_scale_dn is not None and not image.max() <= full_scale_dn <= np.iinfo(image.dtype).max:
            raise CaptureError(
                f"has {image.dtype} pixels up to {image.max()} DN, which {self._bits} bits cannot be", str(path)
            )
        if self._bayer is not None:
            image = _developed(image, self._bayer, path)
        t_ns, was = index * STEP_NS, self._bayer
        if self._stamps is not None:
            t_ns, was = self._stamps[index].t_ns, was or self._stamps[index].bayer
        return Capture(image, t_ns, path.name, index, bayer=was, full_scale_dn=full_scale_dn)


def _stamps_of(folder: Path, files: list[Path]) -> tuple[PictureStamp, ...] | None:
    """What ``stamps.csv`` says of these pictures; None when there is none."""
    from uvgs_bench.interop.stamp_file import STAMP_FILE, read_stamps

    path = folder / STAMP_FILE
    if not path.is_file():
        return None
    try:
        stamps = read_stamps(path)
    except FormatError as error:
        raise CaptureError(str(error)) from None
    named, there = {stamp.file for stamp in stamps}, {file.name for file in files}
    if unnamed := [file.name for file in files if file.name not in named]:
        raise CaptureError(f"names no instant for {unnamed[0]}; remove the file to stamp pictures by order", str(path))
    if gone := [name for name in named if not (folder / name).is_file()]:
        raise CaptureError(f"names {sorted(gone)[0]}, which is not there", str(path))
    return tuple(stamp for stamp in stamps if stamp.file in there)


def _bayer_of(spec: CameraSpec) -> BayerPattern | None:
    named = spec.options.get("bayer")
    for pattern in get_args(BayerPattern):
        if named == pattern:
            return pattern  # type: ignore[no-any-return]
    if named is not None:
        raise ConfigError(f"expected bayer={'|'.join(get_args(BayerPattern))}, got '{named}'", spec.text)
    return None


def _bits_of(spec: CameraSpec) -> int | None:
    named = spec.options.get("bits")
    if named is None:
        return None
    if not (named.isascii() and named.isdigit() and 8 <= int(named) <= 16):
        raise ConfigError(f"expected bits=8 to bits=16, got '{named}'", spec.text)
    return int(named)


def _developed(mosaic: ImageArray, pattern: BayerPattern, path: Path) -> ImageArray:
    from uvgs_bench.sensor.mosaic import develop

    if mosaic.ndim == 3:
        raise CaptureError("is a colour picture, expected a raw mosaic with one value per pixel", str(path))
    if mosaic.shape[0] % 2 or mosaic.shape[1] % 2:
        height, width = mosaic.shape
        raise CaptureError(f"is {width}x{height} px, but a mosaic has even sides", str(path))
    return develop(mosaic, pattern)


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sorting key that counts: runs of digits compare as numbers."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part.lower()) for part in re.split(r"(\d+)", name)]


def read_image(path: Path) -> ImageArray:
    """Read a picture as it is: mono (H, W) or BGR (H, W, 3), uint8 or uint16; transparency is dropped.

    Args:
        path: The file.

    Returns:
        The pixels.

    Raises:
        CaptureError: It is missing, unreadable, truncated, or of another depth.
    """
    try:
        payload = path.read_bytes()
    except OSError as error:
        raise CaptureError(f"cannot be read: {error.strerror or error}", str(path)) from None
    return decode_image(payload, str(path))


def decode_image(payload: bytes, source: str) -> ImageArray:
    """Decode the bytes of a picture file as it is: mono (H, W) or BGR (H, W, 3), uint8 or uint16.

    Args:
        payload: The bytes.
        source: Where they come from, for messages.

    Returns:
        The pixels; transparency is dropped.

    Raises:
        CaptureError: They are unreadable, truncated, or of another depth.
    """
    from uvgs_bench.interop.picture_bytes import decode_picture

    try:
        return decode_picture(payload, source)
    except FormatError as error:
        raise CaptureError(str(error)) from None
