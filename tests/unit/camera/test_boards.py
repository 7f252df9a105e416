"""Boards: their points, what is found in drawn pictures, and every misfit by its name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from uvgs_bench.camera.board_chessboard import _find_by_sectors, local_noise_px
from uvgs_bench.camera.boards import (
    BOARDS,
    WITH_MARKERS,
    Board,
    BoardMiss,
    BoardView,
    board_texture,
    find_board,
    is_worth_a_search,
    symmetry,
)
from uvgs_bench.errors import CalibrationError, ConfigError
from uvgs_bench.store.boards import read_board

pytestmark = pytest.mark.opencv

REPOSITORY = Path(__file__).parents[3]
CHESS = Board("chess", "chessboard", 9, 6, 0.025)
CHARUCO = Board("charuco", "charuco", 9, 6, 0.030, 0.022, "DICT_5X5_100")
# A tilted view of the board plane (m) in a 1280x960 picture (px).
H = np.array([[2800.0, -420.0, 300.0], [260.0, 2900.0, 250.0], [0.35, 0.6, 1.0]])


def picture(board: Board, view: np.ndarray = H, size: tuple[int, int] = (1280, 960)) -> np.ndarray:
    """The board as a pinhole camera sees it: four times over-sampled, so that edges are shaded truly."""
    texture, px_m, origin = board_texture(board, 64)
    fine = 4
    to_metres = np.array([[px_m, 0, origin[0]], [0, px_m, origin[1]], [0, 0, 1.0]])
    # Pixel centres: fine pixel f lies at (f + 0.5) / fine - 0.5.
    to_fine = np.array([[fine, 0, 0.5 * fine - 0.5], [0, fine, 0.5 * fine - 0.5], [0, 0, 1.0]])
    smooth = cv2.GaussianBlur(texture, (0, 0), 1.0)
    large = cv2.warpPerspective(
        smooth, to_fine @ view @ to_metres, (size[0] * fine, size[1] * fine), flags=cv2.INTER_LINEAR, borderValue=255
    )
    return cv2.GaussianBlur(cv2.resize(large, size, interpolation=cv2.INTER_AREA), (0, 0), 0.7)


def truth(view_m: np.ndarray, view: np.ndarray = H) -> np.ndarray:
    mapped = np.column_stack([view_m[:, :2], np.ones(len(view_m))]) @ view.T
    return mapped[:, :2] / mapped[:, 2:]


@pytest.mark.parametrize("board", [CHESS, CHARUCO])
def test_corners_of_a_drawn_board_lie_where_they_should(board):
    view = find_board(picture(board), board, "drawn")
    assert isinstance(view, BoardView)
    assert (view.name, view.width_px, view.height_px) == ("drawn", 1280, 960)
    assert len(view.px) == len(board.points_m)
    error = np.linalg.norm(view.px - truth(view.board_m), axis=1)
    # 0.1 px: corner refinement in a noise-free picture with 8-bit shading and aliasing of the texture.
    assert error.max() < 0.1
    # A constant shift would be an error of the pixel convention: half a pixel, not hundredths.
    assert np.abs((view.px - truth(view.board_m)).mean(axis=0)).max() < 0.02


@pytest.mark.parametrize("board", [CHESS, CHARUCO])
def test_colour_and_sixteen_bit_pictures_give_the_same_corners(board):
    grey = picture(board)
    plain = find_board(grey, board)
    colour = find_board(np.dstack([grey] * 3), board)
    deep = find_board(grey.astype(np.uint16) * 16, board)
    assert isinstance(plain, BoardView)
    assert isinstance(colour, BoardView)
    assert isinstance(deep, BoardView)
    np.testing.assert_allclose(colour.px, plain.px, atol=1e-6)
    # Stretching to the range of the picture changes grey values a little, corners by less than 0.02 px.
    np.testing.assert_allclose(deep.px, plain.px, atol=0.02)


@pytest.mark.parametrize("kind", list(BOARDS))
def test_every_kind_has_points_on_its_plane_and_a_drawing(kind):
    marker_m = 0.015 if kind in WITH_MARKERS else 0.0
    board = Board("b", kind, 5, 4, 0.02, marker_m, "DICT_4X4_50", diameter_m=0.01)
    assert board.points_m.shape[1] == 3
    assert (board.points_m[:, 2] == 0.0).all()
    along = board.points_m[board.points_m[:, 1] == board.points_m[-2, 1], 0]
    pitch = 0.04 if kind == "asymmetric_circles" else 0.02
    # A grid of tags has two corners in each step.
    stride = 2 if kind == "aprilgrid" else 1
    np.testing.assert_allclose(along[stride:] - along[:-stride], pitch, atol=1e-12)
    texture, px_m, _ = board_texture(board, 32)
    assert px_m == pytest.approx(0.02 / 32)
    assert texture.dtype == np.uint8


@pytest.mark.parametrize("angle_deg", [0.0, 90.0, 180.0, 270.0])
def test_chessboard_upside_down_is_never_taken_for_mirrored(angle_deg):
    a = np.deg2rad(angle_deg)
    turn = np.array([[np.cos(a), -np.sin(a), 640.0], [np.sin(a), np.cos(a), 480.0], [0, 0, 1.0]])
    centre = np.array([[2800.0, 0, -280.0], [0, 2800.0, -175.0], [0, 0, 1.0]])
    assert isinstance(find_board(picture(CHESS, turn @ centre), CHESS), BoardView)


@pytest.mark.parametrize("angle_deg", [0.0, 90.0, 180.0, 270.0])
def test_first_corner_is_the_one_at_the_black_end_however_the_board_is_turned(angle_deg):
    a = np.deg2rad(angle_deg)
    turn = np.array([[np.cos(a), -np.sin(a), 640.0], [np.sin(a), np.cos(a), 480.0], [0, 0, 1.0]])
    view = turn @ np.array([[2800.0, 0, -280.0], [0, 2800.0, -175.0], [0, 0, 1.0]])
    assert symmetry(CHESS) == ""
    found = find_board(picture(CHESS, view), CHESS)
    assert isinstance(found, BoardView)
    # Corner by corner: half a square is 40 px.
    assert np.linalg.norm(found.px - truth(found.board_m, view), axis=1).max() < 0.2


@pytest.mark.parametrize(
    ("kind", "columns", "rows", "turn"),
    [
        ("chessboard", 9, 6, ""),
        ("chessboard", 8, 6, "half turn"),
        ("chessboard", 7, 7, "half turn"),
        ("chessboard", 6, 6, "quarter turn"),
        ("circles", 9, 6, "half turn"),
        ("circles", 6, 6, "quarter turn"),
        ("asymmetric_circles", 4, 11, ""),
        ("asymmetric_circles", 4, 10, "half turn"),
        ("led_grid", 6, 6, ""),
    ],
)
def test_turns_after_which_a_board_looks_the_same(kind, columns, rows, turn):
    board = Board("b", kind, columns, rows, 0.03, diameter_m=0.01 if kind != "chessboard" else 0.0)
    assert symmetry(board) == turn
    # By the drawing: the printed board, turned.
    drawn = board_texture(board, 16)[0]
    if kind in ("chessboard", "circles"):
        # Discs fall differently on their pixels: a shifted disc would change a tenth of the picture.
        half = np.mean(drawn != np.rot90(drawn, 2)) < 0.03
        quarter = drawn.shape[0] == drawn.shape[1] and np.mean(drawn != np.rot90(drawn)) < 0.03
        assert ("quarter turn" if quarter else "half turn" if half else "") == turn


def test_noisy_corners_are_looked_for_again_and_the_quieter_kept():
    rng = np.random.default_rng(5)
    image = cv2.GaussianBlur(picture(CHESS), (0, 0), 3.0).astype(np.float64)
    noisy = np.clip(0.15 * image + 100.0 + rng.normal(0.0, 10.0, image.shape), 0, 255).astype(np.uint8)
    found = find_board(noisy, CHESS)
    assert isinstance(found, BoardView)
    sectors = _find_by_sectors(noisy, 9, 6)
    error = np.sqrt((np.linalg.norm(found.px - truth(found.board_m), axis=1) ** 2).mean())
    both = [found.px.reshape(6, 9, 2), sectors.reshape(6, 9, 2)]
    assert local_noise_px(both[0]) <= local_noise_px(both[1]) + 1e-9
    # The noise that is told is that of the corners: a third of it by chance, for 28 blocks that share corners.
    assert local_noise_px(both[0]) == pytest.approx(error / np.sqrt(2.0), rel=0.35)


def test_a_glance_passes_boards_on_and_spares_the_search_of_other_pictures():
    rng = np.random.default_rng(7)
    far = np.diag([0.25, 0.25, 1.0]) @ H
    for image in (picture(CHESS), picture(CHESS, far, (640, 480)), picture(CHESS, far)):
        assert is_worth_a_search(image, CHESS)
    blurred = cv2.GaussianBlur(picture(CHESS), (0, 0), 3.0).astype(np.float64)
    assert is_worth_a_search(
        np.clip(0.3 * blurred + rng.normal(80.0, 4.0, blurred.shape), 0, 255).astype(np.uint8), CHESS
    )
    noise = rng.normal(100.0, 5.0, (960, 1280)).clip(0, 255).astype(np.uint8)
    slope = np.tile(np.linspace(0.0, 255.0, 1280), (960, 1)).astype(np.uint8)
    for image in (noise, slope, np.full((960, 1280), 20, np.uint8)):
        assert not is_worth_a_search(image, CHESS)
        # Markers are searched quickly: no glance is needed.
        assert is_worth_a_search(image, CHARUCO)


def reason(image: np.ndarray, board: Board) -> str:
    answer = find_board(image, board, "x")
    assert isinstance(answer, BoardMiss), answer
    assert answer.detail
    return answer.reason


@pytest.mark.parametrize(("columns", "rows"), [(8, 5), (8, 6), (9, 5), (6, 4)])
def test_smaller_pattern_inside_the_real_board_is_not_believed(columns, rows):
    declared = replace(CHESS, columns=columns, rows=rows)
    assert reason(picture(CHESS), declared) in ("board_larger_than_declared", "board_mismatch")


def test_smaller_pattern_is_named_with_its_side():
    assert reason(picture(CHESS), replace(CHESS, columns=8, rows=5)) == "board_larger_than_declared"


def test_squares_counted_instead_of_corners_are_named():
    answer = find_board(picture(CHESS), replace(CHESS, columns=10, rows=7))
    assert isinstance(answer, BoardMiss)
    assert answer.reason == "board_smaller_than_declared"
    assert "9x6" in answer.detail


def test_empty_and_covered_pictures_are_misses():
    assert reason(np.full((480, 640), 127, np.uint8), CHESS) == "board_not_found"
    assert reason(np.full((480, 640), 127, np.uint8), CHARUCO) == "no_markers"
    covered = picture(CHESS)
    covered[:, 500:620] = 255
    assert reason(covered, CHESS) == "board_not_found"


def test_half_covered_charuco_still_gives_its_visible_corners():
    covered = picture(CHARUCO)
    covered[:, :555] = 255
    view = find_board(covered, CHARUCO)
    assert isinstance(view, BoardView)
    assert 8 <= len(view.px) < 40
    assert np.linalg.norm(view.px - truth(view.board_m), axis=1).max() < 0.15  # px; as above, nearer to the cover


def test_charuco_misfits_are_named():
    grey = picture(CHARUCO)
    assert reason(grey, replace(CHARUCO, columns=6, rows=5)) in ("board_larger_than_declared", "board_mismatch")
    assert reason(np.ascontiguousarray(grey[:, ::-1]), CHARUCO) == "mirrored"
    assert reason(255 - grey, CHARUCO) == "inverted"
    assert reason(grey, replace(CHARUCO, dictionary="DICT_7X7_50")) == "no_markers"
    even = replace(CHARUCO, columns=8, rows=6)
    assert reason(picture(even), replace(even, legacy=True)) in ("legacy_pattern", "board_mismatch", "no_corners")


@pytest.mark.parametrize(
    "board", [CHARUCO, Board("april", "aprilgrid", 5, 4, 0.045, 0.035)], ids=["charuco", "aprilgrid"]
)
@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_markers_of_another_share_than_declared_are_named(board, factor):
    grey = picture(board)
    assert isinstance(find_board(grey, board), BoardView)
    # Five percent: a square of 30 mm declared as 31.5 mm, or a marker measured a millimetre wrong.
    wrong = replace(board, square_m=board.square_m * factor)
    answer = find_board(grey, wrong, "x")
    assert isinstance(answer, BoardMiss)
    assert answer.reason == "marker_ratio"
    seen = float(answer.detail.split()[2])
    # A hundredth of the share: a quarter of a pixel of marker or square.
    assert seen == pytest.approx(board.marker_m / board.square_m, rel=0.01)


def test_impossible_boards_are_refused():
    with pytest.raises(CalibrationError, match="unknown board kind"):
        Board("b", "checker", 9, 6, 0.025)
    with pytest.raises(CalibrationError, match="3 columns"):
        Board("b", "chessboard", 2, 6, 0.025)
    with pytest.raises(CalibrationError, match="marker side"):
        Board("b", "charuco", 9, 6, 0.025, 0.03, "DICT_5X5_100")
    with pytest.raises(CalibrationError, match="unknown marker dictionary"):
        find_board(np.zeros((100, 100), np.uint8), replace(CHARUCO, dictionary="5X5"))
    with pytest.raises(CalibrationError, match="only 50"):
        find_board(np.zeros((100, 100), np.uint8), replace(CHARUCO, columns=12, rows=10, dictionary="DICT_4X4_50"))


@pytest.mark.parametrize("path", sorted((REPOSITORY / "calib" / "boards").glob("*.toml")), ids=lambda path: path.stem)
def test_example_boards_can_be_read(path):
    board = read_board(path)
    assert board.name == path.stem
    assert len(board.points_m) in (36, 40, 44, 54, 144)


@pytest.mark.parametrize(
    ("old", "new", "key", "said"),
    [
        ("square_mm = 30.0", "square_m = 0.03", "square_m", "did you mean 'square_mm'"),
        ('kind = "charuco"', 'kind = "charucco"', "kind", "did you mean 'charuco'"),
        ("marker_mm = 22.0", "", "marker_mm", "needs this key"),
        ("marker_mm = 22.0", "marker_mm = 32.0", "marker_mm", "must be less"),
        ('kind = "charuco"', 'kind = "chessboard"', "marker_mm", "no markers"),
        ("schema = 1", "schema = 9", "schema", "expected 1"),
    ],
)
def test_broken_board_files_are_refused_by_key(tmp_path, old, new, key, said):
    text = (REPOSITORY / "calib" / "boards" / "charuco_9x6.toml").read_text()
    assert old in text
    path = tmp_path / "b.toml"
    path.write_text(text.replace(old, new))
    with pytest.raises(ConfigError, match=said) as caught:
        read_board(path)
    assert caught.value.key == key
