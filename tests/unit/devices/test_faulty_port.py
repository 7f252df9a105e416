"""The fault layer itself, and what the driver does about each kind of damage."""

from __future__ import annotations

import numpy as np
import pytest
import serial

from tests.helpers.grbl_ports import MockGantry, Spy, TablePort, linear_axes
from uvgs_bench.devices.clock import SteppedClock
from uvgs_bench.devices.gantry import Envelope, open_gantry
from uvgs_bench.devices.gantry.faulty_port import Faults, FaultyPort, split_address
from uvgs_bench.devices.gantry.registry import is_simulated, spec_on_bench
from uvgs_bench.errors import ConfigError, GantryError


class Echo:
    """A port that answers with what it got."""

    def __init__(self) -> None:
        self.got = bytearray()
        self.waiting = bytearray()
        self.dtr_edges: list[bool] = []
        self.is_closed = False

    @property
    def in_waiting(self) -> int:
        return len(self.waiting)

    def __setattr__(self, name: str, value: object) -> None:
        if name == "dtr":
            self.dtr_edges.append(bool(value))
        else:
            object.__setattr__(self, name, value)

    def read(self, size: int) -> bytes:
        taken = bytes(self.waiting[:size])
        del self.waiting[:size]
        return taken

    def write(self, data: bytes) -> int:
        self.got += data
        self.waiting += data
        return len(data)

    def close(self) -> None:
        self.is_closed = True


def passed(faults: Faults, lines: int = 200) -> tuple[bytes, bytes, Echo]:
    """What reached the other end and what came back of so many lines."""
    echo, clock = Echo(), SteppedClock()
    port = FaultyPort(echo, faults, clock)
    back = bytearray()
    for i in range(lines):
        port.write(b"line %03d\n" % i)
        back += port.read(port.in_waiting or 1)
        clock.sleep(0.1)
    clock.sleep(2.0)
    for _ in range(lines):
        back += port.read(port.in_waiting or 1)
        clock.sleep(0.1)
    return bytes(echo.got), bytes(back), echo


WHOLE = b"".join(b"line %03d\n" % i for i in range(200))


def test_without_faults_everything_passes() -> None:
    got, back, _ = passed(Faults())
    assert got == back == WHOLE


def test_bytes_are_lost_and_damaged_at_the_rate_asked_for_and_by_the_seed() -> None:
    got, back, _ = passed(Faults(drop=0.1, seed=3))
    # 1800 bytes, so 180 +- 13 lost; four standard deviations.
    assert abs(1800 - len(got) - 180) < 52
    assert abs(len(got) - len(back) - 0.1 * len(got)) < 52
    assert passed(Faults(drop=0.1, seed=3))[0] == got
    assert passed(Faults(drop=0.1, seed=4))[0] != got
    got, _, _ = passed(Faults(corrupt=0.1, seed=3))
    flips = [bin(a ^ b).count("1") for a, b in zip(got, WHOLE, strict=True)]
    assert set(flips) == {0, 1}
    assert abs(sum(flips) - 180) < 52


def test_a_delay_keeps_the_order() -> None:
    echo, clock = Echo(), SteppedClock()
    port = FaultyPort(echo, Faults(delay=1.0, seed=1), clock)
    port.write(b"one\n")
    port.write(b"two\n")
    assert echo.got != b"one\ntwo\n"
    back = bytearray()
    for _ in range(60):
        clock.sleep(0.1)
        back += port.read(port.in_waiting or 1)
    assert echo.got == back == b"one\ntwo\n"


def test_reset_alarm_and_unplug_come_when_something_is_sent() -> None:
    _, _, echo = passed(Faults(reset=1.0), lines=2)
    assert echo.dtr_edges == [False, True, False, True]
    _, back, _ = passed(Faults(alarm=1.0), lines=1)
    assert b"\r\nALARM:1\r\n" in back
    echo = Echo()
    port = FaultyPort(echo, Faults(unplug=1.0), SteppedClock())
    assert port.in_waiting == 0
    for action in (lambda: port.write(b"?"), lambda: port.read(1), lambda: port.in_waiting):
        with pytest.raises(serial.SerialException, match="unplugged"):
            action()
    port.close()
    assert echo.is_closed
    assert echo.got == b""


def test_addresses() -> None:
    assert split_address("/dev/ttyACM0") == ("/dev/ttyACM0", None)
    assert split_address("sim://?speed=4") == ("sim://?speed=4", None)
    assert split_address("fault+/dev/ttyACM0?drop=0.01&seed=7") == ("/dev/ttyACM0", Faults(drop=0.01, seed=7))
    assert split_address("fault+sim://?speed=4&unplug=1") == ("sim://?speed=4", Faults(unplug=1.0))
    for address, expected in [
        ("fault+sim://?drop=2", "drop: a probability is from 0 to 1, got 2"),
        ("fault+sim://?drop=nan", "probability"),
        ("fault+sim://?drop=often", "expected a number, got 'often'"),
        ("fault+sim://?seed=-1", "not negative"),
        ("fault+/dev/ttyACM0?dorp=0.1", "unknown fault, expected one of"),
    ]:
        with pytest.raises(ConfigError, match=expected):
            split_address(address)


def test_the_simulated_gantry_of_the_bench_file_is_recognised_behind_faults() -> None:
    assert spec_on_bench("grbl:sim://", "b") == "grbl:sim://b"
    assert spec_on_bench("grbl:fault+sim://?drop=0.1", "b") == "grbl:fault+sim://b?drop=0.1"
    assert spec_on_bench("grbl:sim://other", "b") is None
    assert spec_on_bench("grbl:sim://?speed=4", "b") is None
    assert spec_on_bench("grbl:fault+/dev/ttyACM0", "b") is None
    assert is_simulated("grbl:fault+sim://other?drop=0.1")
    assert not is_simulated("grbl:fault+/dev/ttyACM0?drop=0.1")


def test_a_homing_line_that_became_an_unlock_is_not_homing(monkeypatch: pytest.MonkeyPatch) -> None:
    """One bit makes ``$X`` of ``$H``: ok, Idle, and a position that means nothing."""
    mock = MockGantry(monkeypatch)
    port = mock.gantry._wire._port
    write = port.write
    port.write = lambda data: write(data.replace(b"$H", b"$X"))
    with pytest.raises(GantryError, match="not that of a homing cycle"):
        mock.gantry.home()
    assert not mock.gantry.state().is_homed
    port.write = write
    assert mock.gantry.home().is_trusted


@pytest.mark.parametrize(("whole", "damaged"), [(b"X-150.0000", b"X-110.0000"), (b"Y-100.0000", b"Y-000.0000")])
def test_a_damaged_move_is_stopped_on_the_way(monkeypatch: pytest.MonkeyPatch, whole: bytes, damaged: bytes) -> None:
    mock = MockGantry(monkeypatch)
    mock.gantry.home()
    port = mock.gantry._wire._port
    write = port.write
    port.write = lambda data: write(data.replace(whole, damaged))
    with pytest.raises(GantryError, match="left its path from"):
        mock.gantry.move_to([-0.15, -0.1, -0.05], 0.05)
    state = mock.gantry.stop()
    assert state.is_trusted
    # 0.25 s until the next look at 50 mm/s, a second look, and braking: some 30 mm of a way of 100 mm.
    assert np.linalg.norm(state.position - -0.001) < 0.04


@pytest.mark.parametrize(("times", "harm"), [(1, b"$j=G1"), (1, b"$J=Q2"), (2, b"$J=Q2")])
def test_a_move_refused_for_how_it_reads_is_said_again_once(
    monkeypatch: pytest.MonkeyPatch, times: int, harm: bytes
) -> None:
    mock = MockGantry(monkeypatch)
    mock.gantry.home()
    port = mock.gantry._wire._port
    write, hits = port.write, []

    def damaging(data: bytes) -> int:
        if b"$J" in data and len(hits) < times:
            hits.append(data)
            return write(data.replace(b"$J=G2", harm, 1))
        return write(data)

    port.write = damaging
    if times == 1:
        state = mock.gantry.move_to([-0.02, -0.01, -0.03], 0.05)
        np.testing.assert_allclose(state.position, [-0.02, -0.01, -0.03], atol=2.5e-6)
    else:
        with pytest.raises(GantryError, match="refused"):
            mock.gantry.move_to([-0.02, -0.01, -0.03], 0.05)
        np.testing.assert_allclose(mock.gantry.state().position, [-0.001] * 3, atol=2.5e-6)


def test_settings_that_read_differently_are_read_again_and_then_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    values = iter([b"400.000", b"40.000", b"400.000", b"400.000"])

    def answer(line: bytes) -> bytes:
        if line == b"$$":
            steps = next(values)
            return b"".join(b"$10%d=%s\r\n" % (i, steps) for i in range(3)) + b"$13=0\r\n$22=1\r\nok\r\n"
        if line == b"?":
            return b"<Alarm|MPos:0.000,0.000,0.000|FS:0,0>\r\n"
        return b"[VER:1.1h.20190830:]\r\n[OPT:V,15,128]\r\nok\r\n"

    monkeypatch.setattr(serial, "serial_for_url", lambda *_args, **_options: TablePort(answer))
    gantry = open_gantry("grbl:table", Envelope(linear_axes()), clock=SteppedClock(), log=Spy())
    assert gantry.info.settings["100"] == "400.000"
    values = iter([b"1", b"2", b"3", b"4", b"5"])
    with pytest.raises(GantryError, match="read differently each time"):
        open_gantry("grbl:table", Envelope(linear_axes()), clock=SteppedClock(), log=Spy())
