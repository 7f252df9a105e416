"""A sweep that loses its camera, its port or its disk: motion first, then what is known of the place, then a resume."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from io import FileIO
from pathlib import Path

import pytest

from tests.sessions.test_sweep_bench import (
    BENCH,
    ONLY_THIS_COMMAND,
    PROCEDURE,
    ROOT,
    SPEED,
    given,
    start,
)
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.devices.sim.bench import live_benches, true_lens
from uvgs_bench.devices.sim.camera import SimulatedCamera
from uvgs_bench.devices.sim.protocol_sim import Serial
from uvgs_bench.errors import CaptureError, GantryLost, RunError, UvgsError
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sessions.bench_setup import read_setup, read_setup_of, resume, sweep
from uvgs_bench.sessions.events import Event, StageAdvanced
from uvgs_bench.store.bench import read_bench
from uvgs_bench.store.calibrations import write_calibration
from uvgs_bench.store.run import Run, read_run
from uvgs_bench.store.run_writer import RunWriter

pytestmark = pytest.mark.opencv

STATIONS = 8


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A procedure of eight stations with two captures each, and a calibration that knows the true lens."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "short.toml").write_text(PROCEDURE)
    simulated = read_bench(BENCH).simulated
    assert simulated is not None
    write_calibration(folder / "camera.yaml", Calibration(true_lens(simulated), "simulated"))
    return folder


class Loss:
    """Becomes true once three stations are on disk."""

    def __init__(self) -> None:
        self.has_come = False

    def __call__(self, event: Event) -> None:
        if isinstance(event, StageAdvanced) and event.stage == "sweep" and event.done == 3:
            self.has_come = True


def broken(files: Path, out: Path, loss: Loss, error: type[UvgsError]) -> tuple[Run, str]:
    """A run that ended with this error, and the message."""
    set_up = read_setup(files / "short.toml", BENCH, camera=files / "camera.yaml")
    with pytest.raises(error) as said:
        sweep(set_up, out, keep="none", simulated_speed=SPEED, sink=loss)
    assert live_benches() == ()
    (path,) = out.iterdir()
    return read_run(path), str(said.value)


def check_resumed(run: Run) -> None:
    """Everything else is taken, nothing twice."""
    resume(run, read_setup_of(run), simulated_speed=SPEED)
    again = read_run(run.path)
    assert again.is_complete
    assert [sample.station for sample in again.samples] == [i // 2 for i in range(2 * STATIONS)]
    assert len(again.seams) == 1


def wire_after_last_move(run: Run) -> list[str]:
    log = (run.path / "gantry.log").read_text().splitlines()
    return log[max(i for i, line in enumerate(log) if "$J=" in line) + 1 :]


@pytest.mark.parametrize("how", ["ends", "fails"])
def test_without_its_camera_a_run_stops_and_knows_where_it_is(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    loss, real = Loss(), SimulatedCamera.grab

    def grab(self: SimulatedCamera) -> Capture | None:
        if not loss.has_come:
            return real(self)
        if how == "ends":
            return None
        raise CaptureError("the camera is unplugged", self.spec)

    monkeypatch.setattr(SimulatedCamera, "grab", grab)
    run, said = broken(files, tmp_path, loss, CaptureError)
    assert ("ended in the middle" if how == "ends" else "unplugged") in said
    assert run.ended == "failed"
    assert said in run.end_reason
    assert run.end_reason.endswith("the position is still known")
    assert run.committed_stations() == {0, 1, 2}
    # Told to stop, and seen at rest, before the run is closed.
    after = wire_after_last_move(run)
    assert any(line.endswith(">! 0x85") for line in after)
    assert "<Idle" in after[-1]
    monkeypatch.undo()
    check_resumed(run)


def test_without_its_port_a_run_says_that_nobody_knows_where_it_is(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loss, real = Loss(), Serial.write

    def write(self: Serial, data: bytes) -> int:
        if loss.has_come and b"$J=" in data:
            loss.has_come = False
            monkeypatch.setattr(Serial, "write", gone)
            real(self, data)
        return real(self, data)

    def gone(self: Serial, data: bytes) -> int:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(Serial, "write", write)
    run, said = broken(files, tmp_path, loss, GantryLost)
    assert "the port vanished; the position is lost" in said
    assert run.ended == "failed"
    assert "did not confirm that it stopped" in run.end_reason
    assert run.end_reason.endswith("the position is lost")
    assert run.committed_stations() == {0, 1, 2}
    # The way to the stop was tried, and the loss is in the log.
    assert any("port lost" in line for line in wire_after_last_move(run))
    monkeypatch.undo()
    check_resumed(run)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full, whose every write is ENOSPC")
@pytest.mark.parametrize("stream", ["_journal", "_wire"])
def test_on_a_full_disk_a_run_stops_says_why_and_goes_on_later(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stream: str
) -> None:
    loss, writers, real = Loss(), [], RunWriter.__init__

    def init(self: RunWriter, *arguments: object) -> None:
        real(self, *arguments)  # type: ignore[arg-type]
        writers.append(self)

    def filling(event: Event) -> None:
        loss(event)
        if loss.has_come:
            loss.has_come = False
            getattr(writers[-1], stream).close()
            setattr(writers[-1], stream, FileIO("/dev/full", "ab"))

    monkeypatch.setattr(RunWriter, "__init__", init)
    set_up = read_setup(files / "short.toml", BENCH, camera=files / "camera.yaml")
    with pytest.raises(RunError, match="the disk is full"):
        sweep(set_up, tmp_path, keep="none", simulated_speed=SPEED, sink=filling)
    (path,) = tmp_path.iterdir()
    run = read_run(path)
    assert run.ended == "failed"
    assert "the disk is full: No space left on device" in run.end_reason
    assert run.end_reason.endswith("the position is still known")
    assert run.committed_stations() == {0, 1, 2}
    monkeypatch.undo()
    check_resumed(run)


SMALL_DISK = """
set -u
mount -t tmpfs -o size={size} none {disk} || exit 77
{sweep} --out {disk}
echo "first $?"
run=$(echo {disk}/*)
tail -n 1 $run/gantry.log
grep reason $run/run.toml
mount -o remount,size=64M {disk}
{python} --resume $run --sim-speed 400 --quiet
echo "second $?"
grep -c station $run/samples.jsonl
"""


@pytest.mark.skipif(shutil.which("unshare") is None, reason="needs unshare")
def test_a_disk_that_is_too_small_for_the_pictures(files: Path, tmp_path: Path) -> None:
    """The whole command on a real file system of 3 MB, which is made larger then."""
    disk = tmp_path / "disk"
    disk.mkdir()
    (tmp_path / "sweep.py").write_text(ONLY_THIS_COMMAND)
    python = f"{sys.executable} {tmp_path / 'sweep.py'} gantry-sweep"
    words = " ".join(map(str, given(files)))
    command = f"{python} {words} --keep all --sim-speed 400 --quiet"
    script = SMALL_DISK.format(size="3M", disk=disk, sweep=command, python=python)
    done = subprocess.run(
        ["unshare", "-rm", "sh", "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False
    )
    if done.returncode == 77 or "unshare" in done.stderr:
        pytest.skip("mounting is not allowed here")
    lines = done.stdout.splitlines()
    assert "first 4" in lines, done.stdout + done.stderr
    assert "the disk is full: No space left on device; the position is still known" in done.stdout
    assert "second 0" in lines, done.stdout + done.stderr
    assert int(lines[-1]) >= 2 * STATIONS


def test_a_second_ctrl_c_stops_hard(files: Path, tmp_path: Path) -> None:
    # Braking takes three seconds of bench time, so that the second signal meets it.
    text = BENCH.read_text().replace("acceleration_mm_s2 = 200.0", "acceleration_mm_s2 = 10.0")
    for kind in ("cameras", "beacons"):
        text = text.replace(f'"{kind}/', f'"{ROOT / "calib" / kind}/')
    (tmp_path / "slow.toml").write_text(text)
    out = tmp_path / "runs"
    words = [files / "short.toml", "--bench", tmp_path / "slow.toml", "--camera", files / "camera.yaml"]
    process = start([*words, "--out", out, "--sim-speed", 4])

    def wait_for(what: str, since: str) -> None:
        """Until this stands in the log after the last line with that."""
        deadline = time.monotonic() + 120.0
        while time.monotonic() < deadline and process.poll() is None:
            logs = list(out.glob("*/gantry.log"))
            text = logs[0].read_text() if logs else ""
            if since in text and what in text[text.rindex(since) :]:
                return
            time.sleep(0.005)
        pytest.fail(f"{what} never came: {process.communicate(timeout=10.0)}")

    wait_for("<Jog", "$J=")
    os.kill(process.pid, signal.SIGINT)
    wait_for(">! 0x85", "$J=")
    os.kill(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=60.0)
    assert process.returncode == 130, stderr
    (path,) = out.iterdir()
    run = read_run(path)
    assert run.ended == "interrupted"
    assert "stopped hard at the second interrupt, the position is lost" in run.end_reason
    assert any(line.endswith(">! 0x18") for line in wire_after_last_move(run))
