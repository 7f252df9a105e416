"""What a user can get wrong, as typed: one clear line that names the file and the key, and the right exit code."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.helpers.synthetic_run import synthetic_run, write_run
from uvgs_bench.cli import app as cli
from uvgs_bench.cli import console
from uvgs_bench.errors import ConfigError
from uvgs_bench.store.documents import check_writable

ROOT = Path(__file__).resolve().parents[2]
BENCH, BEACON, BOARD = Path("calib/bench.toml"), Path("calib/beacons/tetra_small.toml"), "calib/boards/charuco_9x6.toml"
CAMERA, GRID = Path("calib/cameras/simulated.yaml"), Path("procedures/demo_grid.toml")
RUN_WITH = ("--camera", str(CAMERA), "--beacon", str(BEACON), "--out", "poses.csv")

Uvgs = Callable[..., tuple[int, str, str]]


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("calib", "procedures"):
        shutil.copytree(ROOT / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def uvgs(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Uvgs:
    """Runs ``uvgs`` in this process; gives exit code, stdout and stderr. Only the named command is loaded."""
    known = dict(cli.COMMANDS)

    def run(*words: object) -> tuple[int, str, str]:
        first = str(words[0]) if words else ""
        monkeypatch.setattr(cli, "COMMANDS", {first: known[first], "doctor": known["doctor"]})
        with pytest.raises(SystemExit) as end:
            cli.main([str(word) for word in words])
        printed = capsys.readouterr()
        return int(end.value.code or 0), printed.out, printed.err

    return run


def refused(result: tuple[int, str, str], code: int, *said: str) -> None:
    """One line on stderr that says all of it, nothing on stdout."""
    found, out, err = result
    assert found == code, err
    assert out == ""
    lines = err.strip().splitlines()
    assert len(lines) == 1, err
    for part in said:
        assert part in lines[0]


def change(path: Path, pattern: str, to: str) -> Path:
    text = path.read_text(encoding="utf-8")
    changed = re.sub(pattern, to, text, count=1, flags=re.MULTILINE)
    assert changed != text, pattern
    path.write_text(changed, encoding="utf-8")
    return path


READERS = {
    "bench": (BENCH, lambda p: ("gantry-sweep", GRID, "--dry-run", "--bench", p)),
    "procedure": (GRID, lambda p: ("gantry-sweep", p, "--dry-run", "--bench", BENCH)),
    "beacon": (BEACON, lambda p: ("beacon", "show", p)),
    "camera": (CAMERA, lambda p: ("camera", "show", p)),
    "board": (Path(BOARD), lambda p: ("calibrate", "images:calib", "--board", p, "--out", "c.yaml")),
}


@pytest.mark.parametrize("kind", READERS)
def test_a_document_that_cannot_be_read_is_missing_input(kind: str, workspace: Path, uvgs: Uvgs) -> None:
    path, words = READERS[kind]
    refused(uvgs(*words(Path("nowhere"))), 4, "nowhere: no such file")
    refused(uvgs(*words(workspace)), 4, "is a folder, expected a")
    (workspace / "binary").write_bytes(bytes(range(128, 256)))
    refused(uvgs(*words(Path("binary"))), 4, "binary: is no text, expected a")
    (workspace / "empty").write_text("")
    refused(uvgs(*words(Path("empty"))), 2, "empty: ")
    change(path, r"\A", "]broken\n")
    refused(uvgs(*words(path)), 2, f"{path}: not valid")


def test_a_byte_order_mark_and_windows_line_ends_are_no_mistake(workspace: Path, uvgs: Uvgs) -> None:
    BEACON.write_bytes(b"\xef\xbb\xbf" + BEACON.read_bytes().replace(b"\n", b"\r\n"))
    assert uvgs("beacon", "show", BEACON)[0] == 0


@pytest.mark.parametrize(
    ("kind", "pattern", "to", "said"),
    [
        ("bench", "^camera =", "camra =", "camra: unknown key, did you mean 'camera'?"),
        ("bench", "min_mm = -400.0", "min_m = -0.4", "gantry.axes.0.min_m: unknown key, did you mean 'min_mm'?"),
        ("bench", "^direction = .*", "direction = [1.0]", "gantry.axes.0.direction: the list has only 1 entries"),
        ("bench", "homing_timeout_s = .*", "homing_timeout_s = -1.0", "gantry.homing_timeout_s: must be positive"),
        ("bench", "^emission_exponent.*", "emission_exponent = nan", "simulated.emission_exponent: must be finite"),
        ("bench", "^probability.*", "probability = 2.0", "probability must be 0 to 1"),
        ("procedure", "^feed_mm_min", "feed_mm_s", "feed_mm_s: unknown key, did you mean 'feed_mm_min'?"),
        (
            "procedure",
            "lower = .*",
            "lower = { X_m = 0.1, Y_mm = 0, Z_mm = 0 }",
            "grid.lower.X_m: unknown axis or unit",
        ),
        ("procedure", "^register.*", 'register = "all"', "register: input should be 'every_third' or 'corners'"),
        ("procedure", "counts = .*", "counts = { X = 1000, Y = 1000, Z = 1000 }", "grid.counts: must give at most"),
        ("procedure", "^availability.*", "availability_percent = 101.0", "availability_percent: must be at most 100"),
        ("procedure", "upper = .*", "upper = { X_mm = 900, Y_mm = 0, Z_mm = 0 }", "demo_grid.toml: "),
        ("beacon", "position_mm", "position_m", "leds.0.position_m: unknown key, did you mean 'position_mm'?"),
        ("beacon", "position_mm = .*", 'position_mm = "here"', "leds.0.position_mm: input should be a list"),
        ("beacon", "position_mm = .*", "position_mm = [1e300, 0.0, 0.0]", "LED bottom: position_mm must be within"),
        ("board", "^columns.*", 'columns = "9"', "columns: expected a whole number, got '9'"),
        ("board", "^columns.*", "columns = true", "columns: expected a whole number, got true"),
        ("board", "^columns.*", "columns = 90000", "is larger than any print"),
        ("board", "^square_mm.*", "square_mm = 0.0", "square_mm: must be between"),
        ("board", "^dictionary.*", 'dictionary = "DICT_9X9"', "unknown marker dictionary 'DICT_9X9'"),
        ("camera", "^image_width: .*", "image_width: wide", "image_width: expected a whole number, got 'wide'"),
        ("camera", "^  rms_px:", "  rms_mm:", "uvgs.rms_mm: unknown key, did you mean 'rms_px'?"),
        ("camera", "^camera_matrix:", "camera_matrix: !!opencv-matrix", "OpenCV's own storage format"),
    ],
)
def test_a_document_that_cannot_be_meant_is_refused_by_key(
    kind: str, pattern: str, to: str, said: str, workspace: Path, uvgs: Uvgs
) -> None:
    path, words = READERS[kind]
    change(path, pattern, to)
    refused(uvgs(*words(path)), 2, str(path), said)


def test_three_or_coincident_leds_are_no_beacon(workspace: Path, uvgs: Uvgs) -> None:
    text = BEACON.read_text()
    places = re.findall(r"position_mm = \[.*\]", text)
    BEACON.write_text(text.replace(places[1], places[0]))
    refused(uvgs("beacon", "check", BEACON), 2, "LEDs bottom and left are 0.000 mm apart")
    BEACON.write_text("[[leds]]".join(text.split("[[leds]]")[:4]))
    refused(uvgs("run", "images:calib", *RUN_WITH), 2, "at least 4 LEDs, got 3")


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("calibrate", "images:nowhere", "--board", BOARD, "--out", "c.yaml"), 4, "nowhere: no such folder"),
        (("calibrate", "images:", "--board", BOARD, "--out", "c.yaml"), 2, "name the folder"),
        (("calibrate", "images:calib", "--board", BOARD, "--out", "c.yaml"), 4, "calib: holds no pictures"),
        (("calibrate", "uvc:x:", "--board", BOARD, "--out", "c.yaml"), 4, "uvc:x:"),
        (("calibrate", "images:calib", "--board", BOARD, "--out", "calib"), 2, "calib: is a folder"),
        (("calibrate", "images:calib", "--board", BOARD, "--out", CAMERA), 2, "use --force"),
        (("calibrate", "images:calib", "--board", BOARD, "--out", f"{BENCH}/c.yaml"), 4, "is no folder"),
        (("calibrate", "images:calib", "--board", BOARD, "--out", "c", "--limit", "0"), 2, "see uvgs calibrate --help"),
        (("run", "images:nowhere", *RUN_WITH), 4, "nowhere: no such folder"),
        (("report", "nowhere"), 4, "nowhere: no such run folder"),
        (("report", "calib"), 4, "calib: no run folder"),
        (("report",), 2, "Missing argument 'run'; see uvgs report --help"),
        (("gantry", "status", "--port", "grbl:/dev/nowhere"), 5, "/dev/nowhere: no such port"),
        (("gantry", "status", "--port", "grbl:/dev/null"), 5, "/dev/null: is no serial port"),
        (("gantry", "move", "X=-999", "--home"), 2, "axis X at -999.000 mm is outside its envelope"),
        (("demo", "--out", "calib"), 2, "calib: is not empty"),
        (("demo", "--stations", "3"), 2, "--stations"),
    ],
)
def test_a_wrong_word_is_one_line(words: tuple[object, ...], code: int, said: str, workspace: Path, uvgs: Uvgs) -> None:
    refused(uvgs(*words), code, said)


@pytest.mark.opencv
def test_pictures_of_another_size_or_cut_short_are_refused(workspace: Path, uvgs: Uvgs) -> None:
    import cv2
    import numpy as np

    folder = workspace / "pictures"
    folder.mkdir()
    cv2.imwrite(str(folder / "a.png"), np.zeros((480, 640), np.uint8))
    calibrate = ("calibrate", "images:pictures", "--board", BOARD, "--out", "c.yaml", "--quiet")
    result = uvgs("run", "images:pictures", *RUN_WITH, "--quiet")
    assert result[0] == 4
    assert "a.png is 640x480 px but calibration" in result[2]
    cv2.imwrite(str(folder / "b.png"), np.zeros((48, 64), np.uint8))
    result = uvgs(*calibrate)
    assert result[0] == 4
    assert "b.png: is 64x48 px, but a.png is 640x480 px" in result[2]
    (folder / "b.png").write_bytes((folder / "a.png").read_bytes()[:60])
    result = uvgs(*calibrate)
    assert result[0] == 4
    assert "b.png: is truncated" in result[2]


@pytest.mark.parametrize("ended", ["interrupted", "failed"])
def test_the_report_of_a_run_that_ended_early_says_so(ended: str, tmp_path: Path, uvgs: Uvgs) -> None:
    run = write_run(synthetic_run(stations=5, shots=1, ended=ended), tmp_path / "run")
    code, out, err = uvgs("report", run, "--format", "json", "--json")
    assert code == 3
    assert err == ""
    said = json.loads(out)
    assert said["verdict"] == "inconclusive"
    assert any("INCOMPLETE" in banner and ended in banner for banner in said["banners"])


@pytest.mark.parametrize("stations", [1, 2, 5])
def test_a_run_too_short_to_judge_is_inconclusive(stations: int, tmp_path: Path, uvgs: Uvgs) -> None:
    run = write_run(synthetic_run(stations=stations, shots=1), tmp_path / "run")
    assert uvgs("report", run, "--format", "json")[0] == 3


def test_a_run_of_misses_only_is_inconclusive(tmp_path: Path, uvgs: Uvgs) -> None:
    run = write_run(synthetic_run(stations=12, shots=1, miss_every=1), tmp_path / "run")
    code, out, _ = uvgs("report", run, "--format", "html,json")
    assert code == 3
    assert "INCONCLUSIVE" in out


def test_an_interruption_is_said_once_and_is_130(uvgs: Uvgs, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("uvgs_bench.sessions.doctor.examine", interrupted)
    assert uvgs("doctor") == (130, "", "interrupted\n")


def test_an_error_of_the_system_is_one_line(uvgs: Uvgs, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device", "/somewhere")

    monkeypatch.setattr("uvgs_bench.sessions.doctor.examine", full)
    refused(uvgs("doctor"), 4, "/somewhere: No space left on device")


def test_nothing_typed_turns_into_emoji(capsys: pytest.CaptureFixture[str]) -> None:
    console.print_error("uvc:x: [bold]")
    assert capsys.readouterr().err == "error: uvc:x: [bold]\n"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(Exception, match="no permission"):
        check_writable(tmp_path / "deep" / "c.yaml", force=False)


def test_an_output_in_a_folder_to_come_is_fine(tmp_path: Path) -> None:
    check_writable(tmp_path / "deep" / "c.yaml", force=False)
    with pytest.raises(ConfigError, match="is a folder"):
        check_writable(tmp_path, force=True)


def process(*words: str, stdout: int) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "uvgs_bench", *words]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.Popen(command, stdout=stdout, stderr=subprocess.PIPE, env=environment)


def test_a_pipe_that_closes_early_is_neither_done_nor_a_verdict() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    running = process("doctor", stdout=writer)
    os.close(writer)
    _, err = running.communicate(timeout=120)
    assert running.returncode == 128 + signal.SIGPIPE
    assert err == b""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_full_disk_behind_stdout_is_one_line() -> None:
    with Path("/dev/full").open("wb") as full:
        running = process("--version", stdout=full.fileno())
        _, err = running.communicate(timeout=120)
    assert running.returncode == 4
    assert err.decode().count("\n") == 1
    assert "No space left on device" in err.decode()
