"""Camera files of other tools: Kalibr, OpenCV, mrcal, COLMAP, Astrobee, and ROS's plain ``camera_info`` to write.

Only exact forms are written: a lens goes into a file if that file can say the same map with the same numbers (a
``plumb_bob`` is a ``rational_polynomial`` whose k4, k5, k6 are zero); everything else is refused by name. All digits
are written. COLMAP puts the centre of the top-left pixel at (0.5, 0.5), all others, and this program, at (0, 0).

To add a format: 1. write ``read_x(text, path, size_px)`` and ``x_text(lens, name)`` in ``camera_formats``; 2. add one
line to ``CAMERA_FORMATS``; 3. the round-trip tests of ``tests/unit/interop`` then run over it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field

from uvgs_bench.camera import LENSES, Lens
from uvgs_bench.errors import CalibrationError, FormatError
from uvgs_bench.interop import camera_formats as formats
from uvgs_bench.interop.camera_formats import Size, equal_lenses


@dataclass(frozen=True, slots=True)
class CameraFormat:
    """One line of the format table.

    Args:
        what: For people.
        models: Lenses the format has an exact form for.
        must_be_zero: Coefficients the format has no place for, by lens.
        write: Text of a file from a lens and a camera name.
        read: Lenses of a file by camera name; None where another reader does it.
        comment: What starts a comment line.
    """

    what: str
    models: tuple[str, ...]
    write: Callable[[Lens, str], str]
    read: Callable[[str, str, Size | None], dict[str, Lens]] | None = None
    must_be_zero: dict[str, tuple[str, ...]] = field(default_factory=dict)
    comment: str = "#"


def format_of(text: str, path: str = "") -> str:
    """Tell a camera file by its content.

    Args:
        text: The file.
        path: Its name, for the message.

    Returns:
        Key of ``CAMERA_FORMATS``; ``ros`` for any ``camera_info`` YAML.

    Raises:
        FormatError: It is none of them.
    """
    if "opencv-matrix" in text or "<opencv_storage" in text or text.startswith("%YAML:1.0"):
        return "opencv"
    if re.search(r"['\"]lensmodel['\"]", text):
        return "mrcal"
    if re.search(r"^cam\d+:", text, re.MULTILINE):
        return "kalibr"
    if re.search(r"^\s*[\"']?camera_matrix[\"']?\s*:", text, re.MULTILINE):
        return "ros"
    if "intrinsic_matrix" in text and "distortion_coeff" in text:
        return "astrobee"
    if re.search(r"^\s*\d+\s+[A-Z][A-Z_]+\s+\d+\s+\d+\s", text, re.MULTILINE):
        return "colmap"
    raise FormatError(f"no camera file of a known kind: {', '.join(CAMERA_FORMATS)}", path)


def read_lenses(text: str, path: str = "", size_px: Size | None = None) -> dict[str, Lens]:
    """Read all cameras of another tool's file (not ROS ``camera_info``, which ``store`` reads).

    Args:
        text: The file.
        path: Its name, for messages.
        size_px: Width and height of the picture, for files that do not say it.

    Returns:
        Lenses by camera name.

    Raises:
        FormatError: The file is broken, has no camera, has a lens that is none of ``LENSES``, or has a picture of
            another size than was said.
    """
    name = format_of(text, path)
    reader = CAMERA_FORMATS[name].read
    if reader is None:
        raise FormatError("is a camera_info file", path)
    try:
        lenses = reader(text, path, size_px)
    except CalibrationError as error:
        raise FormatError(str(error), path) from None
    if not lenses:
        raise FormatError(f"no camera in this {name} file", path)
    for lens in lenses.values():
        if size_px is not None and (lens.width_px, lens.height_px) != size_px:
            raise FormatError(
                f"the file is for {lens.width_px}x{lens.height_px} px, not {size_px[0]}x{size_px[1]} px", path
            )
    return lenses


def exact_lens(lens: Lens, target: str) -> Lens:
    """The same map in a model a format has.

    Args:
        lens: The lens.
        target: Key of ``CAMERA_FORMATS``.

    Returns:
        The lens to write.

    Raises:
        CalibrationError: The format has no exact form; the message says why and what a refit could use.
    """
    known = CAMERA_FORMATS[target]
    equal = equal_lenses(lens)
    stuck = f"{known.what} has no form for {lens.model}"
    for model in known.models:
        if model not in equal:
            continue
        names = LENSES[model].parameter_names
        full = [name for name in known.must_be_zero.get(model, ()) if equal[model].parameters[names.index(name)] != 0.0]
        if not full:
            return equal[model]
        stuck = f"{known.what} has no place for {', '.join(full)} of {model}"
    raise CalibrationError(f"{stuck}; an approximation needs --refit {' or '.join(known.models)}")


def lens_text(lens: Lens, target: str, name: str = "camera", remarks: tuple[str, ...] = ()) -> str:
    """A file of another tool.

    Args:
        lens: The lens.
        target: Key of ``CAMERA_FORMATS``.
        name: Name of the camera.
        remarks: Lines for people, written as comments.

    Returns:
        The text.

    Raises:
        CalibrationError: The format has no exact form for this lens.
    """
    known = CAMERA_FORMATS[target]
    text = known.write(exact_lens(lens, target), name)
    lines = "".join(f"{known.comment} {' '.join(remark.split())}\n" for remark in remarks)
    if text.startswith("%YAML"):
        head, _, body = text.partition("---\n")
        return f"{head}---\n{lines}{body}"
    return lines + text


_NO_K3: dict[str, tuple[str, ...]] = {"plumb_bob": ("k3",)}
CAMERA_FORMATS: dict[str, CameraFormat] = {
    "ros": CameraFormat("ROS camera_info", ("plumb_bob", "rational_polynomial", "equidistant"), formats.ros_text),
    "kalibr": CameraFormat(
        "a Kalibr camchain", ("plumb_bob", "equidistant", "fov"), formats.kalibr_text, formats.read_kalibr, _NO_K3
    ),
    "opencv": CameraFormat(
        "OpenCV FileStorage",
        ("plumb_bob", "rational_polynomial", "thin_prism", "equidistant"),
        formats.opencv_text,
        formats.read_opencv,
    ),
    "mrcal": CameraFormat(
        "a mrcal cameramodel",
        ("plumb_bob", "rational_polynomial", "thin_prism"),
        formats.mrcal_text,
        formats.read_mrcal,
    ),
    "colmap": CameraFormat(
        "COLMAP cameras.txt",
        ("plumb_bob", "rational_polynomial", "equidistant", "fov"),
        formats.colmap_text,
        formats.read_colmap,
    ),
    "astrobee": CameraFormat(
        "an Astrobee configuration", ("fov", "plumb_bob"), formats.astrobee_text, formats.read_astrobee, _NO_K3, "--"
    ),
}
