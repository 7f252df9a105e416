"""Readers and writers of other tools' camera files; ``camera_files`` is the door to them.

Writers get a lens their format can say exactly and write every digit. Readers give lenses by camera name.
"""

from __future__ import annotations

import ast
import re
from typing import Any

import numpy as np

from uvgs_bench.camera import LENSES, Lens
from uvgs_bench.errors import FormatError
from uvgs_bench.geometry import FloatArray

Size = tuple[int, int]
# The same polynomials with more and more coefficients: each holds the one before as a special case.
_FAMILY = ("plumb_bob", "rational_polynomial", "thin_prism")
_PIXEL_ORIGIN_COLMAP = 0.5


def equal_lenses(lens: Lens) -> dict[str, Lens]:
    """The same map under every model that can say it exactly, the given one first."""
    equal = {lens.model: lens}
    if lens.model not in _FAMILY:
        return equal
    for model in _FAMILY:
        size = len(LENSES[model].parameter_names)
        if not lens.parameters[size:].any():
            padded = np.zeros(size)
            padded[: min(size, lens.parameters.size)] = lens.parameters[:size]
            equal.setdefault(model, Lens(model, lens.width_px, lens.height_px, padded))
    return equal


def _numbers(values: object, path: str, what: str, count: int | None = None) -> list[float]:
    try:
        numbers = [float(value) for value in np.ravel(np.asarray(values, dtype=np.float64))]
    except (TypeError, ValueError):
        raise FormatError(f"{what}: expected numbers", path) from None
    if count is not None and len(numbers) != count:
        raise FormatError(f"{what}: {len(numbers)} numbers, expected {count}", path)
    return numbers


def _lens(model: str, size_px: Size, focal_centre: list[float], coefficients: list[float]) -> Lens:
    """A lens whose missing last coefficients are zero; in the smallest member of its family that is the same."""
    missing = len(LENSES[model].coefficient_names) - len(coefficients)
    full = Lens(model, *size_px, np.array([*focal_centre, *coefficients, *[0.0] * missing]))
    equal = equal_lenses(full)
    return next((equal[name] for name in _FAMILY if name in equal), full)


def _from_matrix(values: object, path: str, what: str) -> list[float]:
    K = _numbers(values, path, what, 9)
    if K[1] != 0.0 or K[3] != 0.0 or K[6:] != [0.0, 0.0, 1.0]:
        raise FormatError(f"{what}: expected [fx 0 cx, 0 fy cy, 0 0 1] without skew", path)
    return [K[0], K[4], K[2], K[5]]


def _whole(size: object, path: str, what: str) -> Size:
    numbers = _numbers(size, path, what, 2)
    if any(value != int(value) or value <= 0 for value in numbers):
        raise FormatError(f"{what}: expected width and height in px, got {numbers}", path)
    return int(numbers[0]), int(numbers[1])


def _list(values: FloatArray | list[float]) -> str:
    """All digits, enough to read the same numbers back."""
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"


# --- ROS camera_info ---------------------------------------------------------------------------------------------


def ros_text(lens: Lens, name: str) -> str:
    """A camera_info YAML file without doubt."""
    K = lens.camera_matrix()
    matrices = {
        "camera_matrix": K,
        "distortion_coefficients": lens.coefficients.reshape(1, -1),
        "rectification_matrix": np.eye(3),
        "projection_matrix": np.column_stack([K, np.zeros(3)]),
    }
    lines = [f"image_width: {lens.width_px}", f"image_height: {lens.height_px}", f"camera_name: {_quoted(name)}"]
    for key, matrix in matrices.items():
        if key == "distortion_coefficients":
            lines.append(f"distortion_model: {lens.model}")
        lines += [
            f"{key}:",
            f"  rows: {matrix.shape[0]}",
            f"  cols: {matrix.shape[1]}",
            f"  data: {_list(matrix.ravel())}",
        ]
    return "\n".join(lines) + "\n"


def _quoted(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", name) else "'" + name.replace("'", "''") + "'"


# --- Kalibr camchain ---------------------------------------------------------------------------------------------

_KALIBR = {"radtan": ("plumb_bob", 4), "equidistant": ("equidistant", 4), "fov": ("fov", 1), "none": ("plumb_bob", 0)}


def read_kalibr(text: str, path: str, _size_px: Size | None) -> dict[str, Lens]:
    """Cameras of a Kalibr camchain by name. Raises FormatError, or CalibrationError for impossible numbers."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        data = YAML(typ="safe", pure=True).load(text)
    except YAMLError as error:
        raise FormatError(f"not valid YAML: {' '.join(str(error).split())[:160]}", path) from None
    lenses = {}
    for name, camera in data.items():
        if not isinstance(camera, dict):
            raise FormatError(f"{name}: expected a mapping", path)
        for key in ("camera_model", "distortion_model", "intrinsics", "distortion_coeffs", "resolution"):
            if key not in camera:
                raise FormatError(f"{name}.{key}: this key is required", path)
        if camera["camera_model"] != "pinhole":
            raise FormatError(
                f"{name}.camera_model: '{camera['camera_model']}' is no lens here, expected pinhole", path
            )
        if camera["distortion_model"] not in _KALIBR:
            raise FormatError(f"{name}.distortion_model: '{camera['distortion_model']}' is unknown", path)
        model, count = _KALIBR[camera["distortion_model"]]
        lenses[str(name)] = _lens(
            model,
            _whole(camera["resolution"], path, f"{name}.resolution"),
            _numbers(camera["intrinsics"], path, f"{name}.intrinsics", 4),
            _numbers(camera["distortion_coeffs"], path, f"{name}.distortion_coeffs", count),
        )
    return lenses


def kalibr_text(lens: Lens, name: str) -> str:
    """A Kalibr camchain of one camera."""
    label = {"plumb_bob": "radtan"}.get(lens.model, lens.model)
    coefficients = lens.coefficients[:4]
    return (
        "cam0:\n  cam_overlaps: []\n  camera_model: pinhole\n"
        f"  distortion_coeffs: {_list(coefficients)}\n  distortion_model: {label}\n"
        f"  intrinsics: {_list(lens.parameters[:4])}\n  resolution: [{lens.width_px}, {lens.height_px}]\n"
        f"  rostopic: /{re.sub(r'[^A-Za-z0-9_]', '_', name)}/image_raw\n"
    )


# --- OpenCV FileStorage ------------------------------------------------------------------------------------------

_MATRIX_KEYS = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K")
_COEFFICIENT_KEYS = ("distortion_coefficients", "Distortion_Coefficients", "dist_coeffs", "distCoeffs", "D")
# Of the two cameras of a stereo pair, each followed by 1 or 2, as OpenCV's samples and their heirs write them.
_STEREO_KEYS = (("M", "D"), ("K", "D"), ("cameraMatrix", "distCoeffs"), ("camera_matrix_", "distortion_coefficients_"))
_BY_LENGTH = {
    0: "plumb_bob",
    4: "plumb_bob",
    5: "plumb_bob",
    8: "rational_polynomial",
    12: "thin_prism",
    14: "thin_prism",
}


def read_opencv(text: str, path: str, size_px: Size | None) -> dict[str, Lens]:
    """The camera, or the two of a stereo pair, of an OpenCV FileStorage file. Raises FormatError, CalibrationError."""
    import cv2

    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError) as error:
        raise FormatError(f"not a valid OpenCV file: {' '.join(str(error).split())[:160]}", path) from None
    found: dict[str, tuple[object, object]] = {}
    try:
        for name, keys in _opencv_pairs(storage).items():
            matrix, coefficients = (_first_matrix(storage, choice, path) for choice in keys)
            found[name] = (matrix, coefficients)
        width, height = storage.getNode("image_width"), storage.getNode("image_height")
        if not width.empty() and not height.empty():
            size_px = _whole([width.real(), height.real()], path, "image_width, image_height")
        named = storage.getNode("distortion_model")
        model = named.string() if not named.empty() and named.isString() else ""
        flag = storage.getNode("fisheye_model")
        is_fisheye = (not flag.empty() and flag.real() != 0.0) or model in ("equidistant", "fisheye")
    except cv2.error as error:
        raise FormatError(f"not a valid OpenCV file: {' '.join(str(error).split())[:160]}", path) from None
    finally:
        storage.release()
    if size_px is None:
        raise FormatError("no image_width and image_height: say the picture's size with --size", path)
    return {name: _opencv_lens(pair, is_fisheye, size_px, path) for name, pair in found.items()}


def _opencv_pairs(storage: Any) -> dict[str, tuple[tuple[str, ...], tuple[str, ...]]]:
    """Keys of matrix and coefficients by the name of the camera: one, or the two of a stereo file."""
    for matrix, coefficients in _STEREO_KEYS:
        if not storage.getNode(f"{matrix}1").empty():
            sides = [side for side in "12" if not storage.getNode(f"{matrix}{side}").empty()]
            return {f"camera{side}": ((f"{matrix}{side}",), (f"{coefficients}{side}",)) for side in sides}
    return {"camera": (_MATRIX_KEYS, _COEFFICIENT_KEYS)}


def _opencv_lens(pair: tuple[object, object], is_fisheye: bool, size_px: Size, path: str) -> Lens:
    values = _numbers(pair[1], path, "distortion_coefficients")
    if len(values) not in _BY_LENGTH:
        raise FormatError(f"distortion_coefficients: {len(values)} numbers, expected 4, 5, 8, 12 or 14", path)
    if any(values[12:]):
        raise FormatError("a tilted sensor (tau_x, tau_y) is no lens here", path)
    model = "equidistant" if is_fisheye and len(values) == 4 else _BY_LENGTH[len(values)]
    return _lens(model, size_px, _from_matrix(pair[0], path, "camera_matrix"), values[:12])


def _first_matrix(storage: Any, keys: tuple[str, ...], path: str) -> object:
    for key in keys:
        node = storage.getNode(key)
        if not node.empty():
            found = node.mat()
            if found is None:
                raise FormatError(f"{key}: expected a matrix", path)
            return found
    raise FormatError(f"{keys[0]}: this key is required", path)


def opencv_text(lens: Lens, name: str) -> str:
    """An OpenCV FileStorage YAML file."""

    def matrix(values: FloatArray) -> str:
        rows, columns = values.shape
        return f"!!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: {_list(values.ravel())}\n"

    return (
        f'%YAML:1.0\n---\ncamera_name: "{re.sub(r"[^A-Za-z0-9_ -]", "_", name)}"\n'
        f"image_width: {lens.width_px}\nimage_height: {lens.height_px}\n"
        f"camera_matrix: {matrix(lens.camera_matrix())}"
        f"distortion_coefficients: {matrix(lens.coefficients.reshape(-1, 1))}"
        f"distortion_model: {lens.model}\nfisheye_model: {int(lens.model == 'equidistant')}\n"
    )


# --- mrcal .cameramodel ------------------------------------------------------------------------------------------

_MRCAL = {
    "LENSMODEL_PINHOLE": ("plumb_bob", 0),
    "LENSMODEL_OPENCV4": ("plumb_bob", 4),
    "LENSMODEL_OPENCV5": ("plumb_bob", 5),
    "LENSMODEL_OPENCV8": ("rational_polynomial", 8),
    "LENSMODEL_OPENCV12": ("thin_prism", 12),
}


def read_mrcal(text: str, path: str, _size_px: Size | None) -> dict[str, Lens]:
    """The camera of a mrcal cameramodel. Raises FormatError, CalibrationError."""
    try:
        data = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, RecursionError, MemoryError) as error:
        raise FormatError(f"not a Python literal: {str(error)[:120]}", path) from None
    if not isinstance(data, dict):
        raise FormatError("expected a mapping with lensmodel, intrinsics and imagersize", path)
    for key in ("lensmodel", "intrinsics", "imagersize"):
        if key not in data:
            raise FormatError(f"{key}: this key is required", path)
    if data["lensmodel"] not in _MRCAL:
        raise FormatError(f"lensmodel: '{data['lensmodel']}' is no lens here, expected {', '.join(_MRCAL)}", path)
    model, count = _MRCAL[data["lensmodel"]]
    values = _numbers(data["intrinsics"], path, "intrinsics", 4 + count)
    return {"camera": _lens(model, _whole(data["imagersize"], path, "imagersize"), values[:4], values[4:])}


def mrcal_text(lens: Lens, _name: str) -> str:
    """A mrcal cameramodel at the origin."""
    return (
        f"{{\n    'lensmodel':  'LENSMODEL_OPENCV{lens.coefficients.size}',\n"
        f"    'intrinsics': {_list(lens.parameters)},\n"
        "    'extrinsics': [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],\n"
        f"    'imagersize': [{lens.width_px}, {lens.height_px}],\n}}\n"
    )


# --- COLMAP cameras.txt ------------------------------------------------------------------------------------------

# Lens, whether there is one focal length for both axes, number of coefficients.
_COLMAP = {
    "SIMPLE_PINHOLE": ("plumb_bob", True, 0),
    "PINHOLE": ("plumb_bob", False, 0),
    "SIMPLE_RADIAL": ("plumb_bob", True, 1),
    "RADIAL": ("plumb_bob", True, 2),
    "OPENCV": ("plumb_bob", False, 4),
    "FULL_OPENCV": ("rational_polynomial", False, 8),
    "SIMPLE_RADIAL_FISHEYE": ("equidistant", True, 1),
    "RADIAL_FISHEYE": ("equidistant", True, 2),
    "OPENCV_FISHEYE": ("equidistant", False, 4),
    "FOV": ("fov", False, 1),
}


def read_colmap(text: str, path: str, _size_px: Size | None) -> dict[str, Lens]:
    """Cameras of a COLMAP cameras.txt by number. Raises FormatError, CalibrationError."""
    lenses = {}
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        if len(words) < 5 or words[1] not in _COLMAP:
            named = words[1] if len(words) > 1 else line.strip()
            raise FormatError(f"'{named}' is no lens here, expected {', '.join(_COLMAP)}", path, number)
        model, is_single, count = _COLMAP[words[1]]
        values = _numbers(words[4:], path, words[1], (3 if is_single else 4) + count)
        if is_single:
            values.insert(0, values[0])
        centre = [value - _PIXEL_ORIGIN_COLMAP for value in values[2:4]]
        size_px = _whole(words[2:4], path, "width and height")
        lenses[words[0]] = _lens(model, size_px, [*values[:2], *centre], values[4:])
    return lenses


def colmap_text(lens: Lens, _name: str) -> str:
    """A COLMAP cameras.txt of one camera."""
    labels = {"rational_polynomial": "FULL_OPENCV", "equidistant": "OPENCV_FISHEYE", "fov": "FOV"}
    values = [float(value) for value in lens.parameters]
    if lens.model == "plumb_bob":
        # OPENCV has k1 k2 p1 p2 only.
        is_short = values[8] == 0.0
        label, values = ("OPENCV", values[:8]) if is_short else ("FULL_OPENCV", [*values, 0.0, 0.0, 0.0])
    else:
        label = labels[lens.model]
    values[2:4] = [value + _PIXEL_ORIGIN_COLMAP for value in values[2:4]]
    return (
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        "# Number of cameras: 1\n"
        f"1 {label} {lens.width_px} {lens.height_px} {' '.join(repr(value) for value in values)}\n"
    )


# --- Astrobee Lua ------------------------------------------------------------------------------------------------


def read_astrobee(text: str, path: str, size_px: Size | None) -> dict[str, Lens]:
    """Cameras of an Astrobee configuration by name. Raises FormatError, CalibrationError."""
    plain = re.sub(r"--\[\[.*?\]\]|--[^\n]*", "", text, flags=re.DOTALL)
    lenses = {}
    for start in re.finditer(r"(\w+)\s*=\s*\{", plain):
        block = _braced(plain, start.end() - 1, path)
        # Tables within the table: only the innermost that has both keys itself is a camera.
        own = re.sub(r"(\w+)\s*=\s*\{[^{}]*\}", r"\1 = TABLE", block[1:-1])
        if "{" in own or not re.search(r"\bintrinsic_matrix\s*=", own):
            continue
        matrix = re.search(r"\bintrinsic_matrix\s*=\s*\{([^{}]*)\}", block)
        coefficients = re.search(r"\bdistortion_coeff\s*=\s*(?:\{([^{}]*)\}|([-+.\deE]+)\s*[,;}\n])", block)
        if matrix is None or coefficients is None:
            continue
        name = start[1]
        said = [re.search(rf"\b{key}\s*=\s*(\d+)", block) for key in ("width", "height")]
        size = (int(said[0][1]), int(said[1][1])) if said[0] and said[1] else size_px
        if size is None:
            raise FormatError(f"{name}: no width and height: say the picture's size with --size", path)
        values = _numbers(_split(coefficients[1] or coefficients[2]), path, f"{name}.distortion_coeff")
        if len(values) not in (1, 4):
            raise FormatError(f"{name}.distortion_coeff: {len(values)} numbers, expected 1 (fov) or 4", path)
        model = "fov" if len(values) == 1 else "plumb_bob"
        lenses[name] = _lens(model, size, _from_matrix(_split(matrix[1]), path, f"{name}.intrinsic_matrix"), values)
    return lenses


def _split(text: str) -> list[str]:
    return [word for word in re.split(r"[,;\s]+", text) if word]


def _braced(text: str, start: int, path: str) -> str:
    depth = 0
    for i in range(start, len(text)):
        depth += {"{": 1, "}": -1}.get(text[i], 0)
        if depth == 0:
            return text[start : i + 1]
    raise FormatError("a brace is never closed", path)


def astrobee_text(lens: Lens, name: str) -> str:
    """An Astrobee camera table."""
    K = [repr(float(value)) for value in lens.camera_matrix().ravel()]
    rows = "".join(f"    {', '.join(K[i : i + 3])}{',' if i < 6 else ''}\n" for i in (0, 3, 6))
    coefficients = lens.coefficients[:4]
    shown = repr(float(coefficients[0])) if lens.model == "fov" else "{" + _list(coefficients)[1:-1] + "}"
    return (
        f"{re.sub(r'[^A-Za-z0-9_]', '_', name) or 'camera'} = {{\n  width = {lens.width_px},\n"
        f"  height = {lens.height_px},\n  distortion_coeff = {shown},\n  intrinsic_matrix = {{\n{rows}  }}\n}}\n"
    )
