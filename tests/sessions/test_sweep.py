"""However a sweep ends: the motion stops first, the run says why, nothing is lost and nothing doubled."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.fake_rig import FakeRig
from uvgs_bench.errors import CaptureError, ConfigError, GantryAlarm, GantryLost, RunError
from uvgs_bench.sessions import sweep
from uvgs_bench.sessions.events import Event, Remark
from uvgs_bench.sessions.resume import check_same_setup, resume_sweep
from uvgs_bench.sessions.sweep import run_sweep
from uvgs_bench.store import run as run_module
from uvgs_bench.store import run_writer
from uvgs_bench.store.run import Run, RunWriter, read_run


@pytest.fixture(autouse=True)
def _without_setup(monkeypatch: pytest.MonkeyPatch) -> None:
    """These runs have no set-up copies; what they say about themselves is what counts here."""
    monkeypatch.setattr(run_module, "_read_setup", lambda folder: (None, None))


@pytest.fixture
def fake(tmp_path: Path) -> FakeRig:
    return FakeRig(tmp_path)


def stations_of(run: Run) -> list[tuple[int, int, int, str, tuple[float, ...]]]:
    return [(s.station, s.waypoint, s.shot, s.role, tuple(s.target)) for s in run.samples]


def interrupt_at_move(fake: FakeRig, number: int, error: BaseException) -> None:
    def before(move: int) -> None:
        if move == number:
            raise error

    fake.gantry.before_move = before


def test_a_whole_sweep_is_completed_and_says_what_it_took(fake: FakeRig) -> None:
    fake.sensor.miss_every = 5
    result = run_sweep(fake.plan, fake.rig, fake.writer())
    assert (result.station_count, result.capture_count, result.pose_count) == (6, 12, 9)
    assert result.misses == {"blobs/too_few_blobs": 3}
    run = read_run(fake.path)
    assert run.is_complete
    assert run.committed_stations() == set(range(6))
    assert fake.gantry.history == ["home"] + ["move"] * 6
    for sample in run.samples:
        station = fake.plan.stations[sample.station]
        assert np.array_equal(sample.position, station.target)
        assert sample.role == station.role
    stamps = [s.t_ns for s in run.samples]
    assert stamps == sorted(stamps)


@pytest.mark.parametrize(
    ("error", "ended", "reason"),
    [
        (KeyboardInterrupt(), "interrupted", "stopped by the user"),
        (GantryAlarm("alarm 1: hard limit", "fake", 1), "failed", "fake: alarm 1: hard limit"),
        (GantryLost("the port vanished", "fake"), "failed", "fake: the port vanished"),
        (CaptureError("the camera is gone", "fake"), "failed", "fake: the camera is gone"),
        (RunError("the disk is full", "run"), "failed", "run: the disk is full"),
        (MemoryError(), "failed", "MemoryError"),
    ],
)
def test_whatever_breaks_a_move_stops_the_motion_and_closes_the_run(
    fake: FakeRig, error: BaseException, ended: str, reason: str
) -> None:
    interrupt_at_move(fake, 3, error)
    events: list[Event] = []
    with pytest.raises(type(error)):
        run_sweep(fake.plan, fake.rig, fake.writer(), sink=events.append)
    assert fake.gantry.history[-2:] == ["move", "stop"]
    run = read_run(fake.path)
    assert (run.ended, run.end_reason) == (ended, f"{reason}; the position is still known")
    assert run.committed_stations() == {0, 1, 2}
    assert any(isinstance(e, Remark) and f"--resume {fake.path}" in e.text for e in events)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupt_that_is_lost_on_its_way_still_ends_the_sweep(fake: FakeRig, number: signal.Signals) -> None:
    def swallow(move: int) -> None:
        if move == 2:
            # As the interpreter does when a signal arrives within a destructor.
            with contextlib.suppress(KeyboardInterrupt):
                os.kill(os.getpid(), number)
                time.sleep(1.0)

    fake.gantry.before_move = swallow
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt):
        run_sweep(fake.plan, fake.rig, fake.writer())
    assert fake.gantry.moves == 3
    assert fake.gantry.history[-1] == "stop"
    assert read_run(fake.path).ended == "interrupted"
    assert signal.getsignal(number) is before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_interrupt_while_stopping_is_a_hard_stop_and_a_third_changes_nothing(
    fake: FakeRig, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    interrupt_at_move(fake, 1, KeyboardInterrupt())

    def slow() -> None:
        os.kill(os.getpid(), number)
        time.sleep(5.0)
        pytest.fail("the stop was not cut short")

    reset = fake.gantry.reset

    def insisting() -> object:
        os.kill(os.getpid(), number)
        return reset()

    monkeypatch.setattr(fake.gantry, "stop", slow)
    monkeypatch.setattr(fake.gantry, "reset", insisting)
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt):
        run_sweep(fake.plan, fake.rig, fake.writer())
    assert fake.gantry.history[-1] == "reset"
    run = read_run(fake.path)
    assert run.ended == "interrupted"
    assert run.end_reason == "stopped by the user; stopped hard at the second interrupt, the position is lost"
    assert run.committed_stations() == {0}
    assert signal.getsignal(number) is before


def test_what_is_known_of_the_position_is_said(fake: FakeRig) -> None:
    def slip(move: int) -> None:
        if move == 2:
            fake.gantry.is_trusted = False
            raise GantryAlarm("alarm 1: hard limit", "fake", 1)

    fake.gantry.before_move = slip
    with pytest.raises(GantryAlarm):
        run_sweep(fake.plan, fake.rig, fake.writer())
    assert read_run(fake.path).end_reason.endswith("; the position is lost")


def test_ctrl_z_pauses_at_the_next_station(fake: FakeRig, monkeypatch: pytest.MonkeyPatch) -> None:
    paused: list[int] = []
    monkeypatch.setattr(sweep, "pause", lambda: paused.append(fake.gantry.moves))
    fake.gantry.before_move = lambda move: os.kill(os.getpid(), signal.SIGTSTP) if move == 2 else None
    events: list[Event] = []
    before = signal.getsignal(signal.SIGTSTP)
    run_sweep(fake.plan, fake.rig, fake.writer(), sink=events.append)
    # The third station is finished first.
    assert paused == [3]
    assert [e.text for e in events if isinstance(e, Remark)] == [
        f"paused before station 3: go on with fg, or kill -CONT {os.getpid()}",
        "going on",
    ]
    assert signal.getsignal(signal.SIGTSTP) is before
    assert read_run(fake.path).is_complete
    assert "# paused before station 3" in (fake.path / "gantry.log").read_text()


def test_a_signal_that_is_ignored_stays_ignored(fake: FakeRig) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        fake.gantry.before_move = lambda move: os.kill(os.getpid(), signal.SIGHUP)
        run_sweep(fake.plan, fake.rig, fake.writer())
    finally:
        signal.signal(signal.SIGHUP, before)
    assert read_run(fake.path).is_complete


def test_the_motion_is_stopped_before_the_run_is_closed(fake: FakeRig, monkeypatch: pytest.MonkeyPatch) -> None:
    interrupt_at_move(fake, 1, KeyboardInterrupt())
    close = RunWriter.close

    def watched(self: RunWriter, *args: object) -> None:
        fake.gantry.history.append("close")
        close(self, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(RunWriter, "close", watched)
    with pytest.raises(KeyboardInterrupt):
        run_sweep(fake.plan, fake.rig, fake.writer())
    assert fake.gantry.history[-2:] == ["stop", "close"]


def test_a_stop_that_fails_is_said_in_the_run(fake: FakeRig, monkeypatch: pytest.MonkeyPatch) -> None:
    interrupt_at_move(fake, 1, KeyboardInterrupt())

    def deaf() -> None:
        raise GantryLost("gone", "fake")

    monkeypatch.setattr(fake.gantry, "stop", deaf)
    with pytest.raises(KeyboardInterrupt):
        run_sweep(fake.plan, fake.rig, fake.writer())
    assert "did not confirm that it stopped" in read_run(fake.path).end_reason


def test_captures_exposed_before_settling_are_discarded(fake: FakeRig) -> None:
    fake.camera.age_s = [2.0, 0.4, 0.2]
    result = run_sweep(fake.plan, fake.rig, fake.writer())
    assert result.capture_count == 12
    assert fake.camera.count == 12 + 3
    # Each station settles for 0.5 s after a move of 1 s; stamps are later than that.
    assert read_run(fake.path).samples[0].t_ns >= 1_000_000 + 1_500_000_000


def test_a_camera_that_only_delivers_the_past_is_an_error_and_so_is_a_recording(fake: FakeRig, tmp_path: Path) -> None:
    fake.camera.age_s = [60.0] * 200
    with pytest.raises(CaptureError, match="exposed before the carriage had settled"):
        run_sweep(fake.plan, fake.rig, fake.writer())
    assert read_run(fake.path).ended == "failed"
    other = FakeRig(tmp_path / "other")
    other.camera.is_live = False
    with pytest.raises(ConfigError, match="needs a live camera"):
        run_sweep(other.plan, other.rig, other.writer())
    assert "move" not in other.gantry.history


def test_a_carriage_that_moves_during_the_captures_leaves_no_sample(fake: FakeRig) -> None:
    def pushed(number: int) -> None:
        if number == 5:
            fake.gantry.position = fake.gantry.position + np.array([0.0, 5e-5, 0.0])

    fake.camera.after_grab = pushed
    with pytest.raises(GantryLost, match=r"station 2 axis Y stands at -9\.950 mm, expected -10\.000 mm"):
        run_sweep(fake.plan, fake.rig, fake.writer())
    assert read_run(fake.path).committed_stations() == {0, 1}
    assert len(read_run(fake.path).samples) == 4


def test_an_untrusted_position_is_never_used(fake: FakeRig) -> None:
    fake.gantry.is_trusted = False
    with pytest.raises(GantryLost, match="cannot be trusted"):
        run_sweep(fake.plan, fake.rig, fake.writer())
    assert read_run(fake.path).samples == ()


@pytest.mark.parametrize(("keep", "flushes"), [("none", 1), ("all", 3)])
def test_a_station_costs_one_flush_and_one_for_each_picture(
    fake: FakeRig, monkeypatch: pytest.MonkeyPatch, keep: str, flushes: int
) -> None:
    writer = fake.writer(keep)
    calls: list[str] = []
    fsync = os.fsync

    def counted(number: int) -> None:
        calls.append(Path(os.readlink(f"/proc/self/fd/{number}")).name)
        fsync(number)

    monkeypatch.setattr(os, "fsync", counted)
    moves = []
    fake.gantry.before_move = lambda _move: moves.append(len(calls))
    run_sweep(fake.plan, fake.rig, writer)
    assert list(np.diff(moves)) == [flushes] * 5
    # The line follows its pictures.
    assert calls[flushes - 1] == "samples.jsonl"


def test_a_full_disk_stops_the_motion_and_the_run_says_why(fake: FakeRig, monkeypatch: pytest.MonkeyPatch) -> None:
    real, written = run_writer._write_whole, []

    def filling(stream: object, content: bytes) -> None:
        written.append(len(content))
        if len(written) > 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(stream, content)  # type: ignore[arg-type]

    monkeypatch.setattr(run_writer, "_write_whole", filling)
    with pytest.raises(RunError, match="the disk is full"):
        run_sweep(fake.plan, fake.rig, fake.writer())
    assert fake.gantry.history[-1] == "stop"
    run = read_run(fake.path)
    assert run.ended == "failed"
    assert "the disk is full" in run.end_reason
    assert len(run.samples) == 4


def resumed(fake: FakeRig, rig: FakeRig) -> Run:
    """Resume the run of one rig on another, as a new process would."""
    run = read_run(fake.path)
    check_same_setup(run, rig.plan, {"beacon.toml": "aa"})
    resume_sweep(run, rig.plan, rig.rig, RunWriter.reopen(run, rig.clock.now_ns()))
    return read_run(fake.path)


@pytest.mark.parametrize("at_move", range(6))
def test_a_resumed_run_has_the_stations_of_an_uninterrupted_one(tmp_path: Path, at_move: int) -> None:
    whole = FakeRig(tmp_path / "whole")
    run_sweep(whole.plan, whole.rig, whole.writer())
    broken = FakeRig(tmp_path / "broken")
    interrupt_at_move(broken, at_move, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        run_sweep(broken.plan, broken.rig, broken.writer())
    run = resumed(broken, FakeRig(tmp_path / "unused"))
    assert run.is_complete
    assert stations_of(run) == stations_of(read_run(whole.path))
    assert len(run.seams) == 1
    assert run.seams[0].reference_station == (0 if at_move else -1)
    stamps = [s.t_ns for s in run.samples]
    assert stamps == sorted(stamps)


def test_a_half_done_station_is_taken_again_and_counts_once(fake: FakeRig, tmp_path: Path) -> None:
    interrupt_at_move(fake, 3, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        run_sweep(fake.plan, fake.rig, fake.writer())
    journal = fake.path / "samples.jsonl"
    # As a power failure leaves it: one line of two.
    journal.write_text("".join(journal.read_text().splitlines(keepends=True)[:5]))
    assert len(read_run(fake.path).samples) == 5
    run = resumed(fake, FakeRig(tmp_path / "unused"))
    assert [s.station for s in run.samples] == [i // 2 for i in range(12)]
    assert [s.attempt for s in run.samples if s.station == 2] == [1, 1]
    assert len((fake.path / "samples.jsonl").read_text().splitlines()) == 13
    assert len({s.index for s in run.samples}) == 12


def test_resuming_refuses_what_changed_by_name(fake: FakeRig, tmp_path: Path) -> None:
    interrupt_at_move(fake, 3, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        run_sweep(fake.plan, fake.rig, fake.writer())
    run = read_run(fake.path)
    with pytest.raises(
        RunError, match=r"changed since it was begun: beacon\.toml, bench\.toml \(new\), planned stations"
    ):
        check_same_setup(run, FakeRig(tmp_path / "x", stations=7).plan, {"beacon.toml": "bb", "bench.toml": "cc"})
    with pytest.raises(RunError, match=r"beacon\.toml \(missing\)"):
        check_same_setup(run, fake.plan, {})


def test_what_changed_can_be_accepted_and_is_kept_in_the_seam(fake: FakeRig, tmp_path: Path) -> None:
    interrupt_at_move(fake, 3, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        run_sweep(fake.plan, fake.rig, fake.writer())
    run = read_run(fake.path)
    accepted = check_same_setup(run, fake.plan, {"beacon.toml": "bb"}, accepts_changes=True)
    assert accepted == ("beacon.toml",)
    other = FakeRig(tmp_path / "x", stations=7)
    with pytest.raises(RunError, match=r"planned stations$"):
        check_same_setup(run, other.plan, {"beacon.toml": "bb"}, accepts_changes=True)
    again = FakeRig(tmp_path / "again")
    writer = RunWriter.reopen(run, again.clock.now_ns())
    writer.keep_changed({"beacon.toml": b"changed"})
    resume_sweep(run, again.plan, again.rig, writer, accepted=accepted)
    run = read_run(fake.path)
    assert run.is_complete
    assert run.seams[0].accepted == ("beacon.toml",)
    assert (fake.path / "setup" / "after_seam_1" / "beacon.toml").read_bytes() == b"changed"


def test_resuming_refuses_when_something_moved_and_loses_nothing(fake: FakeRig, tmp_path: Path) -> None:
    interrupt_at_move(fake, 3, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        run_sweep(fake.plan, fake.rig, fake.writer())
    before = stations_of(read_run(fake.path))
    moved = FakeRig(tmp_path / "moved")
    moved.sensor.offset_m = np.array([0.0, 3e-4, 0.0])  # m; 0.1 mm of repeatability and 0.04 mm of noise are allowed
    with pytest.raises(RunError, match=r"station 0 is seen 0\.300 mm .* something moved"):
        resumed(fake, moved)
    assert moved.gantry.history[-1] == "stop"
    run = read_run(fake.path)
    assert stations_of(run) == before
    assert run.ended == "failed"
    assert run.seams == ()
    assert resumed(fake, FakeRig(tmp_path / "back")).is_complete


def test_a_complete_run_is_not_resumed(fake: FakeRig) -> None:
    run_sweep(fake.plan, fake.rig, fake.writer())
    with pytest.raises(RunError, match="nothing to resume"):
        check_same_setup(read_run(fake.path), fake.plan, {"beacon.toml": "aa"})
