"""The thread that writes a record: nothing is lost when the disk is slow, nothing is silent when it fails."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.errors import ConfigError, UvgsError
from uvgs_bench.interop.bag_writer import NewBag
from uvgs_bench.interop.trajectories import LineNote
from uvgs_bench.sensor import Capture, Miss
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sessions import recording
from uvgs_bench.sessions.record_setup import RecordSetup
from uvgs_bench.sessions.recording import Recorder
from uvgs_bench.sessions.replay import find_recording
from uvgs_bench.sessions.stream import Answered, StreamRules

SETUP = RecordSetup("test:", spots.calibration(), (spots.beacon(),), UvgsConfig(), StreamRules())


def captures(count: int, t_ns: list[int] | None = None) -> list[Capture]:
    rng = np.random.default_rng(1)
    return [
        Capture(rng.integers(0, 255, (30, 40), dtype=np.uint8), i * 10**8 if t_ns is None else t_ns[i], f"c{i}", 2 * i)
        for i in range(count)
    ]


def answer(capture: Capture) -> Answered:
    miss = Miss("blobs", "no_blobs", "none", capture.t_ns, "test")
    return Answered(capture, {"test": miss}, {"test": (miss, LineNote())}, None)


def record(path: Path, given: list[Capture]) -> Recorder:
    recorder = Recorder(path)
    recorder.begin(SETUP)
    for capture in recorder.captures(given):
        recorder.put(answer(capture))
    return recorder


def test_a_slow_disk_holds_up_the_stream_and_loses_nothing(tmp_path, monkeypatch):
    write = NewBag.write

    def slowly(self, topic, t_ns, message):
        time.sleep(0.002)
        write(self, topic, t_ns, message)

    monkeypatch.setattr(NewBag, "write", slowly)
    # Two pictures of 1200 bytes may wait.
    monkeypatch.setattr(recording, "_WAITING_BYTES", 2400)
    given = captures(12)
    record(tmp_path / "r.mcap", given).close()
    found = find_recording(tmp_path / "r.mcap")
    again = list(found.captures())
    assert (found.total, found.answered) == (12, 12)
    found.close()
    assert [(c.t_ns, c.index, c.source) for c in again] == [(c.t_ns, c.index, c.source) for c in given]
    assert all(np.array_equal(a.image, b.image) for a, b in zip(again, given, strict=True))


def test_a_clock_that_was_set_back_does_not_change_the_order(tmp_path):
    given = captures(5, [5 * 10**9, 6 * 10**9, 2 * 10**9, 3 * 10**9, 8 * 10**9])
    record(tmp_path / "r.mcap", given).close()
    found = find_recording(tmp_path / "r.mcap")
    assert [(c.index, c.t_ns) for c in found.captures()] == [(c.index, c.t_ns) for c in given]
    found.close()


def test_whatever_goes_wrong_in_the_thread_is_said_in_the_stream(tmp_path, monkeypatch):
    def broken(self, topic, t_ns, message):
        raise RuntimeError("a bug")

    monkeypatch.setattr(NewBag, "write", broken)
    recorder = Recorder(tmp_path / "r.mcap")
    recorder.begin(SETUP)

    def go_on() -> None:
        for capture in recorder.captures(captures(1000)):
            recorder.put(answer(capture))
            time.sleep(0.001)

    with pytest.raises(UvgsError, match=r"r\.mcap: cannot be written: RuntimeError: a bug"):
        go_on()
    with pytest.raises(UvgsError, match="a bug"):
        recorder.close()
    recorder.close()


def test_an_instant_without_a_place_ends_the_record(tmp_path):
    recorder = record(tmp_path / "r.mcap", captures(2, [0, 2**62]))
    with pytest.raises(UvgsError, match="no place for the instant"):
        recorder.close()


def test_a_record_that_never_began_can_be_closed(tmp_path):
    recorder = Recorder(tmp_path / "r.mcap")
    recorder.close()
    recorder.close()
    assert find_recording(tmp_path / "r.mcap") is None
    with pytest.raises(ConfigError, match="--force"):
        Recorder(tmp_path / "r.mcap")
