"""``uvgs calibrate`` and ``uvgs camera show`` from the outside: files, figures, exit codes, one line per mistake."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from uvgs_bench.camera.boards import Board, board_texture
from uvgs_bench.cli.app import main
from uvgs_bench.errors import CaptureError
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.sessions.calibrate import calibrate_from_source
from uvgs_bench.sessions.events import Event, Remark, StageAdvanced
from uvgs_bench.store.boards import read_board
from uvgs_bench.store.calibrations import read_calibration

pytestmark = pytest.mark.opencv

REPOSITORY = Path(__file__).parents[2]
BOARD = REPOSITORY / "calib" / "boards" / "chessboard_9x6.toml"
PHOTOGRAPHS = REPOSITORY.parent / "shared" / "data" / "chessboard_opencv"
WIDTH, HEIGHT, FOCAL = 640, 480, 600.0


def draw(board: Board, R: np.ndarray, t_m: np.ndarray) -> np.ndarray:
    """A pinhole picture of the board, drawn four times finer and averaged."""
    texture, px_m, origin = board_texture(board, 48)
    to_metres = np.array([[px_m, 0, origin[0]], [0, px_m, origin[1]], [0, 0, 1.0]])
    K = np.array([[FOCAL, 0, 0.5 * (WIDTH - 1)], [0, FOCAL, 0.5 * (HEIGHT - 1)], [0, 0, 1.0]])
    finer = np.array([[4, 0, 1.5], [0, 4, 1.5], [0, 0, 1.0]])
    H = finer @ K @ np.column_stack([R[:, 0], R[:, 1], t_m]) @ to_metres
    large = cv2.warpPerspective(cv2.GaussianBlur(texture, (0, 0), 1.0), H, (4 * WIDTH, 4 * HEIGHT), borderValue=200)
    return cv2.GaussianBlur(cv2.resize(large, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), (0, 0), 0.6)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    board = read_board(BOARD)
    centre = board.points_m.mean(axis=0)
    rng = np.random.default_rng(2)
    for i in range(9):
        R = so3_exp(np.array([*rng.uniform(-0.6, 0.6, 2), rng.uniform(-0.2, 0.2)]))
        # Each to another side, so that none stays empty.
        side = np.array([0.06 * (i % 3 - 1), 0.06 * (i // 3 - 1)])
        place = np.array([*(side + rng.uniform(-0.015, 0.015, 2)), rng.uniform(0.42, 0.5)])
        cv2.imwrite(str(folder / f"view{i}.png"), draw(board, R, place - R @ centre))
    return folder


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as left:
        main([str(argument) for argument in arguments])
    return int(left.value.code or 0)


def test_pictures_become_a_camera_file(pictures, tmp_path, capsys):
    out = tmp_path / "camera.yaml"
    assert run("calibrate", f"images:{pictures}", "--board", BOARD, "--out", out) == 0
    calibration = read_calibration(out)
    sigmas = calibration.sigmas
    assert sigmas is not None
    # Drawn by a pinhole: five deviations, because drawn corners err with their place, not at random.
    assert (np.abs(calibration.lens.parameters[:2] - FOCAL) < 5.0 * sigmas[:2]).all()
    assert calibration.rms_px < 0.1
    assert calibration.view_count == 9
    assert calibration.camera_name == "camera"
    assert calibration.notes["board"].startswith("chessboard_9x6")
    assert len(calibration.notes["pictures_sha256"]) == 64
    printed = capsys.readouterr().out
    assert "held out" in printed
    assert "px per axis" in printed
    assert str(out) in printed.replace("\n", "")
    assert run("camera", "show", out) == 0
    assert "horizontal 56." in capsys.readouterr().out


def test_json_is_one_object_with_both_conventions(pictures, tmp_path, capsys):
    out = tmp_path / "camera.yaml"
    assert (
        run("calibrate", f"images:{pictures}", "--board", BOARD, "--out", out, "--model", "equidistant", "--json") == 0
    )
    summary = json.loads(capsys.readouterr().out)
    assert summary["rms_px"] == pytest.approx(np.sqrt(2.0) * summary["rms_per_axis_px"])
    assert list(summary["parameters"]) == ["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"]
    assert run("camera", "show", out, "--json") == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["parameters"] == summary["parameters"]
    assert shown["notes"]["source"] == f"images:{pictures}"


def test_existing_output_is_kept_and_nothing_is_computed(pictures, tmp_path, capsys):
    out = tmp_path / "camera.yaml"
    out.write_text("precious")
    assert run("calibrate", f"images:{pictures}", "--board", BOARD, "--out", out) == 2
    assert out.read_text() == "precious"
    assert "--force" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "code", "said"),
    [
        (["--glob", "view[01].png"], 3, "usable in 2 of 2 pictures, need 3"),
        (["--glob", "nothing*.png"], 4, "nothing*.png"),
        (["--model", "pinhole"], 2, "unknown lens model 'pinhole'"),
        (["--limit", "2"], 3, "need 3"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(pictures, tmp_path, capsys, options, code, said):
    out = tmp_path / "camera.yaml"
    assert run("calibrate", f"images:{pictures}", "--board", BOARD, "--out", out, *options) == code
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert said in errors[0]
    assert not out.exists()


def test_wrong_board_is_explained(pictures, tmp_path, capsys):
    wrong = tmp_path / "board.toml"
    wrong.write_text(BOARD.read_text().replace("columns = 9 ", "columns = 8 ").replace("rows = 6", "rows = 5"))
    assert run("calibrate", f"images:{pictures}", "--board", wrong, "--out", tmp_path / "c.yaml") == 3
    assert "board_larger_than_declared" in capsys.readouterr().err


def test_missing_folder_truncated_and_mixed_pictures_are_named(pictures, tmp_path, capsys):
    out = tmp_path / "c.yaml"
    assert run("calibrate", f"images:{tmp_path}/none", "--board", BOARD, "--out", out) == 4
    assert "none" in capsys.readouterr().err
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    for i in range(3):
        (mixed / f"a{i}.png").write_bytes((pictures / f"view{i}.png").read_bytes())
    cv2.imwrite(str(mixed / "b.png"), np.zeros((100, 100), np.uint8))
    assert run("calibrate", f"images:{mixed}", "--board", BOARD, "--out", out) == 4
    said = capsys.readouterr().err
    assert "b.png" in said
    assert "100x100" in said
    (mixed / "b.png").write_bytes((pictures / "view3.png").read_bytes()[:2000])
    assert run("calibrate", f"images:{mixed}", "--board", BOARD, "--out", out) == 4
    assert "b.png" in capsys.readouterr().err
    assert not out.exists()


class Source:
    """A source in memory."""

    spec = "memory:"

    def __init__(self, captures: list, is_live: bool = False) -> None:
        self.captures, self.is_live, self.length = captures, is_live, len(captures)

    def __iter__(self):
        return iter(self.captures)

    def grab(self):
        return None


def test_session_speaks_of_every_picture(pictures):
    from uvgs_bench.sensor.capture import Capture

    images = [cv2.imread(str(pictures / f"view{i}.png"), 0) for i in range(4)]
    images.insert(2, np.full_like(images[0], 90))
    captures = [Capture(image, i, f"p{i}", i) for i, image in enumerate(images)]
    heard: list[Event] = []
    result = calibrate_from_source(Source(captures), read_board(BOARD), "fov", sink=heard.append)  # type: ignore[arg-type]
    assert [miss.name for miss in result.misses] == ["p2"]
    assert result.view_names == ("p0", "p1", "p3", "p4")
    steps = [event.done for event in heard if isinstance(event, StageAdvanced)]
    assert steps == [1, 2, 3, 4, 5]
    assert any(isinstance(event, Remark) and "p2: board_not_found" in event.text for event in heard)


def test_source_without_pictures_is_an_error():
    board = read_board(BOARD)
    with pytest.raises(CaptureError, match="no pictures"):
        calibrate_from_source(Source([], is_live=True), board, "fov")  # type: ignore[arg-type]
    with pytest.raises(CaptureError, match="no pictures"):
        calibrate_from_source(Source([]), board, "fov")  # type: ignore[arg-type]


@pytest.mark.shared_data
def test_photographs_give_the_measured_figures_through_the_command(tmp_path, capsys):
    if not PHOTOGRAPHS.is_dir():
        pytest.skip(f"no photographs at {PHOTOGRAPHS}: figures of real pictures are not checked")
    out = tmp_path / "left.yaml"
    source = f"images:{PHOTOGRAPHS}?glob=left*.jpg"
    assert run("calibrate", source, "--board", BOARD, "--out", out, "--no-reject", "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    # Half a unit of the last printed digit of the measured figures.
    assert summary["rms_px"] == pytest.approx(0.2449, abs=5e-5)
    assert summary["parameters"]["fx"] == pytest.approx(533.966, abs=6e-4)
    assert summary["sigmas"]["fx"] == pytest.approx(0.551, rel=0.01)
    assert run("camera", "show", PHOTOGRAPHS / "NOTES.md") == 2


def test_what_is_not_usable_is_not_written_unless_forced_and_then_says_so(pictures, tmp_path, capsys):
    out = tmp_path / "camera.yaml"
    source = f"images:{pictures}?glob=view[0-4].png"
    assert run("calibrate", source, "--board", BOARD, "--out", out) == 3
    said = capsys.readouterr()
    assert "INCONCLUSIVE" in said.out
    assert "5 views are too few" in said.out
    assert "no camera file written" in said.err
    assert not out.exists()
    assert run("calibrate", source, "--board", BOARD, "--out", out, "--force", "--json") == 3
    summary = json.loads(capsys.readouterr().out)
    assert summary["verdict"] == "inconclusive"
    verdict = read_calibration(out).verdict
    assert verdict is not None
    assert verdict.word == "inconclusive"
    assert list(verdict.reasons) == summary["reasons"]


def test_verdict_and_joint_covariance_travel_with_the_file(pictures, tmp_path, capsys):
    out = tmp_path / "camera.yaml"
    assert run("calibrate", f"images:{pictures}", "--board", BOARD, "--out", out, "--board-shape", "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    calibration = read_calibration(out)
    assert calibration.verdict is not None
    assert calibration.verdict.radius_px == summary["usable_radius_px"] > 0.0
    assert calibration.joint_covariance is not None
    assert calibration.covariance is not None
    np.testing.assert_array_equal(calibration.joint_covariance[:9, :9], calibration.covariance)
    (bow_x_m, bow_y_m, stretch), _ = summary["board_shape"]
    # Drawn flat and square: bow below a tenth of a millimetre, stretch below a thousandth.
    assert max(abs(bow_x_m), abs(bow_y_m)) < 2e-4
    assert abs(stretch) < 1e-3


def test_pictures_choose_the_lens_when_asked(pictures, tmp_path, capsys):
    out = tmp_path / "camera.yaml"
    assert run("calibrate", f"images:{pictures}", "--board", BOARD, "--out", out, "--model", "auto", "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    calibration = read_calibration(out)
    assert calibration.lens.model == summary["model"]
    # Drawn without distortion: a fov lens is then at the edge of what it can be, and may not come to rest.
    assert calibration.notes["lens_choice"].count("unseen") >= 4
    assert "plumb_bob" in calibration.notes["lens_choice"]


def test_what_the_calibration_does_to_a_beacon_is_said_by_range(pictures, tmp_path, capsys):
    beacon = REPOSITORY / "calib" / "beacons" / "tetra_small.toml"
    source = f"images:{pictures}"
    assert run("calibrate", source, "--board", BOARD, "--out", tmp_path / "c.yaml", "--beacon", beacon) == 0
    printed_first = capsys.readouterr().out
    printed = " ".join(printed_first.split())
    assert "facing the camera, 1σ" in printed
    assert "LEDs ±0.05 px: mm" in printed
    # The same in the file, once it is written, and as numbers.
    assert run("camera", "show", tmp_path / "c.yaml", "--beacon", beacon, "--json") == 0
    rows = json.loads(capsys.readouterr().out)["pose"]["ranges"]
    assert [row["range_m"] for row in rows] == [0.5, 1.0, 2.0, 4.0]
    assert run("camera", "show", tmp_path / "c.yaml", "--beacon", beacon) == 0
    heading = "pose of tetra_small facing"
    of_calibrate, of_show = (text[text.index(heading) :].split("written")[0] for text in
                             (printed_first, capsys.readouterr().out))  # fmt: skip
    # What the halves say of the deviations is kept in the file, so that both say the same.
    assert of_show.split() == of_calibrate.split()
    assert "disagree" in of_show or read_calibration(tmp_path / "c.yaml").doubt_factor == 1.0
    far, near = rows[2], rows[1]
    # Lateral noise grows with the distance; that of the range with its square.
    assert far["noise_sigma_mm"][0] == pytest.approx(2.0 * near["noise_sigma_mm"][0], rel=0.2)
    assert far["noise_sigma_mm"][2] == pytest.approx(4.0 * near["noise_sigma_mm"][2], rel=0.1)
    x, y, z = near["calibration_sigma_mm"]
    assert f"{x:.2f} {y:.2f} {z:.2f}" in printed


def test_a_report_is_written_when_asked_for_and_shows_the_worst_pictures(pictures, tmp_path, capsys):
    folder, out = tmp_path / "page", tmp_path / "camera.yaml"
    beacon = REPOSITORY / "calib" / "beacons" / "tetra_small.toml"
    asked = ["calibrate", f"images:{pictures}", "--board", BOARD, "--out", out, "--report", folder]
    assert run(*asked, "--json", "--beacon", beacon) == 0
    summary = json.loads(capsys.readouterr().out)
    assert sorted(summary["report"]) == ["html", "json", "pdf"]
    assert (folder / "report.pdf").read_bytes().startswith(b"%PDF")
    data = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    shown = {figure["label"]: figure["number"]["value"] for figure in data["key_figures"]}
    assert shown["Residual, RMS of lengths"] == summary["rms_px"]
    pose = next(s for s in data["sections"] if s["key"] == "pose")
    row = next(r for b in pose["blocks"] if b["kind"] == "table" for r in b["rows"] if r[0]["shown"].startswith("1 m"))
    forecast = next(r for r in summary["pose"]["ranges"] if r["range_m"] == 1.0)
    assert [cell["value"] for cell in row[1:4]] == forecast["calibration_sigma_mm"]
    galleries = [b for s in data["sections"] for b in s["blocks"] if b["kind"] == "gallery"]
    assert len(galleries[0]["pictures"]) == 6
    # Nothing is computed when a report would be replaced.
    out.unlink()
    assert run(*asked) == 2
    assert "report.html" in capsys.readouterr().err
    assert not out.exists()


def test_what_is_not_usable_gets_its_report_but_no_camera_file(pictures, tmp_path, capsys):
    folder, out = tmp_path / "page", tmp_path / "camera.yaml"
    source = f"images:{pictures}?glob=view[0-4].png"
    assert run("calibrate", source, "--board", BOARD, "--out", out, "--report", folder) == 3
    assert not out.exists()
    assert json.loads((folder / "report.json").read_text(encoding="utf-8"))["verdict"]["state"] == "inconclusive"
    assert str(folder / "report.html") in capsys.readouterr().out.replace("\n", "")
