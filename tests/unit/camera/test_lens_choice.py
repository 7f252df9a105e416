"""Lenses compared on pictures they have not seen."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.camera import BoardView, Lens
from uvgs_bench.camera.boards import Board
from uvgs_bench.camera.lens_choice import choose_lens
from uvgs_bench.errors import TooFewViews
from uvgs_bench.geometry.se3 import so3_exp

CHESS = Board("chess", "chessboard", 9, 6, 0.025)
# A fisheye no fov lens describes: its radial map bends back.
BENT = Lens("equidistant", 1280, 960, np.array([500.0, 501.0, 645.0, 470.0, -0.12, 0.06, -0.02, 0.0]))
FOV = Lens("fov", 1280, 960, np.array([608.8, 607.6, 632.5, 489.0, 0.6]))


def views(lens: Lens, count: int) -> list[BoardView]:
    rng = np.random.default_rng(8)
    centred = CHESS.points_m - CHESS.points_m.mean(axis=0)
    found: list[BoardView] = []
    while len(found) < count:
        axis = rng.normal(size=3)
        ray = lens.unproject(rng.uniform([150.0, 120.0], [1130.0, 840.0]))[0]
        R = so3_exp(axis / np.linalg.norm(axis) * rng.uniform(0.2, 0.7))
        px = lens.project(centred @ R.T + ray * rng.uniform(0.2, 0.3))
        if lens.contains(px, 3.0).all():
            px = px + rng.normal(0.0, 0.1, px.shape)
            found.append(BoardView(f"v{len(found):02d}", px, CHESS.points_m, 1280, 960))
    return found


def test_a_poor_lens_is_called_not_enough():
    choice = choose_lens(views(BENT, 14), ("fov", "equidistant"))
    assert choice.model == "equidistant"
    remarks = {trial.model: trial.remark for trial in choice.trials}
    assert remarks["fov"].startswith("fov is not enough: unseen pictures")
    assert remarks["equidistant"] == ""


def test_the_smallest_lens_that_is_enough_is_chosen():
    choice = choose_lens(views(FOV, 14), ("equidistant", "fov"))
    assert choice.model == "fov"
    assert [trial.model for trial in choice.trials] == ["fov", "equidistant"]
    # More coefficients fit their own pictures at least as well, to a part in a thousand here.
    assert choice.trials[1].rms_px < 1.001 * choice.trials[0].rms_px


def test_too_few_views_cannot_choose():
    with pytest.raises(TooFewViews, match="3 views are too few to compare"):
        choose_lens(views(FOV, 3), ("fov",))
