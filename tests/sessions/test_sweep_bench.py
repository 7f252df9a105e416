"""Sweeps of the simulated bench through its serial protocol and its camera, also stopped from outside."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.sim.bench import live_benches, simulated_bench, true_lens
from uvgs_bench.errors import CalibrationError, ConfigError, EnvelopeError, GantryLost, RunError
from uvgs_bench.sessions.bench_setup import SetUp, read_setup, read_setup_of, resume, sweep
from uvgs_bench.sessions.events import Event, StageAdvanced
from uvgs_bench.store.bench import read_bench
from uvgs_bench.store.calibrations import write_calibration
from uvgs_bench.store.run import Run, read_run

pytestmark = pytest.mark.opencv

ROOT = Path(__file__).parents[2]
BENCH = ROOT / "calib" / "bench.toml"
SPEED = 400.0
ONLY_THIS_COMMAND = """
from uvgs_bench.cli import app
app.COMMANDS = {"gantry-sweep": app.COMMANDS["gantry-sweep"]}
app.main()
"""
PROCEDURE = """
schema = 1
name = "short"
pattern = "grid"
origin = "centre"
feed_mm_min = 3000.0
captures_per_station = 2
seed = 3
[grid]
lower = { X_mm = -60.0, Y_mm = -60.0, Z_mm = -60.0 }
upper = { X_mm = 60.0, Y_mm = 60.0, Z_mm = 60.0 }
counts = { X = 2, Y = 2, Z = 2 }
[approach]
kind = "from_below"
[limits]
position_rms_mm = 2.0
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a procedure and a calibration that knows the true lens."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "short.toml").write_text(PROCEDURE)
    simulated = read_bench(BENCH).simulated
    assert simulated is not None
    write_calibration(folder / "camera.yaml", Calibration(true_lens(simulated), "simulated"))
    return folder


def set_up_of(files: Path) -> SetUp:
    return read_setup(files / "short.toml", BENCH, camera=files / "camera.yaml")


def given(files: Path) -> list[object]:
    return [files / "short.toml", "--bench", BENCH, "--camera", files / "camera.yaml"]


def start(arguments: Sequence[object]) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", ONLY_THIS_COMMAND, "gantry-sweep", *map(str, arguments)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def interrupted(files: Path, out: Path, number: int, samples: int, wait_s: float = 0.0) -> tuple[int, str, str]:
    """Sweep in a process of its own and send it a signal when so many samples are on disk."""
    # Slow enough that a move takes a while, so that the signal meets one under way.
    process = start([*given(files), "--out", out, "--sim-speed", 20])
    deadline = time.monotonic() + 120.0
    while time.monotonic() < deadline and process.poll() is None:
        journals = list(out.glob("*/samples.jsonl"))
        if journals and journals[0].read_bytes().count(b"\n") >= samples:
            break
        time.sleep(0.01)
    time.sleep(wait_s)
    process.send_signal(number)
    stdout, stderr = process.communicate(timeout=60.0)
    return process.returncode, stdout, stderr


def stations_of(run: Run) -> list[tuple[int, int, int, str, tuple[float, ...]]]:
    return [(s.station, s.waypoint, s.shot, s.role, tuple(s.target)) for s in run.samples]


def test_a_sweep_keeps_everything_it_depends_on_and_sees_the_truth(files: Path, tmp_path: Path) -> None:
    set_up = set_up_of(files)
    result = sweep(set_up, tmp_path, keep="worst", simulated_speed=SPEED)
    run = read_run(result.path)
    assert run.is_complete
    assert (len(run.samples), result.pose_count) == (16, 16)
    assert {path.name for path in (run.path / "setup").iterdir()} == {
        "calibration.yaml", "beacon.toml", "bench.toml", "procedure.toml", "sensor.toml",
    }  # fmt: skip
    assert set(run.manifest.hashes) == {path.name for path in (run.path / "setup").iterdir()} | {"controller_settings"}
    assert run.manifest.simulated
    assert run.manifest.gantry_info["$130"] == "400.000"
    assert "$J=" in (run.path / "gantry.log").read_text()
    assert [limit.quantity for limit in run.manifest.limits] == ["position_rms_mm"]
    # Distances between stations as seen and as commanded: noise and the bench's errors are below 0.3 mm in depth.
    for a in run.samples:
        for b in run.samples:
            seen = np.linalg.norm(a.outcome.camera_from_beacon.t_m - b.outcome.camera_from_beacon.t_m)  # type: ignore[union-attr]
            assert seen == pytest.approx(np.linalg.norm(a.position - b.position), abs=3e-4)  # m


def test_the_same_seed_gives_the_same_plan_and_another_seed_another(files: Path) -> None:
    def hash_of(seed: int | None) -> str:
        return read_setup(files / "short.toml", BENCH, camera=files / "camera.yaml", seed=seed).plan.plan_hash

    assert hash_of(None) == hash_of(3) != hash_of(4)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_stops_the_motion_and_the_run_resumes(files: Path, tmp_path: Path, number: signal.Signals) -> None:
    code, _, stderr = interrupted(files, tmp_path, number, samples=4)
    assert code == 130, stderr[-1500:]
    (path,) = tmp_path.iterdir()
    assert f"uvgs gantry-sweep --resume {path}" in "".join(stderr.split("\n"))
    run = read_run(path)
    assert (run.ended, run.end_reason) == ("interrupted", "stopped by the user; the position is still known")
    log = (path / "gantry.log").read_text().splitlines()
    stop = max(i for i, line in enumerate(log) if line.endswith(">! 0x85"))
    assert not any("$J=" in line for line in log[stop:])
    assert "<Idle" in log[-1]
    before = stations_of(run)
    result = resume(run, read_setup_of(run), simulated_speed=SPEED)
    again = read_run(path)
    assert again.is_complete
    assert stations_of(again)[: len(before)] == before
    assert [s.station for s in again.samples] == [i // 2 for i in range(16)]
    assert result.capture_count + len(run.committed_stations()) * 2 == 16
    assert again.seams[0].reference_station == 0


def test_a_killed_run_is_readable_and_resumes(files: Path, tmp_path: Path) -> None:
    code, _, _ = interrupted(files, tmp_path, signal.SIGKILL, samples=7)
    assert code == -signal.SIGKILL
    (path,) = tmp_path.iterdir()
    run = read_run(path)
    assert run.ended == ""
    assert len(run.samples) >= 7
    process = start(["--resume", path, "--sim-speed", SPEED, "--json"])
    stdout, stderr = process.communicate(timeout=120.0)
    assert process.returncode == 0, stderr
    assert json.loads(stdout)["run"] == str(path)
    again = read_run(path)
    assert again.is_complete
    assert [s.station for s in again.samples] == [i // 2 for i in range(16)]


def test_resuming_names_what_changed_and_notices_a_moved_camera(files: Path, tmp_path: Path) -> None:
    set_up = set_up_of(files)
    (tmp_path / "own.toml").write_text(PROCEDURE)
    own = read_setup(tmp_path / "own.toml", BENCH, camera=files / "camera.yaml")
    path = _broken_run(own, tmp_path / "runs")
    run = read_run(path)
    (tmp_path / "own.toml").write_text(PROCEDURE.replace("2.0", "9.0"))
    with pytest.raises(RunError, match=r"changed since it was begun: procedure\.toml; --accept-changes"):
        resume(run, read_setup_of(run), simulated_speed=SPEED)
    (tmp_path / "own.toml").write_text(PROCEDURE)
    again = read_setup_of(run)
    assert again.bench.simulated is not None
    pose = again.bench.simulated.camera_from_gantry
    x_mm, y_mm, z_mm = pose.position_mm
    kicked = replace(again.bench.simulated, camera_from_gantry=replace(pose, position_mm=(x_mm + 2.0, y_mm, z_mm)))
    # mm; the two looks differ by repeatability and noise of some hundredths.
    with pytest.raises(RunError, match=r"station 0 is seen (1\.9|2\.0)\d+ mm .* something moved"):
        resume(run, replace(again, bench=replace(again.bench, simulated=kicked)), simulated_speed=SPEED)
    assert resume(read_run(path), again, simulated_speed=SPEED).path == path
    assert read_run(path).is_complete
    assert set_up.plan.plan_hash == own.plan.plan_hash


def _broken_run(set_up: SetUp, folder: Path) -> Path:
    def interrupt(event: Event) -> None:
        if isinstance(event, StageAdvanced) and event.done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep(set_up, folder, keep="none", simulated_speed=SPEED, sink=interrupt)
    (path,) = folder.iterdir()
    return path


def test_what_does_not_fit_is_refused_before_anything_opens(files: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="make one with uvgs calibrate"):
        read_setup(files / "short.toml", BENCH, camera=tmp_path / "none.yaml")
    with pytest.raises(ConfigError, match="sees only the simulated gantry"):
        read_setup(files / "short.toml", BENCH, camera=files / "camera.yaml", gantry_spec="grbl:/dev/ttyACM9")
    far = tmp_path / "far.toml"
    far.write_text(PROCEDURE.replace("X_mm = 60.0", "X_mm = 600.0"))
    with pytest.raises(EnvelopeError, match=r"waypoint \d: axis X at 399"):
        read_setup(far, BENCH, camera=files / "camera.yaml")


def test_a_controller_that_restarts_by_itself_ends_the_run_which_then_resumes(files: Path, tmp_path: Path) -> None:
    def press_reset(event: Event) -> None:
        if isinstance(event, StageAdvanced) and event.done == 3:
            (name,) = live_benches()
            bench = simulated_bench(name)
            bench.device.receive(0x18, bench.clock.now_ns())

    set_up = set_up_of(files)
    with pytest.raises(GantryLost, match="restarted by itself"):
        sweep(set_up, tmp_path, keep="none", simulated_speed=SPEED, sink=press_reset)
    (path,) = tmp_path.iterdir()
    run = read_run(path)
    assert run.ended == "failed"
    assert "restarted by itself" in run.end_reason
    assert run.committed_stations() == {0, 1, 2}
    resume(run, read_setup_of(run), simulated_speed=SPEED)
    assert read_run(path).is_complete
    assert live_benches() == ()


def test_pictures_that_do_not_fit_the_calibration_are_refused_before_a_run_begins(files: Path, tmp_path: Path) -> None:
    set_up = set_up_of(files)
    lens = set_up.calibration.lens
    half = Calibration(Lens(lens.model, lens.width_px // 2, lens.height_px // 2, lens.parameters), "half")
    with pytest.raises(CalibrationError, match=r"is 1280x960 px but calibration .half. is for 640x480 px"):
        sweep(replace(set_up, calibration=half), tmp_path, simulated_speed=SPEED)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def whole(files: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A sweep that nothing interrupted."""
    folder = tmp_path_factory.mktemp("whole")
    return read_run(sweep(set_up_of(files), folder, keep="none", simulated_speed=SPEED).path)


def killed_at_random(files: Path, out: Path, seed: int) -> Run:
    """A sweep killed with signal 9 at a random instant, before the first sample too, and then resumed."""
    rng = np.random.default_rng(seed)
    interrupted(files, out, signal.SIGKILL, samples=int(rng.integers(0, 15)), wait_s=float(rng.uniform(0.0, 0.2)))
    (path,) = out.iterdir()
    run = read_run(path)
    if not run.is_complete:
        resume(run, read_setup_of(run), simulated_speed=SPEED)
    return read_run(path)


@pytest.mark.parametrize("seed", [0, 1])
def test_killed_at_random_the_stations_are_those_of_a_whole_run(
    files: Path, tmp_path: Path, whole: Run, seed: int
) -> None:
    assert stations_of(killed_at_random(files, tmp_path, seed)) == stations_of(whole)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2, 102))
def test_a_hundred_kills(files: Path, tmp_path: Path, whole: Run, seed: int) -> None:
    assert stations_of(killed_at_random(files, tmp_path, seed)) == stations_of(whole)


def test_a_dry_run_prints_the_plan_and_moves_nothing(files: Path, tmp_path: Path) -> None:
    process = start([files / "short.toml", "--bench", BENCH, "--out", tmp_path, "--dry-run", "--json"])
    stdout, stderr = process.communicate(timeout=120.0)
    assert process.returncode == 0, stderr
    facts = json.loads(stdout)
    assert (facts["stations"], facts["captures"]) == (8, 16)
    assert facts["distance_mm"] > 0.0
    assert facts["duration_s"] > 0.0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("path", sorted((ROOT / "procedures").glob("*.toml")), ids=lambda path: path.stem)
def test_the_shipped_procedures_fit_the_shipped_bench(files: Path, path: Path) -> None:
    # Some say which other bench they are for.
    named = re.search(r"--bench (calib/\w+\.toml)", path.read_text())
    bench = ROOT / named[1] if named else BENCH
    assert read_setup(path, bench, camera=files / "camera.yaml").plan.capture_count > 0
