"""``uvgs run --view`` as started by a user: sliders change the running sensor, the pose file says where."""

from __future__ import annotations

import csv
import json
import os
import pty
import select
import subprocess
import sys
import tomllib

import pytest

from tests.helpers.run_view import ROOT, running_view
from tests.helpers.sim_bench import write_bench
from uvgs_bench.cli.app import main

pytestmark = pytest.mark.opencv


def uvgs(*words: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main(["run", *(str(word) for word in words)])
    return int(caught.value.code or 0)


@pytest.fixture
def bench(tmp_path):
    return write_bench(tmp_path / "bench")


def files(bench):
    return "--camera", bench.parent / "camera.yaml", "--beacon", bench.parent / "any.toml"


def test_a_slider_changes_the_running_sensor_and_the_pose_file_says_where(bench, tmp_path):
    config = tmp_path / "sensor.toml"
    config.write_text("schema = 1  # mine\nmin_contrast = 0.04\n")
    out = tmp_path / "poses.csv"
    with running_view(tmp_path, f"sim:{bench}", *files(bench), "--config", config, "--out", out) as view:
        events = view.events()
        name, setup = next(events)
        assert name == "setup"
        assert {slider["name"]: slider["value"] for slider in setup["sliders"]}["min_contrast"] == 0.04
        assert next(data for name, data in events if name == "capture")["beacons"][0]["status"] == "ok"
        assert view.order("tune", changes={"min_contrast": 0.9}) == (200, {"is_done": True, "said": "taken"})
        for _, data in events:
            if data.get("beacons") and isinstance(data["beacons"], list) and data["beacons"][0]["status"] == "miss":
                break
        assert data["beacons"][0]["reason"].startswith(("preprocess/", "blobs/"))
        assert view.order("tune", changes={"min_contrast": 0.05})[0] == 200
        status, told = view.order("save")
        assert status == 200
        assert str(config) in told["said"]
        status, told = view.order("snapshot")
        assert status == 200
        assert view.order("jog", axis="X", offset=0.001)[0] == 403
        old_s = data["exposure_s"]
        assert view.order("expose", exposure_s=old_s / 2)[0] == 200
        for _, data in events:
            if data.get("exposure_s") == pytest.approx(old_s / 2):
                break
        events.close()
        assert view.end() == 130
    assert config.read_text() == "schema = 1  # mine\nmin_contrast = 0.05\n"
    assert len(list((tmp_path / "reports").glob("*.png"))) == 1
    rows = list(csv.DictReader(out.read_text().splitlines()))
    changed = [k for k, row in enumerate(rows) if "parameters_changed" in row["flags"]]
    assert len(changed) == 2
    first, second = changed
    # Between the changes, and only there, the picture has too little contrast.
    assert {row["status"] for row in rows[first:second]} == {"miss"}
    assert {row["status"] for row in rows[:first]} == {"ok"}
    assert "parameters changed" in view.log.read_text()


def test_a_record_keeps_one_set_of_parameters(bench, tmp_path):
    with running_view(tmp_path, f"sim:{bench}", *files(bench), "--record", tmp_path / "r.mcap") as view:
        name, setup = next(view.events())
        assert (name, setup["sliders"]) == ("setup", [])
        status, told = view.order("tune", changes={"threshold_k": 3.0})
        assert status == 409
        assert "record" in told["said"]


def test_the_gantry_moves_before_the_camera_only_when_allowed(bench, tmp_path):
    """The camera ``sim:`` looks at the very gantry that is moved."""
    with running_view(tmp_path, "sim:", *files(bench), "--allow-motion", bench) as view:
        captures = (data for name, data in view.events() if name == "capture")
        first = next(captures)
        assert first["gantry"]["is_homed"] is False
        assert first["gantry"]["positions"][0] == ["X", "unknown"]
        # By the clock of the simulated bench: a figure between two clocks would be of hours.
        assert 0.0 < first["latency_s"] < 10.0
        assert view.order("jog", axis="X", offset=-0.01)[0] == 409
        assert view.order("home")[0] == 200
        before = next(data for data in captures if data["gantry"]["said"] == "homing: done")
        assert view.order("jog", axis="X", offset=-0.01)[0] == 200
        after = next(data for data in captures if data["gantry"]["said"] == "jogging X by -10.000 mm: done")
        places = [data["beacons"][0]["pose"]["t_m"] for data in (before, after)]
        # 10 mm of travel, seen to well within 0.5 mm: backlash, scatter of the pose, the tilt of the axis.
        assert sum((a - b) ** 2 for a, b in zip(*places, strict=True)) ** 0.5 == pytest.approx(0.01, abs=5e-4)
        assert view.end() == 130


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--view-port", "80"), "needs --view"),
        (("--snapshots", "x"), "needs --view"),
        (("--allow-motion", "x.toml"), "needs --view"),
        (("--foxglove-port", "1"), "needs --foxglove"),
        (("--view", "--allow-motion", "nowhere.toml"), "nowhere.toml"),
        (("--view", "--view-port", "70000"), "65535"),
    ],
)
def test_options_that_mean_nothing_are_refused(bench, capfd, words, said):
    assert uvgs(f"sim:{bench}?count=3", *files(bench), *words) in (2, 4)
    assert said in " ".join(capfd.readouterr().err.split())


def test_a_taken_port_is_one_line(bench, capfd):
    import socket

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert uvgs(f"sim:{bench}?count=3", *files(bench), "--view", "--view-port", port) == 2
    assert f"--view-port {port}: cannot serve there" in " ".join(capfd.readouterr().err.split())


def test_all_poses_are_the_same_with_and_without_a_view(bench, tmp_path):
    words = (f"sim:{bench}?count=20", *files(bench))
    assert uvgs(*words, "--out", tmp_path / "a.csv") == 0
    assert uvgs(*words, "--out", tmp_path / "b.csv", "--view", "--view-port", "0", "--rate-hz", "5") == 0
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


@pytest.mark.parametrize("quiet", [False, True])
def test_a_terminal_gets_the_panel(bench, tmp_path, quiet):
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "uvgs_bench", "run", f"sim:{bench}?count=30", *map(str, files(bench)), "--json"]
    command += ["--out", str(tmp_path / "p.csv"), *(["--quiet"] if quiet else [])]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TERM": "xterm-256color", "COLUMNS": "60"}
    process = subprocess.Popen(command, stderr=theirs, stdout=subprocess.PIPE, env=environment)
    os.close(theirs)
    text = b""
    while True:
        if not select.select([ours], [], [], 120.0)[0]:
            break
        try:
            part = os.read(ours, 65536)
        except OSError:
            break
        if not part:
            break
        text += part
    assert process.stdout is not None
    summary = json.loads(process.stdout.read())
    process.stdout.close()
    os.close(ours)
    assert process.wait(60) == 0
    assert summary["poses"] == 30
    assert (b"30 of 30, 30 with a pose" in text) == (not quiet)
    assert b"Traceback" not in text


def test_the_saved_file_is_a_sensor_file(bench, tmp_path):
    with running_view(tmp_path, f"sim:{bench}", *files(bench)) as view:
        assert view.order("tune", changes={"threshold_k": 3.0})[0] == 200
        assert view.order("save")[0] == 200
    assert tomllib.loads((tmp_path / "reports" / "sensor.toml").read_text()) == {"schema": 1, "threshold_k": 3.0}
