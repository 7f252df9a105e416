"""Camera calibrations on disk: the ROS ``camera_info`` YAML, plus one mapping ``uvgs:`` with the doubt.

ROS reads the file as it is. Numbers are written with all their digits. A plain ``camera_info`` without ``uvgs:`` is
accepted; then the doubt is unknown. Pixel (0, 0) is the centre of the top-left pixel, as in ROS and OpenCV.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import numpy as np

from uvgs_bench.camera import LENSES, Lens
from uvgs_bench.camera.calibration import Calibration, Verdict
from uvgs_bench.errors import CalibrationError, ConfigError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.store.documents import parse_document, read_text, write_atomically

_SCHEMA = 1
# Names other writers use, and the lens they mean by the number of coefficients.
_MODELS: dict[str, dict[int, str]] = {
    "plumb_bob": {4: "plumb_bob", 5: "plumb_bob"},
    # ROS's own writer labels every list longer than five ``rational_polynomial``.
    "rational_polynomial": {8: "rational_polynomial", 12: "thin_prism"},
    "thin_prism": {12: "thin_prism"},
    "equidistant": {4: "equidistant"},
    "fisheye": {4: "equidistant"},
    "fov": {1: "fov"},
}


@dataclass(frozen=True, slots=True)
class _Matrix:
    rows: int
    cols: int
    data: list[float]

    def __post_init__(self) -> None:
        if self.rows * self.cols != len(self.data):
            raise ValueError(f"{self.rows} rows times {self.cols} cols, but {len(self.data)} numbers in data")

    def array(self) -> FloatArray:
        return np.array(self.data, dtype=np.float64).reshape(self.rows, self.cols)


@dataclass(frozen=True, slots=True)
class _CameraInfo:
    image_width: int
    image_height: int
    camera_matrix: _Matrix
    distortion_model: str
    distortion_coefficients: _Matrix
    camera_name: str = ""


@dataclass(frozen=True, slots=True)
class _Doubt:
    schema: int
    parameters: list[str] = field(default_factory=list)
    covariance: _Matrix | None = None
    rms_px: float | None = None
    held_out_rms_px: float | None = None
    view_count: int = 0
    corner_count: int = 0
    rejected_count: int = 0
    notes: dict[str, str] = field(default_factory=dict)
    verdict: str | None = None
    usable_radius_px: float = 0.0
    reasons: list[str] = field(default_factory=list)
    next_pictures: list[str] = field(default_factory=list)
    # Of the parameters and the mean twist of the boards: the projection uncertainty at any pixel and distance.
    joint_covariance: _Matrix | None = None
    halves_ratio: float | None = None


def read_calibration(path: Path | str) -> Calibration:
    """Read a camera calibration.

    Args:
        path: A ``camera_info`` YAML file, with or without ``uvgs:``.

    Returns:
        The calibration.

    Raises:
        UnreadableDocument: The file is missing or unreadable.
        ConfigError: The file is no YAML, lacks a key, has skew, an unknown model, or a number of coefficients
            the model does not have. The message names file and key.
    """
    path = Path(path)
    return calibration_from_text(read_text(path, "a camera_info YAML file"), str(path))


def calibration_from_text(text: str, path: str) -> Calibration:
    """The calibration in a text.

    Args:
        text: A ``camera_info`` YAML text, with or without ``uvgs:``.
        path: Where it comes from, for messages, and for the name of a camera that has none.

    Returns:
        The calibration.

    Raises:
        ConfigError: As ``read_calibration``.
    """
    data = _parsed_yaml(text, path)
    stem = Path(path).stem
    doubt_data = data.pop("uvgs", None)
    known = {key: data[key] for key in _CameraInfo.__dataclass_fields__ if key in data}
    info = parse_document(known, _CameraInfo, path)
    lens = _lens(info, path)
    if doubt_data is None:
        return Calibration(lens, info.camera_name or stem)
    doubt = parse_document(doubt_data, _Doubt, path, "uvgs")
    if doubt.schema != _SCHEMA:
        raise ConfigError(f"is {doubt.schema}, expected {_SCHEMA}", path, "uvgs.schema")
    if doubt.covariance is not None and tuple(doubt.parameters) != lens.parameter_names:
        raise ConfigError(f"is {doubt.parameters}, expected {list(lens.parameter_names)}", path, "uvgs.parameters")
    try:
        return Calibration(
            lens,
            info.camera_name or stem,
            None if doubt.covariance is None else doubt.covariance.array(),
            doubt.rms_px,
            doubt.held_out_rms_px,
            doubt.view_count,
            doubt.corner_count,
            doubt.rejected_count,
            dict(doubt.notes),
            None if doubt.joint_covariance is None else doubt.joint_covariance.array(),
            None
            if doubt.verdict is None
            else Verdict(doubt.verdict, doubt.usable_radius_px, tuple(doubt.reasons), tuple(doubt.next_pictures)),
            doubt.halves_ratio,
        )
    except CalibrationError as error:
        words = {"verdict": "uvgs.verdict", "halves": "uvgs.halves_ratio"}
        key = next((key for word, key in words.items() if word in str(error)), "uvgs.covariance")
        raise ConfigError(str(error), path, key) from None


def write_calibration(path: Path | str, calibration: Calibration, *, force: bool = False) -> None:
    """Write a camera calibration with all digits, whole or not at all.

    Args:
        path: The YAML file.
        calibration: What to write.
        force: Whether an existing file may be replaced.

    Raises:
        ConfigError: The file exists and may not be replaced.
        UvgsError: It cannot be written.
    """
    write_atomically(Path(path), calibration_text(calibration), force=force)


def calibration_text(calibration: Calibration) -> str:
    """The YAML text of a calibration."""
    lens = calibration.lens
    K = lens.camera_matrix()
    doubt: dict[str, object] = {"schema": _SCHEMA}
    verdict = calibration.verdict
    if verdict is not None:
        doubt["verdict"] = verdict.word
        doubt["usable_radius_px"] = float(verdict.radius_px)
        doubt["reasons"] = list(verdict.reasons)
        doubt["next_pictures"] = list(verdict.next_pictures)
    doubt["parameters"] = list(lens.parameter_names)
    if calibration.covariance is not None:
        doubt["covariance"] = _matrix(calibration.covariance)
    for key in ("rms_px", "held_out_rms_px", "halves_ratio"):
        value = getattr(calibration, key)
        # A held-out error is infinite when the lens could not see a corner; that is no number for a file.
        if value is not None and np.isfinite(value):
            doubt[key] = float(value)
    doubt["view_count"] = calibration.view_count
    doubt["corner_count"] = calibration.corner_count
    doubt["rejected_count"] = calibration.rejected_count
    doubt["notes"] = dict(calibration.notes)
    if calibration.joint_covariance is not None:
        doubt["joint_covariance"] = _matrix(calibration.joint_covariance)
    document = {
        "image_width": lens.width_px,
        "image_height": lens.height_px,
        "camera_name": calibration.camera_name,
        "camera_matrix": _matrix(K),
        "distortion_model": lens.model,
        "distortion_coefficients": _matrix(lens.coefficients.reshape(1, -1)),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.column_stack([K, np.zeros(3)])),
        "uvgs": doubt,
    }
    from ruamel.yaml import YAML

    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False
    yaml.width = 120
    stream = io.StringIO()
    yaml.dump(document, stream)
    return stream.getvalue()


def _matrix(values: FloatArray) -> dict[str, object]:
    return {"rows": values.shape[0], "cols": values.shape[1], "data": [float(value) for value in values.ravel()]}


def _parsed_yaml(text: str, path: str) -> dict[str, object]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    if "!!opencv-matrix" in text:
        raise ConfigError("is OpenCV's own storage format, expected a camera_info YAML file", path)
    try:
        data = YAML(typ="safe", pure=True).load(text)
    except YAMLError as error:
        raise ConfigError(f"not valid YAML: {' '.join(str(error).split())[:160]}", path) from None
    if not isinstance(data, dict):
        raise ConfigError("expected a camera_info mapping (image_width, camera_matrix, ...)", path)
    return cast(dict[str, object], data)


def _lens(info: _CameraInfo, path: str) -> Lens:
    lengths = _MODELS.get(info.distortion_model)
    if lengths is None:
        raise ConfigError(
            f"unknown model '{info.distortion_model}', expected one of {', '.join(LENSES)}", path, "distortion_model"
        )
    coefficients = info.distortion_coefficients.array().ravel()
    model = lengths.get(coefficients.size)
    if model is None:
        raise ConfigError(
            f"{coefficients.size} numbers, but {info.distortion_model} has {' or '.join(map(str, lengths))}",
            path,
            "distortion_coefficients",
        )
    K = info.camera_matrix.array()
    if K.shape != (3, 3):
        raise ConfigError(f"shape {K.shape}, expected (3, 3)", path, "camera_matrix")
    if K[0, 0] == 0.0:
        raise ConfigError("the focal length is 0: this camera was never calibrated", path, "camera_matrix")
    if K[0, 1] != 0.0 or K[1, 0] != 0.0:
        raise ConfigError(f"skew {K[0, 1]} is not supported, expected 0", path, "camera_matrix")
    if K[2].tolist() != [0.0, 0.0, 1.0]:
        raise ConfigError(f"last row {K[2].tolist()}, expected [0, 0, 1]", path, "camera_matrix")
    missing = len(LENSES[model].coefficient_names) - coefficients.size
    parameters = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], coefficients, np.zeros(missing)])
    try:
        return Lens(model, info.image_width, info.image_height, parameters)
    except CalibrationError as error:
        raise ConfigError(str(error), path, "camera_matrix") from None
