"""Calibration against OpenCV and against measured figures of real photographs; refusals and warnings by name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uvgs_bench.camera import BoardView, CalibrationResult, Lens, calibrate, find_board
from uvgs_bench.camera.boards import Board
from uvgs_bench.camera.bundle import Corners
from uvgs_bench.camera.bundle_start import planar_poses
from uvgs_bench.errors import CalibrationError, ExitCode, TooFewViews
from uvgs_bench.geometry.se3 import so3_exp

PHOTOGRAPHS = Path(__file__).parents[4] / "shared" / "data" / "chessboard_opencv"
CHESS = Board("chess", "chessboard", 9, 6, 0.025)
# Six corners of one column near the middle, all others where a lens of f = 100 px, w = 0.9 sees nothing.
LINE_AHEAD = np.array(
    [
        [640.0 + 5.0 * row, 400.0 + 30.0 * row] if column == 0 else [1200.0, 900.0]
        for row in range(6)
        for column in range(9)
    ]
)
TRUE = Lens("plumb_bob", 1280, 960, np.array([1000.0, 1003.0, 645.0, 470.0, -0.2, 0.08, 8e-4, -5e-4, 0.01]))


def simulated(
    count: int, noise_px: float, seed: int = 0, lens: Lens = TRUE, tilt_rad: float = 0.7, distance_m: float = 0.5
) -> list[BoardView]:
    """Views with every corner in the picture."""
    rng = np.random.default_rng(seed)
    centred = CHESS.points_m - CHESS.points_m.mean(axis=0)
    views: list[BoardView] = []
    while len(views) < count:
        axis = rng.normal(size=3) * [1, 1, 0.3]
        R = so3_exp(axis / np.linalg.norm(axis) * rng.uniform(0.4, 1.0) * tilt_rad)
        depth = distance_m * rng.uniform(0.8, 1.3)
        points = centred @ R.T + np.array([*rng.uniform(-0.35, 0.35, 2) * depth, depth])
        px = lens.project(points)
        if lens.contains(px).all():
            px = px + rng.normal(0.0, noise_px, px.shape)
            views.append(BoardView(f"v{len(views):02d}", px, CHESS.points_m, lens.width_px, lens.height_px))
    return views


def opencv(views: list[BoardView]) -> tuple[float, np.ndarray, np.ndarray]:
    import cv2

    rms, K, d, _, _, sigmas, *_ = cv2.calibrateCameraExtended(
        [view.board_m.astype(np.float32) for view in views],
        [view.px.astype(np.float32).reshape(-1, 1, 2) for view in views],
        (views[0].width_px, views[0].height_px),
        None,
        None,
        criteria=(3, 300, 1e-15),
    )
    parameters = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.ravel(d)[:5]])
    return rms, parameters, np.ravel(sigmas)[:9]


@pytest.mark.opencv
def test_same_minimum_and_deviations_as_opencv():
    views = simulated(12, 0.1)
    # OpenCV keeps corners in single precision; so does the comparison.
    views = [replace(view, px=view.px.astype(np.float32)) for view in views]
    mine = calibrate(views, "plumb_bob", reject_outliers=False).calibration
    rms, parameters, sigmas = opencv(views)
    assert mine.sigmas is not None
    assert mine.rms_px == pytest.approx(rms, rel=1e-5)
    # A thousandth of a standard deviation: both stop at the minimum of the same cost.
    np.testing.assert_array_less(np.abs(mine.lens.parameters - parameters), 2e-3 * sigmas)
    np.testing.assert_allclose(mine.sigmas, sigmas, rtol=0.01)


def photographs(side: str) -> list[BoardView]:
    if not PHOTOGRAPHS.is_dir():
        pytest.skip(f"no photographs at {PHOTOGRAPHS}: figures of real pictures are not checked")
    import cv2

    views = [
        find_board(cv2.imread(str(path), 0), CHESS, path.name) for path in sorted(PHOTOGRAPHS.glob(f"{side}*.jpg"))
    ]
    found = [view for view in views if isinstance(view, BoardView)]
    assert len(found) == len(views) == 13
    return found


@pytest.fixture(scope="module")
def left() -> list[BoardView]:
    return photographs("left")


@pytest.mark.opencv
@pytest.mark.shared_data
def test_left_photographs_give_the_measured_figures(left):
    fitted = calibrate(left, "plumb_bob", reject_outliers=False).calibration
    assert fitted.sigmas is not None
    # Half a unit of the last printed digit.
    assert fitted.rms_px == pytest.approx(0.2449, abs=5e-5)
    np.testing.assert_allclose(fitted.lens.parameters[:4], [533.966, 534.039, 342.913, 234.460], rtol=0, atol=6e-4)
    np.testing.assert_allclose(fitted.lens.coefficients, [-0.2729, -0.0175, 0.0013, -0.0001, 0.2282], rtol=0, atol=6e-5)
    np.testing.assert_allclose(fitted.sigmas[:4], [0.551, 0.578, 0.581, 0.640], rtol=0.01)
    rms, parameters, sigmas = opencv(left)
    assert fitted.rms_px == pytest.approx(rms, rel=1e-4)
    np.testing.assert_array_less(np.abs(fitted.lens.parameters - parameters), 0.01 * sigmas)
    np.testing.assert_allclose(fitted.sigmas, sigmas, rtol=0.01)


@pytest.mark.opencv
@pytest.mark.shared_data
def test_left_photographs_with_the_one_code_for_fisheye_and_fov(left):
    kb = calibrate(left, "equidistant", reject_outliers=False).calibration
    assert kb.rms_px == pytest.approx(0.2520, abs=6e-5)
    np.testing.assert_allclose(kb.lens.parameters[:4], [533.527, 533.831, 342.837, 233.791], rtol=0, atol=6e-4)
    fov = calibrate(left, "fov", reject_outliers=False).calibration
    assert fov.rms_px == pytest.approx(0.2540, abs=6e-5)
    np.testing.assert_allclose(fov.lens.parameters[:2], [499.514, 499.846], rtol=0, atol=6e-4)
    assert fov.lens.parameters[4] == pytest.approx(0.88338, abs=6e-6)


@pytest.mark.opencv
@pytest.mark.shared_data
def test_outliers_of_the_left_photographs_are_set_aside(left):
    result = calibrate(left, "plumb_bob")
    # Another program dropped 11 of 702 and came to 0.1194 px per axis, with the board allowed to bow.
    assert 8 <= len(result.rejected) <= 16
    assert result.calibration.rms_per_axis_px == pytest.approx(0.12, abs=0.01)
    assert result.all_corners.rms_px == pytest.approx(0.2449, abs=5e-5)
    assert result.rejected[0].residual_px == max(corner.residual_px for corner in result.rejected)


@pytest.mark.opencv
@pytest.mark.shared_data
def test_right_photographs_give_the_measured_figures():
    fitted = calibrate(photographs("right"), "plumb_bob", reject_outliers=False).calibration
    assert fitted.rms_px == pytest.approx(0.3348, abs=5e-5)
    np.testing.assert_allclose(fitted.lens.parameters[:4], [539.092, 538.582, 328.426, 247.845], rtol=0, atol=6e-4)
    np.testing.assert_allclose(fitted.lens.coefficients, [-0.2914, 0.1362, -0.0007, 0.0005, -0.0578], rtol=0, atol=6e-5)


@pytest.mark.opencv
@pytest.mark.shared_data
def test_coarse_grid_over_a_finer_board_is_never_believed():
    if not PHOTOGRAPHS.is_dir():
        pytest.skip(f"no photographs at {PHOTOGRAPHS}")
    import cv2

    wrong = replace(CHESS, columns=6, rows=4)
    answers = [find_board(cv2.imread(str(path), 0), wrong) for path in PHOTOGRAPHS.glob("*t*.jpg")]
    assert len(answers) == 26
    assert not any(isinstance(answer, BoardView) for answer in answers)


@pytest.mark.opencv
@pytest.mark.shared_data
@pytest.mark.parametrize(("columns", "rows"), [(8, 5), (8, 6), (9, 5), (10, 7)])
def test_wrong_board_size_is_noticed_on_photographs(columns, rows):
    if not PHOTOGRAPHS.is_dir():
        pytest.skip(f"no photographs at {PHOTOGRAPHS}")
    import cv2

    wrong = replace(CHESS, columns=columns, rows=rows)
    answers = [find_board(cv2.imread(str(PHOTOGRAPHS / f"left0{i}.jpg"), 0), wrong) for i in (1, 4)]
    said = "board_smaller_than_declared" if columns == 10 else "board_larger_than_declared"
    assert [getattr(answer, "reason", "found") for answer in answers] == [said] * 2


def spoiled(views: list[BoardView], count: int, seed: int = 3) -> tuple[list[BoardView], set[tuple[str, int]]]:
    rng = np.random.default_rng(seed)
    out, where = [], set()
    px = [view.px.copy() for view in views]
    while len(where) < count:
        i, j = int(rng.integers(len(views))), int(rng.integers(len(views[0].px)))
        if (views[i].name, j) not in where:
            angle = rng.uniform(0, 2 * np.pi)
            px[i][j] += rng.uniform(2.0, 9.0) * np.array([np.cos(angle), np.sin(angle)])
            where.add((views[i].name, j))
    out = [replace(view, px=moved) for view, moved in zip(views, px, strict=True)]
    return out, where


def test_gross_corners_are_set_aside_and_listed():
    views, where = spoiled(simulated(12, 0.1), 15)
    result = calibrate(views, "plumb_bob")
    listed = {(corner.view, corner.index) for corner in result.rejected}
    # All of them are 20 sigma off; of 633 good ones a few may cross 4 sigma of an estimated spread.
    assert where <= listed
    assert len(listed - where) <= 3
    assert result.calibration.rms_px == pytest.approx(0.1 * np.sqrt(2.0), rel=0.08)
    assert result.all_corners.rms_px is not None
    assert result.all_corners.rms_px > 0.5
    sigmas = result.calibration.sigmas
    assert sigmas is not None
    assert (np.abs(result.calibration.lens.parameters - TRUE.parameters) < 4.0 * sigmas).all()


def test_no_more_than_a_tenth_is_set_aside_and_that_is_said():
    views, _ = spoiled(simulated(12, 0.1), 120)
    result = calibrate(views, "plumb_bob")
    assert len(result.rejected) <= 64
    assert any("set aside, the most" in text for text in result.warnings)


def result_of(**changes: float) -> CalibrationResult:
    return calibrate(simulated(**{"count": 10, "noise_px": 0.1, **changes}), "plumb_bob")  # type: ignore[arg-type]


def test_good_views_carry_no_warning_and_a_held_out_error_near_the_noise():
    result = calibrate(simulated(15, 0.1), "plumb_bob")
    assert result.warnings == ()
    assert len(result.fold_rms_px) == 5
    # Poses from half the corners add a little to the noise of the other half.
    assert 0.1 * np.sqrt(2) < result.calibration.held_out_rms_px < 0.13 * np.sqrt(2)
    assert [pose.target + pose.source for pose in result.camera_from_board] == ["cameraboard"] * 15
    assert [len(part) for part in result.residuals_px] == [54] * 15


def test_few_and_flat_views_are_warned_of():
    assert any("only 5 views" in text for text in result_of(count=5).warnings)
    flat = calibrate(simulated(10, 0.05, tilt_rad=0.12), "fov")
    assert any("tilted" in text for text in flat.warnings)


def test_overfitting_shows_in_the_condition():
    result = calibrate(simulated(6, 0.2, distance_m=0.9), "rational_polynomial")
    assert any("cancel each other" in text for text in result.warnings)


def test_nothing_to_tell_parameters_apart_is_inconclusive():
    one = simulated(1, 0.0)[0]
    with pytest.raises(TooFewViews, match="same attitude"):
        calibrate([replace(one, name=f"v{i}") for i in range(6)], "plumb_bob")


def test_too_few_views_are_inconclusive():
    with pytest.raises(TooFewViews, match="2 usable views") as caught:
        calibrate(simulated(2, 0.1), "plumb_bob")
    assert caught.value.exit_code is ExitCode.INCONCLUSIVE


def test_pictures_of_two_sizes_are_refused_naming_both():
    views = simulated(4, 0.1)
    with pytest.raises(CalibrationError, match=r"v00 is 1280x960.*v02 is 640x480"):
        calibrate([*views[:2], replace(views[2], width_px=640, height_px=480)], "plumb_bob")


def test_unknown_model_is_refused():
    with pytest.raises(CalibrationError, match="unknown lens model 'pinhole'"):
        calibrate(simulated(4, 0.1), "pinhole")


def test_three_views_have_no_held_out_error():
    result = calibrate(simulated(3, 0.1), "fov")
    assert result.calibration.held_out_rms_px is None
    assert result.fold_rms_px.size == 0


def test_start_with_one_line_of_corners_ahead_is_passed_over():
    corners = Corners.of([replace(simulated(1, 0.0)[0], board_m=CHESS.points_m, px=LINE_AHEAD)])
    with pytest.raises(CalibrationError, match="one line"):
        planar_poses(Lens("fov", 1280, 960, np.array([100.0, 100.0, 640.0, 480.0, 0.9])), corners)
