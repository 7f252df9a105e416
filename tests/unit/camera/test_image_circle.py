"""The image circle of a fisheye is found, and a picture that fills its corners has none."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from uvgs_bench.camera.boards import Board
from uvgs_bench.camera.image_circle import find_image_circle
from uvgs_bench.devices.cameras import open_camera
from uvgs_bench.sessions.calibrate import calibrate_from_source

pytestmark = pytest.mark.opencv
FISHEYE = Path(__file__).parents[4] / "shared" / "data" / "chessboard_fisheye"


def disc(u: float, v: float, radius: float, shape: tuple[int, int] = (480, 640)) -> np.ndarray:
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    rng = np.random.default_rng(1)
    lit = np.hypot(columns - u, rows - v) <= radius
    return (np.where(lit, 120.0, 4.0) + rng.uniform(0.0, 8.0, shape)).astype(np.uint8)


@pytest.mark.parametrize(("u", "v", "radius"), [(322.0, 241.0, 230.0), (310.0, 245.0, 300.0)])
def test_circles_whole_and_cut_by_the_picture_are_found(u, v, radius):
    image = disc(u, v, radius)
    # A dark thing within, as there is in pictures.
    cv2.rectangle(image, (300, 200), (360, 260), 5, -1)
    found = find_image_circle(image)
    # Edges are read to a pixel.
    assert np.hypot(found.u_px - u, found.v_px - v) < 1.0
    assert found.radius_px == pytest.approx(radius, abs=1.0)
    inside = found.contains(np.array([[u, v], [u + radius - 3.0, v], [u + radius + 3.0, v]]))
    assert inside.tolist() == [True, True, False]


def test_other_pictures_have_none():
    assert find_image_circle(np.full((480, 640), 90, np.uint8)) is None
    assert find_image_circle(np.zeros((480, 640), np.uint8)) is None
    square = np.full((480, 640), 3, np.uint8)
    square[100:380, 150:500] = 150
    assert find_image_circle(square) is None
    assert find_image_circle(disc(640.0, 480.0, 300.0)) is None


@pytest.mark.shared_data
def test_a_fisheye_is_judged_by_its_circle():
    if not FISHEYE.is_dir():
        pytest.skip(f"no fisheye pictures at {FISHEYE}")
    board = Board("fisheye", "chessboard", 6, 4, 0.03)
    with open_camera(f"images:{FISHEYE}") as camera:
        result = calibrate_from_source(camera, board, "equidistant")
    # By eye, the circle ends 310 to 320 px from the middle; the picture's farthest corner lies 511 px off.
    assert 300.0 < result.coverage.picture_radius_px < 330.0
    # Published and measured by others: 190.0 ± 0.2 px, RMS 0.216 px on all corners.
    assert result.calibration.lens.fx_px == pytest.approx(190.0, abs=1.0)
    assert result.all_corners.rms_px == pytest.approx(0.21, abs=0.02)
