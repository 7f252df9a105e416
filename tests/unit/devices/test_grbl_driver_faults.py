"""What the GRBL driver makes of alarms, restarts, odd controllers and settings, and ports that fail."""

from __future__ import annotations

import numpy as np
import pytest
import serial

from tests.helpers.grbl_ports import WELCOME, MockGantry, TablePort, linear_axes, open_table
from uvgs_bench.devices.clock import ScaledClock
from uvgs_bench.devices.gantry import Axis, Envelope, open_gantry
from uvgs_bench.devices.gantry.grbl import GrblGantry
from uvgs_bench.devices.sim.grbl_device import GrblDevice
from uvgs_bench.errors import (
    ConfigError,
    GantryAlarm,
    GantryError,
    GantryLost,
    GantryRefused,
    GantryTimeout,
)

FAST = 0.05
# Half a step of 1/400 mm, and half the last digit of a report.
AT_M = 1.25e-6 + 0.75e-6


def test_an_alarm_is_raised_once_and_homing_recovers(mock: MockGantry) -> None:
    mock.gantry.home()
    mock.type_behind_its_back("G53G0X-900")
    with pytest.raises(GantryAlarm, match="soft limits") as caught:
        mock.gantry.move_to([-0.1] * 3, FAST)
    assert caught.value.code == 2
    state = mock.gantry.state()
    assert not state.is_homed
    assert state.activity == "Alarm"
    with pytest.raises(GantryError, match="not homed"):
        mock.gantry.move_to([-0.1] * 3, FAST)
    assert mock.gantry.home().is_trusted


def test_a_restart_by_itself_loses_the_position(mock: MockGantry) -> None:
    mock.gantry.home()
    mock.device.power_cycle(mock.clock.now_ns())
    mock.clock.sleep(2.0)
    with pytest.raises(GantryLost, match="restarted"):
        mock.gantry.move_to([-0.1] * 3, FAST)
    assert not mock.gantry.state().is_homed
    assert not mock.spy.moves()
    assert mock.gantry.home().is_trusted


def test_a_restart_during_a_move_is_noticed(mock: MockGantry) -> None:
    mock.gantry.home()

    def restart(_number: int, direction: str, text: str) -> None:
        if direction == "<" and text.startswith("<Jog"):
            mock.spy.on_event = lambda *_: None
            mock.device.power_cycle(mock.clock.now_ns())

    mock.spy.on_event = restart
    with pytest.raises((GantryLost, GantryTimeout)):
        mock.gantry.move_to([-0.2] * 3, 0.02)
    assert not mock.gantry.stop().is_homed


def test_somebody_else_cancelling_the_jog_is_noticed(mock: MockGantry) -> None:
    mock.gantry.home()

    def cancel(_number: int, direction: str, text: str) -> None:
        if direction == "<" and text.startswith("<Jog"):
            mock.device.receive(0x85, mock.clock.now_ns())

    mock.spy.on_event = cancel
    with pytest.raises(GantryError, match=r"came to rest at X .* instead of X -200.000 mm"):
        mock.gantry.move_to([-0.2] * 3, 0.02)


def test_a_failed_homing_is_an_alarm_although_an_ok_follows(monkeypatch: pytest.MonkeyPatch) -> None:
    device = GrblDevice.for_axes(linear_axes())
    device.settings[130] = 30.0
    device.settings[20] = 0.0
    mock = MockGantry(monkeypatch, device, Envelope(linear_axes(travel_m=0.03)))
    with pytest.raises(GantryAlarm, match="no limit switch") as caught:
        mock.gantry.home()
    assert caught.value.code == 9
    assert not mock.gantry.state().is_homed
    mock.gantry.close()


def test_homing_that_takes_too_long_is_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    mock = MockGantry(monkeypatch, homing_timeout_s=0.5)
    with pytest.raises(GantryTimeout, match=r"homing did not end within 0\.5 s"):
        mock.gantry.home()
    np.testing.assert_array_equal(mock.device.velocity_at(mock.clock.now_ns()), 0.0)
    mock.gantry.close()


def test_homing_switched_off_is_said_before_anything_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    device = GrblDevice.for_axes(linear_axes())
    device.settings.update({20: 0.0, 22: 0.0})
    mock = MockGantry(monkeypatch, device)
    with pytest.raises(GantryRefused, match=r"\$22=0"):
        mock.gantry.home()
    assert "$H" not in mock.spy.sent()
    mock.gantry.close()


def test_without_jogs_a_barrier_waits_for_the_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    axes = linear_axes()
    device = GrblDevice.for_axes(axes)
    device._version = "1.0c.20160815"
    mock = MockGantry(monkeypatch, device, Envelope(axes))
    mock.gantry.home()
    state = mock.gantry.move_to([-0.1] * 3, FAST)
    np.testing.assert_allclose(state.position, [-0.1] * 3, atol=AT_M)
    assert mock.spy.sent()[-1] == "G4P0.01"
    assert mock.spy.sent()[-2].startswith("G21G90G53G1X")

    def interrupt(_number: int, direction: str, text: str) -> None:
        if (direction, text) == (">", "G4P0.01"):
            raise KeyboardInterrupt

    mock.spy.on_event = interrupt
    with pytest.raises(KeyboardInterrupt):
        mock.gantry.move_to([-0.2] * 3, 0.02)
    mock.spy.on_event = lambda *_: None
    state = mock.gantry.stop()
    assert state.is_trusted
    assert -0.2 < state.position[0] < -0.1
    np.testing.assert_allclose(state.position, mock.device.position_at(mock.clock.now_ns()), atol=AT_M)
    mock.gantry.close()


def test_a_rotary_axis_counts_in_degrees(monkeypatch: pytest.MonkeyPatch) -> None:
    turntable = Axis("A", "rotary", np.array([0.0, 0.0, 1.0]), -np.pi, np.pi, 0.5, 2.0)
    axes = (*linear_axes(), turntable)
    mock = MockGantry(monkeypatch, envelope=Envelope(axes))
    mock.gantry.home()
    state = mock.gantry.move_to([-0.001, -0.001, -0.001, np.pi / 2], 0.25)
    assert "A90.0000F859.436" in mock.spy.moves()[-1]  # 0.25 rad/s in deg/min
    np.testing.assert_allclose(state.position[3], np.pi / 2, atol=1e-4)
    np.testing.assert_allclose(mock.device.position_at(mock.clock.now_ns()), state.position, atol=1e-4)
    mock.gantry.close()


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({13: 1.0}, "inches"),
        ({130: 150.0}, r"travel \(\$130=150 mm\) is shorter than the envelope"),
        ({0: 255.0, 2: 255.0, 3: 255.0, 10: 255.0, 26: 255.0}, "corrupt"),
    ],
)
def test_settings_that_would_make_positions_wrong(
    monkeypatch: pytest.MonkeyPatch, settings: dict[int, float], expected: str
) -> None:
    device = GrblDevice.for_axes(linear_axes())
    device.settings.update(settings)
    with pytest.raises(GantryError, match=expected):
        MockGantry(monkeypatch, device)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({121: 250.0}, r"axis Y accelerates with \$121=250 mm/s\^2, the bench file allows 200: .* settings 121=200"),
        ({25: 4000.0, 110: 4000.0}, r"axis X homes with \$25=4000 mm/min, the bench file allows 3000"),
    ],
)
def test_a_controller_that_moves_harder_than_the_bench_file_allows_does_not_move(
    monkeypatch: pytest.MonkeyPatch, settings: dict[int, float], expected: str
) -> None:
    device = GrblDevice.for_axes(linear_axes())
    before = dict(device.settings)
    device.settings.update(settings)
    mock = MockGantry(monkeypatch, device)
    with pytest.raises(GantryError, match=expected):
        mock.gantry.home()
    assert "$H" not in mock.spy.sent()
    # It is open, so that it can be set right; also one that is homed already is looked at before a move.
    for number in settings:
        mock.gantry.ask(f"${number}={before[number]}")
    mock.gantry.reread()
    mock.gantry.home()
    for number, value in settings.items():
        mock.gantry.ask(f"${number}={value}")
    mock.gantry.reread()
    with pytest.raises(GantryError, match=expected):
        mock.gantry.move_to([-0.1] * 3, FAST)
    assert not mock.spy.moves()
    mock.gantry.close()


@pytest.mark.parametrize(
    ("settings", "expected"),
    [(b"$100=400\r\n$102=400\r\n", r"axis Y: .* no steps per unit \(\$101\)"), (b"", "tells no settings")],
)
def test_settings_that_are_missing(monkeypatch: pytest.MonkeyPatch, settings: bytes, expected: str) -> None:
    with pytest.raises(GantryError, match=expected):
        open_table(monkeypatch, TablePort(lambda line: settings + b"ok\r\n" if line == b"$$" else b"ok\r\n"))


def test_work_positions_become_machine_positions(monkeypatch: pytest.MonkeyPatch) -> None:
    """The offset comes in every third report here; before it came there is no position."""
    count = 0

    def answer(line: bytes) -> bytes:
        nonlocal count
        if line == b"?":
            count += 1
            offset = b"|WCO:-10.000,0.000,2.500" if count % 3 == 0 else b""
            return b"<Idle|WPos:1.000,2.000,3.000|FS:0,0" + offset + b"|XYZ:what>\r\n"
        if line == b"$$":
            return b"$100=400\r\n$101=400\r\n$102=400\r\n$22=1\r\nok\r\n"
        return b"ok\r\n"

    gantry, _ = open_table(monkeypatch, TablePort(answer))
    np.testing.assert_allclose(gantry.state().position, [-0.009, 0.002, 0.0055], atol=1e-12)


def test_work_positions_without_an_offset_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def answer(line: bytes) -> bytes:
        if line == b"?":
            return b"<Idle|WPos:1.000,2.000,3.000|FS:0,0>\r\n"
        return b"$100=400\r\n$101=400\r\n$102=400\r\nok\r\n" if line == b"$$" else b"ok\r\n"

    with pytest.raises(GantryError, match="WCO"):
        open_table(monkeypatch, TablePort(answer))


def grblhal(line: bytes) -> bytes:
    replies = {
        b"\x18": b"\r\nGrblHAL 1.1f ['$' or '$HELP' for help]\r\n",
        b"$I": b"[VER:1.1f.20260817:]\r\n[OPT:VNML+,100,1024,3,0]\r\n[FIRMWARE:grblHAL]\r\nok\r\n",
        b"$$": b"$13=0\r\n$22=0\r\n$100=250.0\r\n$101=250.0\r\n$102=250.0\r\nok\r\n",
        b"?": b"<Idle|MPos:0.000,0.000,0.000|Bf:100,1023|FS:0,0|Ov:100,100,100|A:|H:0|TLR:0>\r\n",
    }
    return replies.get(line, b"error:79\r\n")


def test_a_controller_that_does_not_greet_is_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    gantry, spy = open_table(monkeypatch, TablePort(grblhal, greeting=b""))
    assert gantry.info.firmware == "grblHAL"
    assert spy.events[0][1:] == (">!", "0x18")
    with pytest.raises(GantryRefused, match="not allowed in a critical event"):
        gantry._link.command("$N", 1.0)


def test_a_port_that_vanishes(monkeypatch: pytest.MonkeyPatch) -> None:
    port = TablePort(grblhal)
    gantry, _ = open_table(monkeypatch, port)
    port.is_gone = True
    for _ in range(2):
        with pytest.raises(GantryLost, match="table: the port vanished"):
            gantry.state()
    gantry.close()


def test_a_controller_that_falls_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    port = TablePort(grblhal)
    gantry, _ = open_table(monkeypatch, port)
    port.answer = lambda _line: b""
    with pytest.raises(GantryTimeout, match="no status report"):
        gantry.state()


@pytest.mark.parametrize(
    ("greeting", "answer", "kind", "expected"),
    [
        (b"", b"", GantryTimeout, "nothing answers"),
        (b"start\r\necho:Marlin 2.1\r\n", b"", GantryError, "no GRBL controller: .* got 'start'"),
        (b"\x00\xff" * 2000, b"", GantryError, "without line ends"),
    ],
)
def test_what_answers_is_no_grbl(
    monkeypatch: pytest.MonkeyPatch, greeting: bytes, answer: bytes, kind: type[GantryError], expected: str
) -> None:
    with pytest.raises(kind, match=f"table: .*{expected}"):
        open_table(monkeypatch, TablePort(lambda _line: answer, greeting))


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (serial.SerialException(13, "Permission denied"), "no permission"),
        (serial.SerialException(16, "Device or resource busy"), "in use"),
        (OSError(5, "Input/output error"), "cannot be opened"),
    ],
)
def test_a_port_that_does_not_open(monkeypatch: pytest.MonkeyPatch, error: OSError, expected: str) -> None:
    def refuse(*_args: object, **_options: object) -> None:
        raise error

    monkeypatch.setattr(serial, "serial_for_url", refuse)
    with pytest.raises(GantryError, match=f"^/dev/ttyACM0: .*{expected}"):
        open_gantry("grbl:/dev/ttyACM0", Envelope(linear_axes()), clock=ScaledClock(), log=lambda *_: None)


@pytest.mark.parametrize(
    ("spec", "kind", "expected"),
    [
        ("grbl:/dev/ttyNOT_THERE", GantryError, "no such port"),
        ("grbl:sim://nobody", GantryError, "no simulated bench named 'nobody'"),
        ("grbl:sim://?sped=2", GantryError, "unknown option 'sped'"),
        ("grbl:sim://?speed=fast", GantryError, "must be a positive number"),
        ("grbl:nonsense://x", GantryError, "protocol 'nonsense' not known"),
        ("gbrl:/dev/ttyACM0", ConfigError, "did you mean grbl:"),
        ("grbl", ConfigError, "is not one of grbl:PORT"),
    ],
)
def test_specs_that_name_nothing(spec: str, kind: type[Exception], expected: str) -> None:
    with pytest.raises(kind, match=expected):
        open_gantry(spec, Envelope(linear_axes()), clock=ScaledClock(), log=lambda *_: None)


def test_halt_stops_before_it_listens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        serial, "serial_for_url", lambda *_a, **_o: TablePort(lambda b: WELCOME if b == b"\x18" else b"", b"")
    )
    events: list[tuple[str, str]] = []
    assert GrblGantry.halt("x", clock=ScaledClock(400.0), log=lambda _t, d, text: events.append((d, text)))
    assert events[:3] == [(">!", "0x85"), (">!", "0x21"), (">!", "0x18")]


def test_everything_on_the_wire_is_logged_in_order_of_time(mock: MockGantry) -> None:
    mock.gantry.home()
    times = [t_ns for t_ns, _, _ in mock.spy.events]
    assert times == sorted(times)
    texts = [(direction, text) for _, direction, text in mock.spy.events]
    for wanted in ((">", "$I"), ("<", "[VER:1.1h.20190830:]"), (">", "$H"), (">!", "0x3F"), ("<", "ok")):
        assert wanted in texts
