"""Circles and lights seen by the simulated camera: found where they truly are, bias of the circles taken out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.camera import Board, BoardView, Lens, calibrate, find_board
from uvgs_bench.camera.board_circles import circle_centre_bias, corrected_view
from uvgs_bench.camera.boards import BoardMiss, board_texture
from uvgs_bench.devices.sim.bench import true_lens
from uvgs_bench.devices.sim.board_views import SimulatedBoardSource
from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_exp

pytestmark = pytest.mark.opencv

CIRCLES = Board("c", "circles", 9, 6, 0.025, diameter_m=0.018)
STAGGERED = Board("a", "asymmetric_circles", 4, 11, 0.020, diameter_m=0.016)
LIGHTS = Board("l", "led_grid", 7, 5, 0.040, diameter_m=0.006)
TRUTH = SimulatedTruth()
LENS = true_lens(TRUTH)
COUNT = 8


@pytest.fixture(scope="module", params=[CIRCLES, STAGGERED, LIGHTS], ids=lambda board: board.kind)
def seen(request):
    board = request.param
    source = SimulatedBoardSource(TRUTH, board, COUNT, seed=4)
    pictures = [capture.image for capture in source]
    return board, pictures, source.true_camera_from_board


def half_turned(board: Board, view: BoardView, pose: Pose) -> Pose:
    """A board that looks the same after half a turn may be found turned."""
    if board.kind != "circles":
        return pose
    middle = board.points_m.mean(axis=0)
    turn = np.diag([-1.0, -1.0, 1.0])
    other = Pose(pose.R @ turn, pose.t_m + pose.R @ (middle - turn @ middle), "camera", "board")
    error = [np.abs(view.px - LENS.project(p.apply(view.board_m))).max() for p in (pose, other)]
    return pose if error[0] < error[1] else other


def test_points_are_found_where_they_are(seen):
    board, pictures, poses = seen
    plain, corrected = [], []
    for image, pose in zip(pictures, poses, strict=True):
        view = find_board(image, board)
        assert isinstance(view, BoardView), view
        assert len(view.px) == len(board.points_m)
        at = half_turned(board, view, pose)
        plain.append(view.px - LENS.project(at.apply(view.board_m)))
        better = corrected_view(view, LENS, at, board.diameter_m)
        corrected.append(better.px - LENS.project(at.apply(view.board_m)))
    rms = [float(np.sqrt((np.concatenate(e) ** 2).sum(axis=1).mean())) for e in (plain, corrected)]
    # Noise and 8-bit steps over hundreds of pixels leave hundredths of a pixel; small lights a little more.
    assert rms[1] < 0.04
    if board.kind != "led_grid":
        assert rms[0] > 1.5 * rms[1]


def test_a_calibration_repeated_with_corrected_centres_fits_better(seen):
    board, pictures, _ = seen
    if board.kind == "led_grid":
        pytest.skip("lights are too small to have a bias")
    views = [find_board(image, board, str(i)) for i, image in enumerate(pictures)]
    assert all(isinstance(view, BoardView) for view in views)
    first = calibrate(views, LENS.model, reject_outliers=False)
    again = calibrate(
        [
            corrected_view(view, first.calibration.lens, pose, board.diameter_m)
            for view, pose in zip(views, first.camera_from_board, strict=True)
        ],
        LENS.model,
        reject_outliers=False,
    )
    assert again.calibration.rms_px < first.calibration.rms_px
    sigmas = again.calibration.sigmas
    assert sigmas is not None
    # Five deviations: systematic errors of hundredths of a pixel are not all noise.
    assert (np.abs(again.calibration.lens.parameters - LENS.parameters)[:2] < 5.0 * sigmas[:2]).all()


def test_the_bias_of_a_pinhole_is_that_of_the_ellipse():
    """Against the closed form: the centre of the conic that a circle projects to."""
    lens = Lens("plumb_bob", 1280, 960, np.array([1000.0, 1000.0, 640.0, 480.0, 0, 0, 0, 0, 0]))
    pose = Pose(so3_exp(np.array([0.5, 0.3, 0.1])), np.array([0.02, -0.03, 0.4]), "camera", "board")
    centre, radius = np.array([0.01, 0.02]), 0.01
    a, b = centre
    circle = np.array([[1, 0, -a], [0, 1, -b], [-a, -b, a * a + b * b - radius**2]])
    H = lens.camera_matrix() @ np.column_stack([pose.R[:, 0], pose.R[:, 1], pose.t_m])
    inverse = np.linalg.inv(H)
    conic = inverse.T @ circle @ inverse
    ellipse = np.linalg.solve(conic[:2, :2], -conic[:2, 2])
    middle = np.array([[a, b, 0.0]])
    expected = ellipse - lens.project(pose.apply(middle))[0]
    found = circle_centre_bias(lens, pose, middle, 2.0 * radius)[0]
    assert np.linalg.norm(expected) > 0.05
    # The quadrature is exact to the seventh power of size over distance.
    np.testing.assert_allclose(found, expected, atol=1e-6)


def miss(image: np.ndarray, board: Board) -> str:
    answer = find_board(image, board)
    assert isinstance(answer, BoardMiss), answer
    return answer.reason


def test_what_does_not_fit_is_named(seen):
    board, pictures, _ = seen
    image = pictures[0]
    mirrored = np.ascontiguousarray(image[:, ::-1])
    if board.kind == "led_grid":
        assert miss(mirrored, board) == "mirrored"
        marker = find_board(image, board).px[-1].round().astype(int)
        hidden = image.copy()
        hidden[marker[1] - 6 : marker[1] + 7, marker[0] - 6 : marker[0] + 7] = np.median(image)
        assert miss(hidden, board) == "no_marker"
        inner = find_board(image, board).px[17].round().astype(int)
        dark = image.copy()
        dark[inner[1] - 6 : inner[1] + 7, inner[0] - 6 : inner[0] + 7] = np.median(image)
        fewer = find_board(dark, board)
        assert isinstance(fewer, BoardView)
        assert len(fewer.px) == len(board.points_m) - 1
        assert miss(np.zeros_like(image), board) == "no_lights"
    else:
        assert miss(255 - image, board) == "inverted"
        assert miss(np.full_like(image, 127), board) == "board_not_found"
    assert miss(image, replace(board, columns=board.columns - 1)) == "board_larger_than_declared"
    assert miss(image, replace(board, columns=board.columns + 1)) == "board_smaller_than_declared"


def test_tags_of_an_aprilgrid_are_found_and_numbered_as_in_kalibr():
    board = Board("g", "aprilgrid", 6, 4, 0.035 * 1.3, 0.035)
    # Kalibr: point 0 is the lower left corner of tag 0 at the lower left; y is down in the board frame.
    bottom = 3 * 0.035 * 1.3 + 0.035
    np.testing.assert_allclose(board.points_m[0], [0.0, bottom, 0.0], atol=1e-12)
    np.testing.assert_allclose(board.points_m[1], [0.035, bottom, 0.0], atol=1e-12)
    np.testing.assert_allclose(board.points_m[12], [0.0, bottom - 0.035, 0.0], atol=1e-12)
    source = SimulatedBoardSource(TRUTH, board, 4, seed=4)
    image = np.empty(0)
    for capture, pose in zip(source, source.true_camera_from_board, strict=True):
        image = capture.image
        view = find_board(image, board)
        assert isinstance(view, BoardView), view
        assert len(view.px) == 96
        error = np.linalg.norm(view.px - LENS.project(pose.apply(view.board_m)), axis=1)
        # 0.04 px RMS measured; a corner of another tag or another turn would be tens of pixels off.
        assert error.max() < 0.2
    assert miss(255 - image, board) == "inverted"
    assert miss(np.ascontiguousarray(image[:, ::-1]), board) == "mirrored"
    assert miss(image, replace(board, columns=5)) == "board_larger_than_declared"
    assert miss(image, replace(board, columns=7)) == "board_mismatch"
    assert miss(np.full_like(image, 127), board) == "no_markers"
    edge = int(view.px[:, 1].mean())
    covered = image.copy()
    covered[:edge] = 127
    part = find_board(covered, board)
    assert isinstance(part, BoardView)
    assert 8 <= len(part.px) < 96
    # A corner that the cover cuts into is off by a pixel or two; outliers are for the calibration to set aside.
    whole = part.px[:, 1] > edge + 15
    error = np.linalg.norm(part.px - LENS.project(pose.apply(part.board_m)), axis=1)
    assert error[whole].max() < 0.2
    assert error.max() < 5.0


def test_a_tag_stands_as_its_authors_print_it():
    """Against an independent reader: its first corner is the lower left one of an upright tag."""
    apriltags = pytest.importorskip("pupil_apriltags")
    board = Board("g", "aprilgrid", 3, 3, 0.045, 0.035)
    texture, _, _ = board_texture(board, 120)
    # The reader wants borders of one cell: cut the outer cell away from the first tag, at the lower left.
    side = round(120 * 0.035 / 0.045)
    cell = side / 10
    height = texture.shape[0]
    gap = round(120 * 0.010 / 0.045)
    bottom, left = height - 120 - gap, 120 + gap
    tag = texture[round(bottom - side + cell) : round(bottom - cell), round(left + cell) : round(left + side - cell)]
    (found,) = apriltags.Detector(families="tag36h11").detect(
        np.pad(np.ascontiguousarray(tag), 40, constant_values=255)
    )
    assert found.tag_id == 0
    centre = found.corners.mean(axis=0)
    assert found.corners[0][0] < centre[0]
    assert found.corners[0][1] > centre[1]


@pytest.mark.parametrize("turn", [0, 1, 2, 3])
def test_lights_turned_by_any_quarter_keep_their_names(turn):
    source = SimulatedBoardSource(TRUTH, LIGHTS, 1, seed=2)
    image = next(iter(source)).image
    plain = find_board(image, LIGHTS)
    turned = find_board(np.ascontiguousarray(np.rot90(image, turn)), LIGHTS)
    assert isinstance(plain, BoardView)
    assert isinstance(turned, BoardView)
    height, width = image.shape
    u, v = plain.px.T
    expected = [(u, v), (v, width - 1 - u), (width - 1 - u, height - 1 - v), (height - 1 - v, u)][turn]
    # The same pixels in another order of summation.
    np.testing.assert_allclose(turned.px, np.column_stack(expected), atol=1e-6)
    np.testing.assert_array_equal(turned.board_m, plain.board_m)
