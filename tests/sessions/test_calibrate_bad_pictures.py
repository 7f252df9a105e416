"""Pictures that look fine one by one and make no calibration together: ``uvgs calibrate`` says so."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.sessions import test_calibrate_command as pictures
from tests.sessions.test_calibrate_command import BOARD, FOCAL, draw, run
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.store.boards import read_board

pytestmark = pytest.mark.opencv

Picture = Callable[[int, np.random.Generator], np.ndarray]


def place(i: int, rng: np.random.Generator, tilt_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Attitude and place of the board, each to another side of the picture."""
    R = so3_exp(np.array([*rng.uniform(-tilt_rad, tilt_rad, 2), rng.uniform(-0.2, 0.2)]))
    side = 0.06 * np.array([i % 3 - 1, i // 3 % 3 - 1])
    centre = np.array([*(side + rng.uniform(-0.015, 0.015, 2)), rng.uniform(0.42, 0.55)])
    return R, centre - R @ read_board(BOARD).points_m.mean(axis=0)


def fronto_parallel(i: int, rng: np.random.Generator) -> np.ndarray:
    return draw(read_board(BOARD), *place(i, rng, 0.0))


def one_pose(_: int, rng: np.random.Generator) -> np.ndarray:
    image = draw(read_board(BOARD), *place(4, np.random.default_rng(1), 0.6))
    return np.clip(image + rng.normal(0.0, 2.0, image.shape), 0, 255).astype(np.uint8)


def moving_focus(i: int, rng: np.random.Generator) -> np.ndarray:
    """The focal length grows by two percent over the pictures."""
    pictures.FOCAL = FOCAL * (1.0 + 0.02 * i / 15.0)
    try:
        return draw(read_board(BOARD), *place(i, rng, 0.6))
    finally:
        pictures.FOCAL = FOCAL


@pytest.mark.parametrize(
    ("picture", "count", "code", "said"),
    [
        (fronto_parallel, 6, 3, "the same attitude: tilt it in several directions"),
        (one_pose, 6, 3, "the same attitude: tilt it in several directions"),
        (moving_focus, 16, 1, "the focus moved"),
    ],
)
def test_sets_that_cannot_tell_are_refused(
    picture: Picture, count: int, code: int, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(5)
    for i in range(count):
        cv2.imwrite(str(tmp_path / f"v{i:02d}.png"), picture(i, rng))
    out = tmp_path / "camera.yaml"
    assert run("calibrate", f"images:{tmp_path}", "--board", BOARD, "--out", out, "--quiet") == code
    shown = capsys.readouterr()
    assert said in " ".join((shown.out + shown.err).split())
    assert not out.exists()
