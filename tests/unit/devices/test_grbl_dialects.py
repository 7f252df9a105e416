"""Firmwares that speak GRBL: who is who, what their numbers mean, and what ours adds."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import serial

from tests.conversations.replay import read_scenes
from tests.helpers.grbl_ports import MockGantry, Spy, TablePort, linear_axes, open_table
from uvgs_bench.devices.clock import SteppedClock
from uvgs_bench.devices.gantry import Envelope, open_gantry
from uvgs_bench.devices.gantry import grbl_protocol as protocol
from uvgs_bench.devices.gantry.grbl_codes import find_dialect
from uvgs_bench.devices.gantry.grbl_settings import settings_warnings
from uvgs_bench.devices.sim.grbl_uvgs import UvgsDevice
from uvgs_bench.errors import GantryAlarm, GantryLost

ROOT = Path(__file__).parents[3]
IDENTITY = {
    "grbl": {"VER": "1.1h.20190830:", "OPT": "V,15,128"},
    "grblHAL": {"VER": "1.1f.20240101:", "FIRMWARE": "grblHAL"},
    "uvgs_gantry": {"VER": "1.1h.20261122:uvgs_gantry", "FIRMWARE": "uvgs_gantry"},
    "FluidNC": {"VER": "3.7 FluidNC v3.7.17:", "OPT": "MPHS"},
}


@pytest.mark.parametrize("name", IDENTITY)
def test_who_is_who(name: str) -> None:
    dialect = find_dialect(IDENTITY[name])
    assert dialect.name == name
    assert dialect.has_jog
    assert dialect.has_checksums == (name == "uvgs_gantry")
    assert not find_dialect({"VER": "0.9j.20160303:"}).has_jog


def test_an_alarm_ten_means_another_thing_to_each() -> None:
    meanings = {name: find_dialect(identity).meaning("alarm", 10) for name, identity in IDENTITY.items()}
    assert "second motor" in meanings["grbl"]
    assert "emergency stop" in meanings["grblHAL"]
    assert "emergency stop" in meanings["uvgs_gantry"]
    assert "spindle" in meanings["FluidNC"]
    assert "FluidNC does not document" in find_dialect(IDENTITY["FluidNC"]).meaning("error", 99)


def test_the_numbers_are_those_of_the_table_beside_the_firmware() -> None:
    with (ROOT / "firmware" / "codes.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) > 60
    for row in rows:
        if row["firmware"] in IDENTITY:
            kind = "error" if row["kind"] == "error" else "alarm"
            assert find_dialect(IDENTITY[row["firmware"]]).meaning(kind, int(row["code"])) == row["meaning"], row


@pytest.mark.shared_data
@pytest.mark.parametrize(("file", "name"), [("grbl_1.1h.txt", "grbl"), ("grblhal_1.1f_simulator.txt", "grblHAL")])
def test_real_controllers_are_recognised_by_what_they_said(file: str, name: str) -> None:
    path = ROOT.parent / "shared" / "data" / "grbl" / file
    if not path.exists():
        pytest.skip(f"{path} is not here")
    said = [
        protocol.read_received(line)
        for exchanges in read_scenes(path).values()
        for exchange in exchanges
        if exchange.data.strip() == b"$I"
        for line in exchange.expected
    ]
    identity = {item.name: item.text for item in said if isinstance(item, protocol.Message)}
    assert identity["VER"]
    assert find_dialect(identity).name == name


def fluidnc(line: bytes) -> bytes:
    if line == b"$I":
        return b"[VER:3.9 FluidNC v3.9.9:]\r\n[OPT:MPHS]\r\n[MSG: Machine: Rig]\r\nok\r\n"
    if line == b"$$":
        return b"$30=1000.000\r\n$31=0.000\r\n$32=0\r\nok\r\n"
    if line == b"?":
        return b"<Idle|MPos:-1.000,-1.000,-1.000|FS:0,0>\r\n"
    if line == b"$H":
        return b"[MSG:Homed:Z]\r\n[MSG:Homed:XY]\r\nok\r\n"
    return b"ok\r\n"


def test_fluidnc_keeps_its_settings_to_itself_and_homes_with_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    port = TablePort(fluidnc, greeting=b"\r\nGrbl 3.9 [FluidNC v3.9.9 (wifi) '$' for help]\r\n")
    gantry, _ = open_table(monkeypatch, port)
    assert (gantry.info.firmware, gantry.info.version) == ("FluidNC", "3.9 FluidNC v3.9.9")
    assert any("tells neither speeds" in text for text in gantry.info.warnings)
    assert gantry.home().is_trusted
    port.pending += b"[MSG:INFO: ALARM: Hard Limit]\r\nALARM:14\r\n"
    with pytest.raises(GantryAlarm, match="homing is required"):
        gantry.state()


def test_what_is_unwise_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    mock = MockGantry(monkeypatch)
    assert mock.gantry.info.warnings == ()
    settings = mock.gantry.info.settings | {"20": "0", "1": "25", "32": "1", "131": "0.000", "112": "9000"}
    told = settings_warnings(settings, linear_axes())
    assert [text.split(":")[0].split(" (")[0] for text in told] == [
        "soft limits are off", "motors are released 25 ms after a move", "laser mode is on",
        "axis Y has no travel", "axis Z can go at $112=9000, the bench file allows 3000",
    ]  # fmt: skip
    mock.gantry.close()


def test_stored_offsets_belong_to_the_snapshot(monkeypatch: pytest.MonkeyPatch) -> None:
    info = MockGantry(monkeypatch).gantry.info
    assert info.parameters["G54"] == "0.000,0.000,0.000"
    assert "PRB" not in info.parameters


def test_sealed_lines() -> None:
    # CRC-8 (0x07, start 0) of "123456789" is 0xF4 by its published check value.
    assert protocol.sealed(1, "$X").startswith("N1 $X*")
    text = "N123 456789"
    check = 0
    for byte in text.encode():
        check ^= byte
        for _ in range(8):
            check = ((check << 1) ^ 0x07) & 0xFF if check & 0x80 else check << 1
    assert protocol.sealed(123, "456789") == f"{text}*{check:02X}"


@pytest.fixture
def ours(monkeypatch: pytest.MonkeyPatch):
    axes = linear_axes()
    mock = MockGantry(monkeypatch, UvgsDevice.for_axes(axes), Envelope(axes))
    yield mock
    mock.gantry.close()


def test_our_firmware_is_spoken_to_in_sealed_lines(ours: MockGantry) -> None:
    assert ours.gantry.info.firmware == "uvgs_gantry"
    ours.gantry.home()
    ours.gantry.move_to([-0.02, -0.01, -0.03], 0.05)
    assert all(line.startswith("N") and line[-3] == "*" for line in ours.spy.sent() if "$H" in line or "$J" in line)


@pytest.mark.parametrize("harm", [(b"-20.0000", b"-10.0000"), (b"\n", b""), (b"N", b"n")])
def test_a_damaged_line_is_said_again_and_runs_once(ours: MockGantry, harm: tuple[bytes, bytes]) -> None:
    ours.gantry.home()
    port = ours.gantry._wire._port
    write, hits = port.write, []

    def damaging(data: bytes) -> int:
        if b"$J" in data and not hits:
            hits.append(data)
            return write(data.replace(*harm))
        return write(data)

    port.write = damaging
    state = ours.gantry.move_to([-0.02, -0.01, -0.03], 0.05)
    np.testing.assert_allclose(state.position, [-0.02, -0.01, -0.03], atol=2.5e-6)
    assert hits
    assert len([line for line in ours.spy.sent() if "$J" in line]) >= 2


def _stops(mock: MockGantry) -> int:
    now_ns = mock.clock.now_ns()
    return mock.device.motions_until(now_ns).stops_count(now_ns / 1e9)


def test_a_lost_ok_is_asked_for_again_and_nothing_runs_twice(ours: MockGantry) -> None:
    ours.gantry.home()
    take, lost = ours.device.take_output, []

    def losing(t_ns: int) -> bytes:
        data = take(t_ns)
        if b"ok\r\n" in data and not lost:
            lost.append(data)
            return data.replace(b"ok\r\n", b"")
        return data

    ours.device.take_output = losing
    before = _stops(ours)
    state = ours.gantry.move_to([-0.02, -0.01, -0.03], 0.05)
    assert lost
    np.testing.assert_allclose(state.position, [-0.02, -0.01, -0.03], atol=2.5e-6)
    assert _stops(ours) == before + 1


def test_our_firmware_is_asked_for_positions_that_cannot_be_torn_or_damaged(ours: MockGantry) -> None:
    ours.gantry.home()
    begun = len(ours.spy.events)
    ours.gantry.move_to([-0.0123, -0.001, -0.001], 0.05)
    asked = [text for _, direction, text in ours.spy.events[begun:] if direction == ">!"]
    assert set(asked) == {"0xF0"}
    send, spoilt = ours.device._send, []

    def damage(line: str) -> None:
        if line.startswith("[POS") and len(spoilt) < 2:
            spoilt.append(line)
            line = line.replace("-4920", "-4921")
        send(line)

    ours.device._send = damage  # type: ignore[method-assign]
    state = ours.gantry.state()
    assert len(spoilt) == 2
    assert "-4920" in spoilt[0]
    # 400 steps/mm: the counter itself, not three decimals of it.
    assert state.position[0] == pytest.approx(-0.0123, abs=1e-12)
    assert state.details["Homed"] == "XYZ"


def test_a_restart_that_nobody_heard_loses_the_position(ours: MockGantry) -> None:
    ours.gantry.home()
    assert ours.gantry.state().is_trusted
    ours.device.power_cycle(ours.clock.now_ns())
    # The welcome is lost on the line.
    ours.device.take_output(ours.clock.now_ns())
    with pytest.raises(GantryLost, match="restarted unheard"):
        ours.gantry.state()
    assert not ours.gantry.state().is_homed


def test_our_firmware_hears_from_its_host_while_it_homes(ours: MockGantry) -> None:
    begun = len(ours.spy.events)
    ours.gantry.home()
    beats = [t_ns for t_ns, direction, text in ours.spy.events[begun:] if (direction, text) == (">!", "0xF0")]
    # ns; a homing cycle takes seconds, and a heartbeat of half a second would do.
    assert len(beats) > 10
    assert max(np.diff(beats)) < 500_000_000
    assert ours.gantry.state().is_trusted


def test_plain_ports_still_open_by_their_spec(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial, "serial_for_url", lambda *_args, **_options: TablePort(fluidnc))
    assert open_gantry("grbl:table", Envelope(linear_axes()), clock=SteppedClock(), log=Spy()).port == "table"
