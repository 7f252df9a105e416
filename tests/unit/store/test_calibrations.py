"""Camera files: full digits there and back, plain camera_info accepted, everything else refused by name."""

from __future__ import annotations

import re

import numpy as np
import pytest

from uvgs_bench.camera import LENSES, Lens
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.errors import CalibrationError, ConfigError
from uvgs_bench.store.calibrations import calibration_text, read_calibration, write_calibration

PLAIN = """\
image_width: 1280
image_height: 960
camera_name: uvgs_cam
camera_matrix:
  rows: 3
  cols: 3
  data: [1105.31, 0.0, 641.20, 0.0, 1104.87, 478.66, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.2145, 0.0831, 0.00042, -0.00017, -0.0129]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
"""


def example(model: str) -> Calibration:
    rng = np.random.default_rng(5)
    count = len(LENSES[model].parameter_names)
    parameters = np.concatenate([[1105.3123456789012, 1104.8, 641.2, 478.6], rng.normal(0.01, 1e-3, count - 4)])
    root = rng.normal(0, 1e-3, (count, count))
    covariance = root @ root.T
    lens = Lens(model, 1280, 960, parameters)
    return Calibration(
        lens, "cam é", covariance, 0.2449, 0.25, 13, 702, 4, {"board": "chessboard_9x6"}, halves_ratio=2.25
    )


@pytest.mark.parametrize("model", list(LENSES))
def test_every_lens_comes_back_bit_for_bit(tmp_path, model):
    path = tmp_path / "camera.yaml"
    before = example(model)
    write_calibration(path, before)
    after = read_calibration(path)
    assert after.lens.model == model
    assert after.lens.parameters.tolist() == before.lens.parameters.tolist()
    assert after.covariance is not None
    assert before.covariance is not None
    assert after.covariance.tolist() == before.covariance.tolist()
    assert (after.rms_px, after.held_out_rms_px, after.view_count, after.corner_count, after.rejected_count) == (
        0.2449,
        0.25,
        13,
        702,
        4,
    )
    assert after.halves_ratio == after.doubt_factor == 2.25
    assert after.notes == before.notes
    assert after.camera_name == "cam é"


def test_written_file_is_a_camera_info_for_old_yaml_readers():
    text = calibration_text(example("plumb_bob"))
    keys = [line.split(":")[0] for line in text.splitlines() if line and not line[0].isspace()]
    assert keys == [
        "image_width",
        "image_height",
        "camera_name",
        "camera_matrix",
        "distortion_model",
        "distortion_coefficients",
        "rectification_matrix",
        "projection_matrix",
        "uvgs",
    ]
    # YAML 1.1 readers take 1e-05 for a string; a number with an exponent needs its dot.
    assert re.findall(r"(?<![\d.])\d+e[-+]?\d+", text) == []


def test_plain_camera_info_is_accepted_without_doubt(tmp_path):
    path = tmp_path / "plain.yaml"
    path.write_text(PLAIN)
    calibration = read_calibration(path)
    assert calibration.lens.parameters.tolist()[:4] == [1105.31, 1104.87, 641.20, 478.66]
    assert calibration.covariance is None
    assert calibration.sigmas is None
    assert calibration.rms_px is None


def test_four_coefficients_and_the_old_fisheye_name_are_understood(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text(PLAIN.replace("cols: 5", "cols: 4").replace(", -0.0129]", "]"))
    assert read_calibration(path).lens.coefficients.tolist() == [-0.2145, 0.0831, 0.00042, -0.00017, 0.0]
    path.write_text(PLAIN.replace("plumb_bob", "fisheye").replace("cols: 5", "cols: 4").replace(", -0.0129]", "]"))
    assert read_calibration(path).lens.model == "equidistant"


@pytest.mark.parametrize(
    ("old", "new", "key", "said"),
    [
        ("distortion_model: plumb_bob", "distortion_model: pinhole", "distortion_model", "unknown model"),
        ("plumb_bob", "fov", "distortion_coefficients", "5 numbers, but fov has 1"),
        ("cols: 5", "cols: 6", "distortion_coefficients", "5 numbers in data"),
        ("1105.31, 0.0,", "1105.31, 0.3,", "camera_matrix", "skew"),
        ("1105.31, 0.0,", "0.0, 0.0,", "camera_matrix", "never calibrated"),
        ("image_width: 1280\n", "", "image_width", "required"),
        ("image_width: 1280\n", "image_width: wide\n", "image_width", "whole number"),
        ("1105.31, 0.0,", "-5.0, 0.0,", "camera_matrix", "positive"),
    ],
)
def test_broken_file_is_refused_naming_file_and_key(tmp_path, old, new, key, said):
    path = tmp_path / "broken.yaml"
    assert old in PLAIN
    path.write_text(PLAIN.replace(old, new))
    with pytest.raises(ConfigError, match=said) as caught:
        read_calibration(path)
    assert str(path) in str(caught.value)
    assert caught.value.key == key


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("schema: 1", "schema: 2", "expected 1"),
        ("parameters: [fx, fy", "parameters: [fy, fx", "expected"),
        ("rms_px:", "rmse_px:", "did you mean 'rms_px'"),
        ("halves_ratio: 2.25", "halves_ratio: -1.0", "uvgs.halves_ratio.*expected a number from 0 on"),
    ],
)
def test_broken_doubt_is_refused(tmp_path, old, new, said):
    path = tmp_path / "broken.yaml"
    text = calibration_text(example("fov"))
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ConfigError, match=said):
        read_calibration(path)


def test_a_file_that_never_held_halves_against_each_other_is_read(tmp_path):
    path = tmp_path / "older.yaml"
    path.write_text(calibration_text(example("fov")).replace("  halves_ratio: 2.25\n", ""))
    older = read_calibration(path)
    assert older.halves_ratio is None
    assert older.doubt_factor == 1.0


@pytest.mark.parametrize("content", ["- 1\n- 2\n", "a: [1,\n", "", "just words"])
def test_something_else_than_camera_info_is_refused(tmp_path, content):
    path = tmp_path / "other.yaml"
    path.write_text(content)
    with pytest.raises(ConfigError, match=r"other\.yaml"):
        read_calibration(path)


def test_missing_file_and_folder_are_named(tmp_path):
    with pytest.raises(ConfigError, match="no such file"):
        read_calibration(tmp_path / "nothing.yaml")
    with pytest.raises(ConfigError, match="is a folder"):
        read_calibration(tmp_path)


def test_an_existing_file_is_kept_unless_forced(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text("precious")
    with pytest.raises(ConfigError, match="--force"):
        write_calibration(path, example("fov"))
    assert path.read_text() == "precious"
    write_calibration(path, example("fov"), force=True)
    assert read_calibration(path).lens.model == "fov"


def test_pictures_of_another_size_are_refused_naming_both():
    with pytest.raises(CalibrationError, match=r"left01.*640x480.*1280x960"):
        example("fov").check_size(640, 480, "left01.jpg")


def test_covariance_of_another_shape_is_refused():
    lens = example("fov").lens
    with pytest.raises(CalibrationError, match=r"\(5, 5\)"):
        Calibration(lens, covariance=np.eye(4))
    with pytest.raises(CalibrationError, match="symmetric"):
        Calibration(lens, covariance=np.triu(np.ones((5, 5))))
