"""``uvgs beacon measure`` end to end: drawn pictures and a sweep of the simulated bench whose apex LED is misplaced."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.helpers import beacon_views as bv
from tests.helpers import spots
from uvgs_bench.beacon import Beacon
from uvgs_bench.beacon.frames import fit_rigid
from uvgs_bench.beacon.measure import MeasureConfig
from uvgs_bench.camera.boards import Board, board_texture
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.cli.app import main
from uvgs_bench.devices.sim.bench import true_lens
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import rotation_angle
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.sessions.bench_setup import read_setup, sweep
from uvgs_bench.sessions.measure_beacon import measure_from_pictures
from uvgs_bench.store.beacons import read_beacon, write_beacon
from uvgs_bench.store.bench import read_bench
from uvgs_bench.store.calibrations import write_calibration

pytestmark = pytest.mark.opencv

ROOT = Path(__file__).parents[2]
NOMINAL = spots.beacon()
OFF_M = np.array([[0.0, 0.0, 0.0]] * 3 + [[1.2e-3, -1.0e-3, 1.25e-3]])  # 2 mm
TRUE = bv.moved(NOMINAL, OFF_M)
PROCEDURE = """
schema = 1
name = "measure"
pattern = "grid"
origin = "centre"
feed_mm_min = 3000.0
captures_per_station = 1
seed = 3
[grid]
lower = { X_mm = -180.0, Y_mm = -140.0, Z_mm = -140.0 }
upper = { X_mm = 180.0, Y_mm = 140.0, Z_mm = 140.0 }
counts = { X = 4, Y = 3, Z = 3 }
[approach]
kind = "from_below"
"""


def uvgs(*words: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main(["beacon", *(str(word) for word in words)])
    return int(caught.value.code or 0)


def views(count: int, seed: int, cone_deg: float = 45.0) -> list[tuple[Pose, Capture]]:
    rng = np.random.default_rng(seed)
    out = []
    for i in range(count):
        pose = bv.tilted_pose(rng, 0.6, cone_deg)
        px = spots.lens().project(pose.apply(TRUE.positions_m))
        out.append((pose, Capture(spots.draw(px, rng), i, f"p{i}.png", i)))
    return out


def errors(beacon: Beacon, seen: list[tuple[Pose, Capture]]) -> list[tuple[float, float]]:
    """Angle and distance between found and true pose, for a beacon stated in any frame; nothing for a miss."""
    R, t = fit_rigid(TRUE.positions_m, beacon.positions_m)
    uvgs = Uvgs(spots.calibration(), beacon)
    out = []
    for pose, capture in seen:
        found = uvgs.solve(capture)
        if isinstance(found, PoseEstimate):
            of_true = found.camera_from_beacon @ Pose(R, t, "beacon", "beacon")
            out.append((rotation_angle(of_true.R @ pose.R.T), float(np.linalg.norm(of_true.t_m - pose.t_m))))
    return out


def test_poses_that_were_wrong_become_right():
    seen = views(14, seed=1)
    fresh = views(10, seed=2)
    before = errors(NOMINAL, fresh)
    captures = [capture for _, capture in seen]
    result = measure_from_pictures(captures, NOMINAL, spots.calibration(), MeasureConfig("free"))
    after = errors(result.measurement.beacon, fresh)
    # With an LED 2 mm off, most pictures are refused and the rest are 0.2 to 1 degrees wrong.
    assert len(before) < 6
    assert max(angle for angle, _ in before) > np.radians(0.3)
    assert len(after) == 10
    # 0.02 px at 0.6 m is 0.01 mm sideways, ten times that in depth; 0.1 mm over the beacon's 60 mm is 0.1 degrees.
    assert max(angle for angle, _ in after) < np.radians(0.1)
    assert max(off for _, off in after) < 1e-3
    assert result.named_first < result.named == 14
    assert result.measurement.leds[3].deviation_m == pytest.approx(2e-3, abs=1e-4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("measure")
    write_calibration(folder / "camera.yaml", spots.calibration())
    write_beacon(folder / "nominal.toml", NOMINAL)
    (folder / "pictures").mkdir()
    for _, capture in views(12, seed=4):
        cv2.imwrite(str(folder / "pictures" / capture.source), capture.image)
    return folder


def given(folder) -> tuple[object, ...]:
    return ("--camera", folder / "camera.yaml", "--nominal", folder / "nominal.toml", "--quiet")


def test_free_pictures_with_calipers_write_a_beacon_file(folder, tmp_path, capfd):
    out = tmp_path / "measured.toml"
    length_mm = float(np.linalg.norm(TRUE.positions_m[0] - TRUE.positions_m[1])) * 1e3
    hand = ("--caliper", f"led0-led1={length_mm:.3f}")
    page = ("--report", tmp_path / "page")
    assert uvgs("measure", f"images:{folder / 'pictures'}", *given(folder), "--out", out, "--json", *hand, *page) == 0
    record = json.loads(capfd.readouterr().out)
    shown = json.loads((tmp_path / "page" / "report.json").read_text(encoding="utf-8"))
    worst_mm = next(f["number"]["value"] for f in shown["key_figures"] if f["label"] == "Its deviation, 1 sigma")
    assert worst_mm == max(row["sigma_mm"] for row in record["distances"])
    assert record["report"]["pdf"] == str(tmp_path / "page" / "report.pdf")
    assert record["scale_source"] == "1 caliper distances"
    beacon = read_beacon(out)
    assert beacon.name == "measured"
    assert beacon.covariance_m2 is not None
    for row in record["distances"]:
        i, j = (NOMINAL.led_names.index(name) for name in row["leds"])
        true_mm = float(np.linalg.norm(TRUE.positions_m[i] - TRUE.positions_m[j])) * 1e3
        assert abs(row["distance_mm"] - true_mm) < 4.0 * row["sigma_mm"]
    text = out.read_text()
    assert "# Scale: 1 caliper distances." in text
    assert "# Frame: best fit of all LEDs onto the nominal positions" in text
    assert uvgs("measure", f"images:{folder / 'pictures'}", *given(folder), "--out", out) == 2  # exists


def test_mistakes_are_one_line_each(folder, tmp_path, capfd):
    source, out = f"images:{folder / 'pictures'}", tmp_path / "b.toml"
    assert uvgs("measure", source, *given(folder), "--out", out, "--caliper", "led0-top=80") == 2
    assert "expected two LEDs and a distance in mm like 'led0-led1=104.2'" in capfd.readouterr().err
    assert uvgs("measure", source, *given(folder), "--out", out, "--by", "gantry") == 2
    assert "gantry needs a run folder" in capfd.readouterr().err
    assert uvgs("measure", source, "--out", out) == 2
    assert "--camera and --nominal are needed" in capfd.readouterr().err
    assert uvgs("measure", source, *given(folder), "--out", out, "--limit", 3) == 3
    assert "at least 6 are needed" in capfd.readouterr().err
    assert not out.exists()


def board_picture(board: Board, pose: Pose, rng: np.random.Generator) -> np.ndarray:
    """The printed board seen through a lens without distortion."""
    texture, texel_m, origin = board_texture(board, 24)
    K = np.array([[1100.0, 0.0, 640.0], [0.0, 1100.0, 480.0], [0.0, 0.0, 1.0]])
    to_board = np.array([[texel_m, 0.0, origin[0]], [0.0, texel_m, origin[1]], [0.0, 0.0, 1.0]])
    H = K @ np.column_stack([pose.R[:, 0], pose.R[:, 1], pose.t_m]) @ to_board
    image = cv2.warpPerspective(texture, H, (1280, 960), flags=cv2.INTER_LINEAR, borderValue=90)
    blurred = cv2.GaussianBlur(image.astype(np.float64), (0, 0), 0.8) * 0.8
    return np.clip(blurred + rng.normal(0.0, 1.0, image.shape), 0, 255).astype(np.uint8)


def test_alternating_pictures_of_board_and_lights():
    from uvgs_bench.camera.lens import Lens

    lens = Lens("plumb_bob", 1280, 960, np.array([1100.0, 1100.0, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    board = Board("b", "chessboard", 8, 5, 0.02)
    rng = np.random.default_rng(6)
    corner_from_beacon = np.array([-0.07, -0.04, 0.005])
    captures = []
    for _ in range(6):
        pose = bv.tilted_pose(rng, 0.6, 40.0)
        px = lens.project(pose.apply(TRUE.positions_m))
        board_pose = Pose(pose.R, pose.R @ corner_from_beacon + pose.t_m, "camera", "board")
        for image in (spots.draw(px, rng), board_picture(board, board_pose, rng)):
            captures.append(Capture(image, len(captures), f"p{len(captures)}.png", len(captures)))
    result = measure_from_pictures(
        captures, NOMINAL, Calibration(lens, "plain"), MeasureConfig("board"), board=board
    ).measurement
    assert result.view_count >= 4
    for d in result.distances:
        i, j = (NOMINAL.led_names.index(name) for name in (d.first, d.second))
        true_m = float(np.linalg.norm(TRUE.positions_m[i] - TRUE.positions_m[j]))
        # Drawn corners are off by the drawing too, up to a tenth of a millimetre in depth.
        assert abs(d.distance_m - true_m) < 4.0 * d.sigma_m + 1e-4


@pytest.mark.parametrize("with_wrong_scale", [False, True])
def test_board_and_lights_in_one_exposure(with_wrong_scale):
    from uvgs_bench.beacon.measure import Caliper
    from uvgs_bench.camera.lens import Lens

    lens = Lens("plumb_bob", 1280, 960, np.array([1100.0, 1100.0, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    printed = Board("b", "chessboard", 8, 5, 0.02)
    rng = np.random.default_rng(12)
    # Beside the lights, and dim next to them: black squares of the print leave 10 DN, white ones 60.
    corner_from_beacon = np.array([0.085, -0.04, 0.005])
    captures = []
    for i in range(7):
        pose = bv.tilted_pose(rng, 0.65, 35.0)
        px = lens.project(pose.apply(TRUE.positions_m))
        board_pose = Pose(pose.R, pose.R @ corner_from_beacon + pose.t_m, "camera", "board")
        image = np.maximum(spots.draw(px, rng), (0.3 * board_picture(printed, board_pose, rng)).astype(np.uint8))
        captures.append(Capture(image, i, f"p{i}.png", i))
    # Two percent: squares of 20 mm declared as 20.4 mm. A caliper tells.
    declared = replace(printed, square_m=printed.square_m * (1.02 if with_wrong_scale else 1.0))
    by_hand = Caliper("led0", "led1", float(np.linalg.norm(TRUE.positions_m[0] - TRUE.positions_m[1])))
    config = MeasureConfig("board", calipers=(by_hand,))
    result = measure_from_pictures(captures, NOMINAL, Calibration(lens, "plain"), config, board=declared).measurement
    assert result.view_count >= 6
    is_named = any("the size of the squares" in line and "+2" in line for line in result.warnings)
    assert is_named is with_wrong_scale
    for d in result.distances:
        i, j = (NOMINAL.led_names.index(name) for name in (d.first, d.second))
        true_m = float(np.linalg.norm(TRUE.positions_m[i] - TRUE.positions_m[j]))
        # As above: drawn corners are off by the drawing, too.
        is_right = abs(d.distance_m - true_m) < 4.0 * d.sigma_m + 1e-4
        assert is_right is not with_wrong_scale


def test_a_sweep_finds_the_led_that_is_not_where_its_file_says(tmp_path, capfd):
    text = (ROOT / "calib" / "bench.toml").read_text()
    line = "# led_offset_mm = { apex = [0.1, 0.0, 0.0] }   # an LED that is not where the beacon file says"
    assert line in text
    bench = tmp_path / "bench.toml"
    beacon = ROOT / "calib" / "beacons" / "tetra_small.toml"
    text = text.replace(line, "led_offset_mm = { apex = [0.6, -0.5, 0.8] }")
    bench.write_text(text.replace("beacons/tetra_small.toml", str(beacon)))
    simulated = read_bench(bench).simulated
    assert simulated is not None
    write_calibration(tmp_path / "camera.yaml", Calibration(true_lens(simulated), "simulated"))
    (tmp_path / "measure.toml").write_text(PROCEDURE)
    set_up = read_setup(tmp_path / "measure.toml", bench, camera=tmp_path / "camera.yaml")
    run = sweep(set_up, tmp_path / "reports", keep="all", simulated_speed=400.0).path
    out = tmp_path / "measured.toml"
    capfd.readouterr()
    assert uvgs("measure", run, "--out", out, "--frame", "gantry", "--json", "--quiet") == 0
    record = json.loads(capfd.readouterr().out)
    assert record["by"] == "gantry"
    nominal = read_beacon(beacon)
    offset = np.array([[0.6e-3, -0.5e-3, 0.8e-3] if led.name == "apex" else [0.0, 0.0, 0.0] for led in nominal.leds])
    true = replace(nominal, leds=bv.moved(nominal, offset).leds)
    for row in record["distances"]:
        i, j = (nominal.led_names.index(name) for name in row["leds"])
        true_mm = float(np.linalg.norm(true.positions_m[i] - true.positions_m[j])) * 1e3
        assert abs(row["distance_mm"] - true_mm) < 4.0 * row["sigma_mm"], row
        assert row["sigma_mm"] < 0.1
    assert max(record["leds"], key=lambda led: led["off_nominal_mm"])["name"] == "apex"
    # The same pictures without belief in the gantry: one attitude all the time, so the lines of sight have to differ.
    free = tmp_path / "free.toml"
    assert uvgs("measure", run, "--out", free, "--by", "free", "--json", "--quiet") in (0, 3)
    said = capfd.readouterr()
    if free.exists():
        record = json.loads(said.out)
        assert record["by"] == "free"
        assert "nominal distances" in record["scale_source"]
    else:
        assert "error:" in said.err
    assert uvgs("measure", run, "--out", tmp_path / "b.toml", "--by", "board", "--quiet") == 2
    assert "board needs pictures" in capfd.readouterr().err
