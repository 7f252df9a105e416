"""``uvgs run`` with several beacons before the simulated camera: hues, hand-over, held poses, Ctrl-C, times."""

from __future__ import annotations

import csv
import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.sim_bench import write_bench
from uvgs_bench.cli.app import main
from uvgs_bench.devices.sim.camera import SimulatedCamera
from uvgs_bench.interop.trajectories import read_poses
from uvgs_bench.store.bench import read_passing_beacon

pytestmark = pytest.mark.opencv
HIDDEN = "[simulated.occlusion]\nprobability = 0.12\n"


def uvgs(*words: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main(["run", *(str(word) for word in words)])
    return int(caught.value.code or 0)


@pytest.fixture(scope="module")
def clear(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clear")
    write_bench(folder, beacon="red", is_colour=True)
    return folder


@pytest.fixture(scope="module")
def hidden(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hidden")
    write_bench(folder, beacon="red", more=HIDDEN, is_colour=True)
    return folder


def two(folder: Path, count: int) -> tuple[object, ...]:
    return (
        f"sim:{folder / 'bench.toml'}?count={count}&with={folder / 'green.toml'}", "--camera", folder / "camera.yaml",
        "--beacon", folder / "red.toml", "--beacon", folder / "green.toml", "--quiet",
    )  # fmt: skip


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_beacons_that_differ_in_hue_only_are_told_apart(clear, tmp_path, capfd):
    out = tmp_path / "poses.csv"
    assert uvgs(*two(clear, 8), "--out", out, "--json") == 0
    summary = json.loads(capfd.readouterr().out)
    scene = read_passing_beacon(clear / "bench.toml", companions=(clear / "green.toml",))
    records = read_poses(out)
    assert [record.beacon for record in records] == ["red", "green"] * 8
    solved = 0
    for record in records:
        truth = scene.true_camera_from_beacon(record.t_ns)
        if record.beacon == "green":
            truth = truth @ scene.companions[0][0]
        if record.pose is not None:
            solved += 1
            # 0.02 px at 1 m and f = 500 px; the other beacon is 0.22 m away.
            assert record.pose.is_close(truth, 0.02, 5e-3)
    assert solved >= 12
    assert summary["poses"] == solved
    assert summary["beacons"]["red"]["poses"] + summary["beacons"]["green"]["poses"] == solved
    active = [row["beacon"] for row in rows(out) if row["is_active"] == "1"]
    assert len(active) == 8


def test_a_held_pose_is_the_last_fresh_one_of_the_active_beacon_and_ends(hidden, tmp_path, capfd):
    out = tmp_path / "poses.csv"
    assert uvgs(*two(hidden, 30), "--out", out, "--handover", "command", "--active", "red", "--hold-s", 0.15) == 0
    last: dict[str, str] | None = None
    held = 0
    for row in rows(out):
        if row["beacon"] == "green":
            assert row["is_active"] == "0"
            assert row["status"] != "held"
            continue
        assert row["is_active"] == "1"
        if row["status"] == "ok":
            last = row
        elif row["status"] == "held":
            held += 1
            assert last is not None
            assert [row[k] for k in ("x_m", "y_m", "z_m", "qw")] == [last[k] for k in ("x_m", "y_m", "z_m", "qw")]
            assert float(row["held_age_s"]) == pytest.approx((int(row["t_ns"]) - int(last["t_ns"])) / 1e9)
            # Captures are 0.1 s apart.
            assert float(row["held_age_s"]) < 0.15
            assert "held" in row["flags"].split()
            assert row["sigma_x_m"] == ""
        elif last is not None:
            assert int(row["t_ns"]) - int(last["t_ns"]) > 150_000_000
    assert held >= 3
    assert f"{held} held kept in" in capfd.readouterr().out
    assert sum(record.pose is None and record.held_pose is not None for record in read_poses(out)) == held


def test_names_on_standard_input_hand_over_one_line_per_capture(clear, tmp_path, monkeypatch, capfd):
    reading, writing = os.pipe()
    os.write(writing, b"\n\ngreen\nblue\nred\n")
    os.close(writing)
    with os.fdopen(reading) as stream:
        monkeypatch.setattr("sys.stdin", stream)
        assert uvgs(*two(clear, 6), "--out", tmp_path / "p.tum", "--handover", "command") == 0
    said = capfd.readouterr().err
    assert "unknown beacon 'blue', expected one of: red, green" in said
    green, red = (tmp_path / f"p_{name}.tum" for name in ("green", "red"))
    assert "# active from here on: commanded" in green.read_text()
    assert "# active from here on: commanded" in red.read_text()
    assert 4 <= len(read_poses(red)) <= 6


def test_the_nearest_zone_decides_by_position(clear, tmp_path, capfd):
    out = tmp_path / "p.jsonl"
    words = ("--handover", "position", "--zone-m", "red=2:9", "--zone-m", "green=0:2")
    assert uvgs(*two(clear, 4), "--out", out, *words) == 0
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    assert {line["beacon"] for line in lines if line["is_active"]} == {"green"}
    capfd.readouterr()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--active", "blue"), "unknown beacon 'blue', expected one of: red, green"),
        (("--zone-m", "red=1:2"), "needs --handover position"),
        (("--handover", "position", "--zone-m", "red=2:1"), "must be (near, far)"),
        (("--handover", "position", "--zone-m", "red=x:1"), "NAME=NEAR:FAR"),
        (("--handover", "position", "--zone-m", "blue=1:2"), "with a beacon of red, green"),
        (("--handover", "luck"), "luck"),
        (("--config", "{hue}"), "one hue cannot hold for several beacons"),
        (("--beacon", "{red}"), "several beacons are named 'red'"),
    ],
)
def test_what_does_not_fit_several_beacons_is_one_line(clear, tmp_path, capfd, words, text):
    (tmp_path / "hue.toml").write_text("schema = 1\nhue_deg = [0.0, 40.0]\n")
    words = [word.format(hue=tmp_path / "hue.toml", red=clear / "red.toml") for word in words]
    assert uvgs(*two(clear, 1), "--out", tmp_path / "p.csv", *words) == 2
    said = capfd.readouterr().err
    assert text in " ".join(said.split())
    assert "Traceback" not in said
    assert not (tmp_path / "p.csv").exists()


def test_ctrl_c_keeps_what_was_solved_and_says_so(clear, tmp_path, monkeypatch, capfd):
    grab = SimulatedCamera.grab

    def interrupted_grab(camera: SimulatedCamera) -> object:
        capture = grab(camera)
        if capture is not None and capture.index == 3:
            signal.raise_signal(signal.SIGINT)
        return capture

    monkeypatch.setattr(SimulatedCamera, "grab", interrupted_grab)
    out = tmp_path / "p.csv"
    source = f"sim:{clear / 'bench.toml'}"
    setup = ("--camera", clear / "camera.yaml", "--beacon", clear / "red.toml", "--quiet")
    assert uvgs(source, *setup, "--out", out) == 130
    said = capfd.readouterr()
    assert f"interrupted: 3 poses, 0 misses kept in {out}" in said.out
    assert "Traceback" not in said.err
    assert [record.index for record in read_poses(out)] == [0, 1, 2]
    monkeypatch.setattr(SimulatedCamera, "grab", interrupted_grab)
    assert uvgs(source, *setup, "--out", out, "--force", "--json") == 130
    assert json.loads(capfd.readouterr().out)["interrupted"] is True


def test_times_flags_and_debug_images_per_beacon(clear, tmp_path, capfd):
    out, debug = tmp_path / "p.csv", tmp_path / "debug"
    assert uvgs(*two(clear, 3), "--out", out, "--timing", "--json", "--debug-images", debug) == 0
    times = json.loads(capfd.readouterr().out)["stage_times"]
    assert {"blobs", "solve", "all stages"} <= set(times)
    for stage in times.values():
        assert 0.0 < stage["median_s"] <= stage["p95_s"] <= stage["p99_s"] <= stage["longest_s"]
        assert sum(bin_["count"] for bin_ in stage["histogram"]) == stage["count"]
    assert {path.name for path in debug.iterdir()} == {"red", "green"}
    assert len(list((debug / "green").iterdir())) == 3
    assert uvgs(*two(clear, 1), "--out", out, "--timing", "--force") == 0
    assert "p99" in capfd.readouterr().out


def test_a_missing_run_folder_is_missing_input(clear, tmp_path, capfd):
    setup = ("--camera", clear / "camera.yaml", "--beacon", clear / "red.toml")
    assert uvgs(tmp_path / "nowhere", *setup, "--out", tmp_path / "p.csv") == 4
    assert "there is no such run folder" in capfd.readouterr().err


def test_opencv_gets_as_many_threads_as_asked_for_and_the_answer_stays(clear, tmp_path, capfd):
    import cv2

    before = cv2.getNumThreads()
    try:
        for threads in (1, 2):
            out = tmp_path / f"{threads}.csv"
            assert uvgs(*two(clear, 2), "--out", out, "--threads", threads) == 0
            assert cv2.getNumThreads() == threads
    finally:
        cv2.setNumThreads(before)
    one, both = (np.array([record.pose.t_m for record in read_poses(tmp_path / f"{n}.csv")]) for n in (1, 2))
    assert (one == both).all()
    capfd.readouterr()
