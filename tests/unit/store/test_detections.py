"""Found boards that are kept: the same answer for the same question, none for another, and no trust in broken files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.camera import Board, BoardView
from uvgs_bench.camera.boards import BoardMiss
from uvgs_bench.store.detections import cache_folder, detection_key, read_detection, write_detection

pytestmark = pytest.mark.opencv

BOARD = Board("b", "chessboard", 9, 6, 0.025)
IMAGE = np.random.default_rng(1).integers(0, 255, (48, 64), dtype=np.uint8)


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def test_a_view_comes_back_to_the_last_digit_under_its_new_name():
    key = detection_key(IMAGE, BOARD)
    assert read_detection(key) is None
    px = np.random.default_rng(2).uniform(0.0, 60.0, (54, 2))
    write_detection(key, BoardView("then", px, BOARD.points_m, 64, 48))
    kept = read_detection(key, "now")
    assert isinstance(kept, BoardView)
    assert (kept.name, kept.width_px, kept.height_px) == ("now", 64, 48)
    np.testing.assert_array_equal(kept.px, px)
    np.testing.assert_array_equal(kept.board_m, BOARD.points_m)


def test_a_miss_is_kept_too():
    key = detection_key(IMAGE, BOARD)
    write_detection(key, BoardMiss("then", "mirrored", "why"))
    assert read_detection(key, "now") == BoardMiss("now", "mirrored", "why")


def test_another_picture_or_board_is_another_key():
    changed = IMAGE.copy()
    changed[0, 0] ^= 1
    others = [
        detection_key(changed, BOARD),
        detection_key(IMAGE.reshape(64, 48), BOARD),
        detection_key(IMAGE.astype(np.uint16), BOARD),
        detection_key(IMAGE, replace(BOARD, columns=8)),
        detection_key(IMAGE, replace(BOARD, square_m=0.026)),
    ]
    assert detection_key(IMAGE, BOARD) not in others
    assert len(set(others)) == 5
    assert detection_key(IMAGE, replace(BOARD, name="other")) == detection_key(IMAGE, BOARD)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "null", '{"key": "other"}', "[" * 100_000, '{"key": "KEY", "px": [[1]], "board_m": []}']
)
def test_broken_entries_are_as_good_as_none(text):
    key = detection_key(IMAGE, BOARD)
    cache_folder().mkdir(parents=True)
    (cache_folder() / f"{key}.json").write_text(text.replace("KEY", key))
    assert read_detection(key) is None


def test_a_folder_that_cannot_be_written_is_no_error(tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    key = detection_key(IMAGE, BOARD)
    write_detection(key, BoardMiss("", "r", "d"))
    assert read_detection(key) is None


def test_a_relative_cache_home_is_ignored(monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "here")
    assert cache_folder().is_absolute()
