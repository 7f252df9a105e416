"""A board is waved before a simulated live camera: views are taken by themselves until they are enough."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uvgs_bench.camera import Board, BoardView, Lens
from uvgs_bench.camera.guidance import TILTS, begin, consider, take
from uvgs_bench.cli.app import main
from uvgs_bench.cli.live_views import _panel
from uvgs_bench.devices.sim import waved_board
from uvgs_bench.devices.sim.board_views import place_board
from uvgs_bench.devices.sim.truth import SimulatedTruth, TrueCamera
from uvgs_bench.devices.sim.waved_board import WavedBoard
from uvgs_bench.errors import CaptureError, ConfigError, TooFewViews
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sessions import guided_views
from uvgs_bench.sessions.calibrate import calibrate_from_source
from uvgs_bench.sessions.events import CoverageShown, Event
from uvgs_bench.store.boards import read_board

pytestmark = pytest.mark.opencv

BOARD = Path(__file__).parents[2] / "calib" / "boards" / "chessboard_9x6.toml"
SMALL = TrueCamera(
    width_px=400, height_px=300, parameters_px=(320.0, 320.0, 201.0, 148.0, -0.08, 0.045, 4e-4, -3e-4, 0.0)
)
LENS = Lens("plumb_bob", 1280, 960, np.array([1000.0, 1000.0, 639.5, 479.5, -0.1, 0.05, 0.0, 0.0, 0.0]))
FLAT = Board("flat", "chessboard", 9, 6, 0.03)


def seen(pose, name: str, rng: np.random.Generator) -> BoardView:
    px = LENS.project(pose.apply(FLAT.points_m)) + rng.normal(0.0, 0.1, (54, 2))
    return BoardView(name, px, FLAT.points_m, 1280, 960)


def test_a_waved_board_is_calibrated_and_the_end_comes_by_itself(monkeypatch):
    monkeypatch.setattr(waved_board, "_MOVING", 1)
    monkeypatch.setattr(guided_views, "PATIENCE", 16)
    told: list[Event] = []
    with WavedBoard(SimulatedTruth(camera=SMALL), read_board(BOARD)) as camera:
        result = calibrate_from_source(camera, read_board(BOARD), "plumb_bob", sink=told.append)
    shown = [event for event in told if isinstance(event, CoverageShown)]
    assert result.calibration.view_count >= 20
    # Nobody stopped it; a third of the captures are on the way and must not have been taken.
    assert len(shown) < 200
    assert [event.views for event in shown] == sorted(event.views for event in shown)
    assert shown[-1].views == result.calibration.view_count == sum(event.is_taken for event in shown)
    assert any(event.said == "hold the board still" for event in shown)
    # Five deviations of nine parameters.
    deviation = (result.calibration.lens.parameters - SMALL.parameters_px) / result.calibration.sigmas
    assert np.abs(deviation).max() < 5.0
    assert result.calibration.verdict.is_usable
    # No view shows the same as another.
    for i, view in enumerate(result.views):
        for other in result.views[:i]:
            assert np.linalg.norm(view.px - other.px, axis=1).mean() > 0.02 * 400


def test_copies_are_refused_and_new_places_taken():
    rng = np.random.default_rng(3)
    guidance = begin()
    for i, anchor in enumerate(((0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0), (0.5, 0.5))):
        view = seen(place_board(LENS, FLAT.points_m, anchor, rng), f"view {i}", rng)
        assert consider(guidance, view).is_taken
        guidance = take(guidance, view, "plumb_bob")
    assert guidance.fitted is not None
    assert not guidance.is_enough
    again = consider(guidance, replace(view, px=view.px + 3.0))
    assert not again.is_taken
    assert "view 4" in again.reason


def test_sides_are_named_as_the_camera_sees_them():
    """A board turned about the vertical axis so that its right edge comes nearer."""
    rng = np.random.default_rng(4)
    centre = FLAT.points_m.mean(axis=0)
    turns = {"right": (0.0, 0.5), "left": (0.0, -0.5), "bottom": (-0.5, 0.0), "top": (0.5, 0.0)}
    base = [place_board(LENS, FLAT.points_m, anchor, rng) for anchor in ((0.0, 0.0), (1.0, 1.0), (1.0, 0.0))]
    flat = [replace(pose, R=so3_exp(0.05 * rng.normal(size=3))) for pose in base]
    for side, (x, y) in turns.items():
        R = so3_exp(np.array([x, y, 0.0]))
        # By the coordinates themselves: the middle of which edge is nearest?
        edges = {"left": [0, 2.5], "right": [8, 2.5], "top": [4, 0], "bottom": [4, 5]}
        depth = {name: float((R @ (np.array([*place, 0.0]) * 0.03 - centre))[2]) for name, place in edges.items()}
        assert min(depth, key=depth.get) == side
        guidance = begin()
        poses = [*flat, replace(base[0], R=R, t_m=np.array([0.0, 0.0, 0.45]) - R @ centre)]
        for i, pose in enumerate(poses):
            guidance = take(guidance, seen(pose, f"view {i}", rng), "fov")
        if guidance.fitted is not None:
            assert guidance.tilts[[name.split()[0] for name in TILTS].index(side)]


def test_wrong_boards_end_at_the_limit_with_the_reason():
    board = read_board(BOARD)
    with (
        WavedBoard(SimulatedTruth(camera=SMALL), board) as camera,
        pytest.raises(TooFewViews, match="usable in 0 of 1 pictures"),
    ):
        calibrate_from_source(camera, replace(board, columns=8), "plumb_bob", limit=1)


def test_pictures_taken_are_kept_and_lead_to_the_same_lens(tmp_path, capsys):
    out, kept = tmp_path / "a.yaml", tmp_path / "kept"
    source = f"sim-board:{BOARD}?seed=2"
    options = ["--board", str(BOARD), "--out", str(out), "--force", "--json", "-q"]
    with pytest.raises(SystemExit):
        main(["calibrate", source, "--limit", "20", "--keep", str(kept), *options])
    live = json.loads(capsys.readouterr().out)
    assert len(list(kept.glob("*.png"))) == len(live["views"]) >= 4
    with pytest.raises(SystemExit):
        main(["calibrate", f"images:{kept}", *options])
    again = json.loads(capsys.readouterr().out)
    assert again["parameters"] == live["parameters"]
    assert again["held_out_rms_mrad"] == pytest.approx(again["held_out_rms_px"] / again["rms_px"] * again["rms_mrad"])
    with pytest.raises(SystemExit) as left:
        main(["calibrate", f"images:{kept}", "--keep", str(kept), *options])
    assert left.value.code == 2
    assert "--keep" in capsys.readouterr().err


def test_panel_names_what_is_missing():
    from rich.console import Console

    counts = tuple(tuple(10 * (i == j) for i in range(10)) for j in range(8))
    console = Console(width=60, record=True)
    console.print(_panel(CoverageShown(3, 9, counts, ("some closer",), "hold the board still", False)))
    text = console.export_text()
    assert "next: some closer" in text
    assert "3 views taken of 9 captures" in text
    assert max(len(line) for line in text.splitlines()) <= 60


def test_waved_board_by_its_spec():
    from uvgs_bench.devices.cameras import open_camera

    with open_camera(f"sim-board:{BOARD}") as camera:
        assert camera.is_live
        capture = camera.grab()
        assert isinstance(capture, Capture)
    with pytest.raises(CaptureError, match="closed"):
        camera.grab()
    for spec, error in ((f"sim-board:{BOARD}?sed=1", ConfigError), ("sim-board:none.toml", CaptureError)):
        with pytest.raises(error):
            open_camera(spec)
