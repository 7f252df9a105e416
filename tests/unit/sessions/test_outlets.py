"""Outlets: one that fails does not stop the others; telemetry keeps its rate, its schema and never waits."""

from __future__ import annotations

import json
import socket
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from uvgs_bench.errors import ConfigError, UvgsError
from uvgs_bench.geometry import Pose
from uvgs_bench.interop.pose_messages import ros_covariance
from uvgs_bench.interop.trajectories import LineNote
from uvgs_bench.interop.udp import datagram
from uvgs_bench.sensor import Capture, Miss, PoseEstimate
from uvgs_bench.sensor.handover import Held
from uvgs_bench.sessions.events import Remark, ignore_events
from uvgs_bench.sessions.outlets import Outlets
from uvgs_bench.sessions.stream import Answered
from uvgs_bench.sessions.telemetry import RateLimit, RateLimited, UdpTelemetry

POSE = Pose.exp([0.1, 0.2, -0.3, 0.1, -0.2, 0.9], "camera", "beacon")
CAPTURE = Capture(np.zeros((2, 2), dtype=np.uint8), 1_600_000_000, "a.png", 7)
FRESH = PoseEstimate(
    POSE, np.diag([1e-6, 4e-6, 9e-6, 1e-8, 1e-8, 4e-8]), 1_500_000_001, "b", np.zeros((4, 2)), np.zeros((4, 2)),
    0.05, 7.5, 4, flags=("weak_evidence",),
)  # fmt: skip
MISS = Miss("correspondence", "ambiguous", "two poses " * 40, 1_600_000_000, "b", 5)
HELD = Held(FRESH, 100_000_000, MISS)
OK_KEYS = {
    "schema", "sequence", "skipped", "index", "t_ns", "status", "beacon", "t_m", "q_xyzw", "age_s", "sigma_m",
    "sigma_rad", "covariance", "rms_px", "margin", "flags", "beacons",
}  # fmt: skip


def answered(outcome, **more) -> Answered:
    lines = {"b": (outcome, LineNote(("saturated",)))}
    told = outcome.miss if isinstance(outcome, Held) else outcome
    return Answered(CAPTURE, {"b": told}, lines, "b", **more)


class Kept:
    """An outlet that remembers, or fails from the nth answer on."""

    def __init__(self, name: str = "", fails_at: int = 99, fails_closing: bool = False) -> None:
        self.paths = (Path(name),) if name else ()
        self.fails_at, self.fails_closing = fails_at, fails_closing
        self.got: list[Answered] = []
        self.closed = 0

    def put(self, one: Answered) -> None:
        if len(self.got) + 1 >= self.fails_at:
            raise UvgsError(f"{self.paths[0]}: cannot be written: No space left on device")
        self.got.append(one)

    def close(self) -> None:
        self.closed += 1
        if self.fails_closing:
            raise UvgsError("the end does not fit")


def test_the_others_go_on_when_one_fails():
    said: list[Remark] = []
    good, bad, torn = Kept("good.csv"), Kept("bad.mcap", fails_at=2), Kept("torn.bag", fails_closing=True)
    outlets = Outlets([bad, good, torn], said.append)
    for _ in range(3):
        outlets.put(answered(FRESH))
    outlets.close()
    outlets.close()
    assert (len(good.got), len(bad.got), len(torn.got)) == (3, 1, 3)
    assert (good.closed, bad.closed, torn.closed) == (1, 1, 1)
    assert outlets.failures == [
        "bad.mcap: cannot be written: No space left on device; the poses go on", "the end does not fit",
    ]  # fmt: skip
    assert [remark.text for remark in said] == outlets.failures
    assert [str(path) for path in outlets.paths] == ["bad.mcap", "good.csv", "torn.bag"]


def test_when_the_last_one_fails_there_is_nothing_to_go_on_for():
    outlets = Outlets([Kept("a.csv", fails_at=2)], ignore_events)
    outlets.put(answered(FRESH))
    with pytest.raises(UvgsError, match=r"a\.csv"):
        outlets.put(answered(FRESH))


def test_a_fresh_pose_as_a_datagram():
    record = json.loads(datagram(CAPTURE, answered(FRESH).lines, "b", 3, 2))
    assert set(record) == OK_KEYS
    assert (record["schema"], record["sequence"], record["skipped"], record["index"]) == (1, 3, 2, 7)
    assert (record["status"], record["beacon"], record["beacons"], record["age_s"]) == ("ok", "b", {"b": "ok"}, 0.0)
    assert record["flags"] == ["weak_evidence", "saturated"]
    assert record["t_m"] == POSE.t_m.tolist()
    # Six digits are written.
    np.testing.assert_allclose(record["sigma_m"], FRESH.position_sigma_m, rtol=1e-5)
    np.testing.assert_allclose(record["covariance"], ros_covariance(FRESH).ravel(), rtol=1e-5)


def test_no_fresh_pose_as_a_datagram():
    miss = json.loads(datagram(CAPTURE, answered(MISS).lines, None))
    assert (miss["status"], miss["beacon"], miss["stage"], miss["reason"]) == (
        "miss",
        "b",
        "correspondence",
        "ambiguous",
    )
    assert "t_m" not in miss
    assert len(miss["detail"]) == 160
    held = json.loads(datagram(CAPTURE, answered(HELD).lines, "b"))
    assert (held["status"], held["age_s"], held["t_m"]) == ("held", 0.1, POSE.t_m.tolist())
    assert not {"sigma_m", "covariance", "rms_px"} & set(held)
    lines = {"b": (MISS, LineNote()), "c": (replace(MISS, beacon="c"), LineNote())}
    nobody = json.loads(datagram(CAPTURE, lines, None))
    assert (nobody["beacon"], nobody["status"], nobody["reason"]) == (None, "miss", "none_seen")
    assert nobody["detail"] == "correspondence/ambiguous"
    infinite = replace(FRESH, margin=np.inf)
    assert json.loads(datagram(CAPTURE, answered(infinite).lines, "b"))["margin"] is None


def test_datagrams_arrive_in_order():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(5.0)
        outlet = UdpTelemetry(f"127.0.0.1:{ear.getsockname()[1]}", ignore_events)
        for outcome in (FRESH, MISS, HELD):
            outlet.put(answered(outcome))
        outlet.close()
        outlet.close()
        outlet.put(answered(FRESH))
        records = [json.loads(ear.recv(65536)) for _ in range(3)]
        ear.setblocking(False)
        with pytest.raises(BlockingIOError):
            ear.recv(1)
    assert [(r["sequence"], r["status"]) for r in records] == [(0, "ok"), (1, "miss"), (2, "held")]


def test_nobody_listening_and_what_cannot_be_sent_do_not_stop_anything():
    said: list[Remark] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    quiet = UdpTelemetry(f"127.0.0.1:{port}", said.append)
    for _ in range(5):
        quiet.put(answered(FRESH))
    quiet.close()
    assert said == []
    # The broadcast address is forbidden without asking for it.
    barred = UdpTelemetry("255.255.255.255:9", said.append)
    for _ in range(5):
        barred.put(answered(FRESH))
    barred.close()
    assert [remark.level for remark in said] == ["warning", "warning"]
    assert "5 of 5 datagrams could not be sent" in said[1].text


@pytest.mark.parametrize("address", ["", "host", "host:", ":5", "host:0", "host:65536", "host:x", "a b:5", "[::1:5"])
def test_addresses_are_checked(address):
    with pytest.raises(ConfigError, match="--udp"):
        UdpTelemetry(address, ignore_events)


def test_a_name_that_means_both_internets_means_the_older_one():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(5.0)
        outlet = UdpTelemetry(f"localhost:{ear.getsockname()[1]}", ignore_events)
        outlet.put(answered(FRESH))
        outlet.close()
        assert json.loads(ear.recv(65536))["status"] == "ok"


def test_an_address_of_the_next_internet():
    UdpTelemetry("[::1]:5005", ignore_events).close()


def test_the_rate_limit_keeps_the_mean_rate_and_counts_what_it_leaves_out():
    now = [0.0]
    limit = RateLimit(10.0, lambda: now[0])
    told = []
    for k in range(300):
        # 29.7 captures a second: no whole multiple of the limit.
        now[0] = k / 29.7
        if limit.is_due():
            told.append((k, limit.told()))
    # 10.1 s at 10 Hz, the first at once.
    assert len(told) in (101, 102)
    assert all(after - before - 1 == skipped for (before, _), (after, skipped) in pairwise(told))
    assert RateLimit(None, lambda: 0.0).is_due()


def test_after_a_pause_nothing_is_caught_up():
    now = [0.0]
    limit = RateLimit(10.0, lambda: now[0])
    assert limit.is_due()
    now[0] = 5.0
    assert limit.is_due()
    now[0] = 5.09
    assert not limit.is_due()
    now[0] = 5.11
    assert limit.is_due()


def test_any_outlet_can_be_limited():
    kept = Kept("a")
    outlet = RateLimited(kept, 0.001)
    for _ in range(3):
        outlet.put(answered(FRESH))
    outlet.close()
    assert (len(kept.got), kept.closed, outlet.paths) == (1, 1, kept.paths)
