"""Camera files of other tools: facts of each format, round trips to the last digit, and what is refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from ruamel.yaml import YAML

from uvgs_bench.camera import Lens
from uvgs_bench.errors import CalibrationError, FormatError
from uvgs_bench.interop.camera_files import CAMERA_FORMATS, equal_lenses, exact_lens, format_of, lens_text, read_lenses

pytestmark = pytest.mark.opencv

RADIAL = [1105.3123456789012, 1104.87, 641.2, 478.66, -0.2145, 0.0831, 0.00042, -0.00017]
LENSES = {
    "plumb_bob": [*RADIAL, -0.0129],
    "plumb_bob without k3": [*RADIAL, 0.0],
    "rational_polynomial": [*RADIAL, -0.0129, 0.01, 0.002, 1e-4],
    "thin_prism": [*RADIAL, -0.0129, 0.01, 0.002, 1e-4, 1e-3, -1e-4, 2e-3, 1 / 3e4],
    "equidistant": [612.4, 611.9, 640.8, 479.5, 0.011, -0.008, 0.002, -0.0008],
    "fov": [608.8073, 607.61439, 632.53684, 549.08386, 0.998693],
}


def lens(name: str) -> Lens:
    return Lens(name.split()[0], 1280, 960, np.array(LENSES[name]))


# What each format can say exactly, from the formats' own documentation.
EXACT = {
    "ros": {"plumb_bob", "plumb_bob without k3", "rational_polynomial", "equidistant"},
    "kalibr": {"plumb_bob without k3", "equidistant", "fov"},
    "opencv": {"plumb_bob", "plumb_bob without k3", "rational_polynomial", "thin_prism", "equidistant"},
    "mrcal": {"plumb_bob", "plumb_bob without k3", "rational_polynomial", "thin_prism"},
    "colmap": {"plumb_bob", "plumb_bob without k3", "rational_polynomial", "equidistant", "fov"},
    "astrobee": {"plumb_bob without k3", "fov"},
}


def test_every_format_is_in_the_table_of_facts():
    assert set(EXACT) == set(CAMERA_FORMATS)


@pytest.mark.parametrize("name", list(LENSES))
@pytest.mark.parametrize("target", list(CAMERA_FORMATS))
def test_a_lens_comes_back_exactly_or_is_refused(target, name):
    if name not in EXACT[target]:
        with pytest.raises(CalibrationError, match="--refit"):
            lens_text(lens(name), target)
        return
    text = lens_text(lens(name), target, "nav_cam", ("a remark", "and another"))
    assert format_of(text) == target
    if target == "ros":
        return
    (back,) = read_lenses(text).values()
    assert (back.model, back.width_px, back.height_px) == (name.split()[0], 1280, 960)
    # To the last digit, but for COLMAP's half pixel, which may round once on the way there and once back.
    atol = 2.3e-13 if target == "colmap" else 0.0
    np.testing.assert_allclose(back.parameters, LENSES[name], rtol=0, atol=atol)


def test_plain_camera_info_has_the_keys_and_digits_ros_reads():
    text = lens_text(lens("rational_polynomial"), "ros", "left: eye")
    data = YAML(typ="safe", pure=True).load(text)
    assert data["camera_name"] == "left: eye"
    assert data["distortion_model"] == "rational_polynomial"
    assert data["camera_matrix"]["data"][0] == RADIAL[0]
    assert data["distortion_coefficients"]["cols"] == 8
    assert data["projection_matrix"]["data"][:4] == [RADIAL[0], 0.0, 641.2, 0.0]


def test_kalibr_fact_sheet():
    text = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [0.9312]
  distortion_model: fov
  intrinsics: [612.4, 611.9, 640.8, 479.5]
  resolution: [1280, 960]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1: [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  camera_model: pinhole
  distortion_coeffs: [0.01, -0.02, 0.001, 0.002]
  distortion_model: radtan
  intrinsics: [612.4, 611.9, 640.8, 479.5]
  resolution: [1280, 960]
"""
    lenses = read_lenses(text)
    assert {name: found.model for name, found in lenses.items()} == {"cam0": "fov", "cam1": "plumb_bob"}
    assert lenses["cam1"].parameters[4:].tolist() == [0.01, -0.02, 0.001, 0.002, 0.0]
    with pytest.raises(FormatError, match=r"cam1\.camera_model: 'omni'"):
        read_lenses(text[:-1].replace("camera_model: pinhole", "camera_model: omni").replace("omni", "pinhole", 1))
    with pytest.raises(FormatError, match=r"cam0.distortion_coeffs: 2 numbers, expected 1"):
        read_lenses(text.replace("[0.9312]", "[0.9312, 0.1]"))


@pytest.mark.parametrize("head", ["%YAML:1.0", "%YAML 1.2"])
def test_opencv_files_with_either_first_line(head, tmp_path):
    path = tmp_path / "c.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 1280)
    storage.write("image_height", 960)
    storage.write("camera_matrix", lens("plumb_bob").camera_matrix())
    storage.write("distortion_coefficients", np.array(LENSES["plumb_bob"][4:]).reshape(-1, 1))
    storage.release()
    text = path.read_text()
    written = text.split("\n", 1)
    assert written[0] in ("%YAML:1.0", "%YAML 1.2")
    (back,) = read_lenses(f"{head}\n{written[1]}").values()
    # OpenCV itself writes 17 significant digits.
    np.testing.assert_allclose(back.parameters, LENSES["plumb_bob"], rtol=0, atol=1e-15)
    ours = tmp_path / "ours.yml"
    ours.write_text(lens_text(lens("plumb_bob"), "opencv", "x", ("remark",)))
    seen = cv2.FileStorage(str(ours), cv2.FILE_STORAGE_READ)
    np.testing.assert_array_equal(seen.getNode("camera_matrix").mat(), lens("plumb_bob").camera_matrix())
    seen.release()


@pytest.mark.parametrize(("matrix", "coefficients"), [("M", "D"), ("cameraMatrix", "distCoeffs")])
def test_opencv_stereo_files_hold_two_cameras(matrix, coefficients, tmp_path):
    path = tmp_path / "intrinsics.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for side, name in ((1, "plumb_bob"), (2, "rational_polynomial")):
        storage.write(f"{matrix}{side}", lens(name).camera_matrix())
        storage.write(f"{coefficients}{side}", np.array(LENSES[name][4:]).reshape(1, -1))
    storage.release()
    with pytest.raises(FormatError, match="--size"):
        read_lenses(path.read_text())
    found = read_lenses(path.read_text(), "x", (1280, 960))
    assert list(found) == ["camera1", "camera2"]
    assert found["camera1"].model == "plumb_bob"
    np.testing.assert_allclose(found["camera2"].parameters, LENSES["rational_polynomial"], rtol=0, atol=1e-15)
    with pytest.raises(FormatError, match=rf"{coefficients}2: this key is required"):
        read_lenses(path.read_text().replace(f"{coefficients}2", "other"), "x", (1280, 960))


def test_opencv_fourteen_coefficients_sizes_and_breakage():
    text = lens_text(lens("thin_prism"), "opencv")
    tilted = text.replace("rows: 12", "rows: 14").replace("]\ndistortion_model", ", 0.0, 0.0]\ndistortion_model")
    assert next(iter(read_lenses(tilted).values())).model == "thin_prism"
    with pytest.raises(FormatError, match="tilted sensor"):
        read_lenses(tilted.replace("0.0, 0.0]\ndistortion_model", "0.01, 0.0]\ndistortion_model"))
    unsized = text.replace("image_width", "w").replace("image_height", "h")
    with pytest.raises(FormatError, match="--size"):
        read_lenses(unsized)
    assert next(iter(read_lenses(unsized, size_px=(640, 480)).values())).width_px == 640
    with pytest.raises(FormatError, match="not 640x480"):
        read_lenses(text, size_px=(640, 480))
    with pytest.raises(FormatError):
        read_lenses(text[: len(text) // 2])
    with pytest.raises(FormatError, match="13 numbers"):
        read_lenses(text.replace("rows: 12", "rows: 13").replace("]\ndistortion_model", ", 0.0]\ndistortion_model"))


def test_mrcal_is_parsed_and_never_run():
    text = """# a comment
{
    'lensmodel':  'LENSMODEL_OPENCV8',
    # intrinsics are fx,fy,cx,cy,...
    'intrinsics': [ 1105.31, 1104.87, 641.20, 478.66, -0.21, 0.08, 0.0004, -0.0002, -0.013, 0.01, 0.002, 0.0, ],
    'extrinsics': [ 0, 0, 0, 0, 0, 0, ],
    'imagersize': [ 1280, 960, ],
    'optimization_inputs': b'P)h>@6aWAK2mq5a',
}
"""
    (found,) = read_lenses(text).values()
    assert found.model == "rational_polynomial"
    assert found.parameters[-3:].tolist() == [0.01, 0.002, 0.0]
    with pytest.raises(FormatError, match="LENSMODEL_SPLINED"):
        read_lenses(text.replace("LENSMODEL_OPENCV8", "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=30"))
    with pytest.raises(FormatError, match="not a Python literal"):
        read_lenses(text.replace("'imagersize': [ 1280, 960, ]", "'imagersize': __import__('os').getcwd()"))
    with pytest.raises(FormatError, match="not a Python literal"):
        read_lenses("'lensmodel'" + "(" * 100_000)


def test_colmap_half_pixel_and_all_its_lenses():
    text = """# Camera list with one line of data per camera:
1 FOV 1280 960 612.4 611.9 641.3 480.0 0.9312
2 OPENCV_FISHEYE 1280 960 612.4 611.9 641.3 480.0 0.011 -0.008 0.002 -0.0008
3 SIMPLE_RADIAL 1280 960 612.4 640.5 480.5 -0.1
"""
    lenses = read_lenses(text)
    assert [lenses[key].model for key in "123"] == ["fov", "equidistant", "plumb_bob"]
    assert lenses["1"].cx_px == 640.8
    assert lenses["3"].parameters.tolist() == [612.4, 612.4, 640.0, 480.0, -0.1, 0.0, 0.0, 0.0, 0.0]
    assert " 640.8 " not in lens_text(lens("equidistant"), "colmap")
    with pytest.raises(FormatError, match=":3: 'RAD_TAN"):
        read_lenses(text.replace("OPENCV_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"), "f")
    with pytest.raises(FormatError, match="expected 5"):
        read_lenses(text.replace(" 0.9312", ""))


ASTROBEE = """-- distortion_coeff = { in a comment
robot_geometry = { nav_cam_transform = transform(vec3(0.1157+0.002, -0.0422, -0.0826), quat4(0.5, 0.5, 0.5, 0.5)) };
robot_camera_calibrations = {
  nav_cam = {
    distortion_coeff = 0.998693,
    intrinsic_matrix = {
      608.8073, 0.0, 632.53684,
      0.0, 607.61439, 549.08386,
      0.0, 0.0, 1.0
    },
    gain=50,
    exposure=175
  },
  perch_cam = {
    distortion_coeff = {-0.366735, 0.182027, 0.00218105, 0.0114682},
    intrinsic_matrix = { 209.21199, 0.0, 94.688486, 0.0, 207.62067, 84.04047, 0.0, 0.0, 1.0 },
  }
}
"""


def test_astrobee_tables_within_tables():
    lenses = read_lenses(ASTROBEE, size_px=(1280, 960))
    assert list(lenses) == ["nav_cam", "perch_cam"]
    assert lenses["nav_cam"].model == "fov"
    assert lenses["nav_cam"].parameters.tolist() == LENSES["fov"]
    assert lenses["perch_cam"].parameters[4:].tolist() == [-0.366735, 0.182027, 0.00218105, 0.0114682, 0.0]
    with pytest.raises(FormatError, match="nav_cam: no width and height"):
        read_lenses(ASTROBEE)
    with pytest.raises(FormatError, match="never closed"):
        read_lenses(ASTROBEE[:-4], size_px=(1280, 960))
    with pytest.raises(FormatError, match="without skew"):
        read_lenses(ASTROBEE.replace("608.8073, 0.0", "608.8073, 0.5"), size_px=(1280, 960))


def test_equal_lenses_are_the_same_map():
    padded = equal_lenses(lens("plumb_bob"))
    assert list(padded) == ["plumb_bob", "rational_polynomial", "thin_prism"]
    points = np.array([[0.3, -0.2, 1.0], [-0.5, 0.3, 1.0]])
    for other in padded.values():
        np.testing.assert_array_equal(other.project(points), lens("plumb_bob").project(points))
    assert list(equal_lenses(lens("rational_polynomial"))) == ["rational_polynomial", "thin_prism"]
    zero = Lens("rational_polynomial", 1280, 960, np.array([*RADIAL, 0.0, 0.0, 0.0, 0.0]))
    assert exact_lens(zero, "kalibr").model == "plumb_bob"


def test_strangers_are_refused():
    with pytest.raises(FormatError, match="no camera file of a known kind"):
        read_lenses("hello", "x.txt")
