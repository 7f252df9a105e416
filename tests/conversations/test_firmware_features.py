"""What our firmware has beyond GRBL, by PROTOCOL.md; the motors are counted from the pins, never asked for."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from tests.helpers.firmware_board import KINDS, FirmwareBuilds, LockstepBoard

STATUS, HOLD, CANCEL, RESET, POSITION = b"?", b"!", b"\x85", b"\x18", b"\xf0"
# A received byte waits for the step interrupt, 36 us at most on the AVR, and the simulator's bytes for an instruction.
RECEIVE_US = 45


@pytest.fixture(params=KINDS)
def board(request: pytest.FixtureRequest, firmware_builds: FirmwareBuilds) -> Iterator[LockstepBoard]:
    """A board with 400 steps/mm and 500 mm/s2 that has not been homed and need not be."""
    with firmware_builds.board(request.param) as board:
        for setting in ("$201=0", *(f"${base + i}={value}" for base, value in BRISK.items() for i in range(3))):
            assert board.say(setting, 5) == ["ok"]
        yield board


BRISK = {100: 400, 110: 1800, 120: 500}


def crc16(text: str) -> str:
    value = 0xFFFF
    for byte in text.encode("ascii"):
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x1021 if value & 0x8000 else value << 1) & 0xFFFF
    return f"{value:04X}"


def sealed(line: str) -> str:
    """A line with its CRC-8."""
    value = 0
    for byte in line.encode("ascii"):
        value ^= byte
        for _ in range(8):
            value = (value << 1 ^ 0x07 if value & 0x80 else value << 1) & 0xFF
    return f"{line}*{value:02X}"


def fields_of(line: str, name: str) -> list[str]:
    """The fields of a checked line, whose CRC must be right."""
    match = re.fullmatch(rf"\[({name}:(.*))\*([0-9A-F]{{4}})\]", line)
    assert match, line
    assert crc16(match.group(1)) == match.group(3), line
    return match.group(2).split("|")


def steps_of(field: str) -> tuple[int, ...]:
    return tuple(int(value) for value in field.split(","))


def test_position_report_is_exact_at_rest_and_whole_while_moving(board: LockstepBoard) -> None:
    assert board.say("$J=G91X-9Y-6Z-3F3000", 150) == ["ok"]
    first, second = (fields_of(board.send(POSITION, 50)[0], "POS") for _ in range(2))
    assert (first[1], first[4], first[7].replace("W", "")) == ("Jog", "0", "M")
    # All counters are of one instant: the axes are in the ratio of the move, to the step.
    for fields in (first, second):
        x, y, z = steps_of(fields[3])
        assert abs(x * 2 - y * 3) <= 3
        assert abs(x - z * 3) <= 3
    assert int(second[0]) == int(first[0]) + 1
    # The second byte came 50 ms after the first.
    assert abs(int(second[2]) - int(first[2]) - 50_000) <= RECEIVE_US
    board.send(b"", 1000)
    rest = fields_of(board.send(POSITION, 50)[0], "POS")
    assert rest[1] == "Idle"
    assert steps_of(rest[3]) == board.table().motor_steps == (-3600, -2400, -1200)
    later = fields_of(board.send(POSITION, 50)[0], "POS")
    assert abs(int(later[4]) - int(rest[4]) - 50_000) <= RECEIVE_US


def test_no_step_is_lost_at_12_khz_on_three_axes_while_the_host_chatters(board: LockstepBoard) -> None:
    assert board.say("$110=1801", 5) == ["error:12"]
    # 30 mm/s on every axis are asked for and reached within 60 ms; the move takes 1.4 s.
    assert board.say("$J=G91X-40Y-40Z-40F3200", 200) == ["ok"]
    board.step_intervals()
    reports = [line for _ in range(40) for line in board.send(STATUS + POSITION, 20)]
    assert sum(line.startswith("[POS") for line in reports) >= 35
    count, least, median, most, pulse = board.step_intervals()
    if count:
        print(f"{count} steps at {16e6 / median:.0f} Hz: {least} to {most} cycles, step interrupt up to {pulse} cycles")
        # 16 MHz / 12 kHz. A step waits for the snapshot of a 0xF0, 35 us, and the next comes that much sooner.
        assert abs(median - 1333) <= 8
        assert most - median < 640
        assert median - least < 720
        # Some 40 % of the time between steps are left for everything else.
        assert pulse < 800
    board.send(b"", 1500)
    assert board.table().motor_steps == (-16000, -16000, -16000)
    last = fields_of(board.say("$P")[0], "POS")
    assert steps_of(last[3]) == (-16000, -16000, -16000)
    # Neither did a move run dry nor was a byte dropped.
    assert not set(last[7]) & set("UB")


def test_measured_move_says_ok_when_it_has_arrived_from_below_and_settled(board: LockstepBoard) -> None:
    for setting in ("$205=150", "$210=1", "$200=1"):
        assert board.say(setting) == ["ok"]
    lines = board.say("$M=G90X-5F1200", 2000)
    assert lines[-1] == "ok"
    done = fields_of(lines[0], "DONE")
    assert steps_of(done[3]) == (-2000, 0, 0) == board.table().motor_steps
    # 5 + 1 mm down and 1 mm up: the turning point is in the strobe-free log of a step trigger.
    assert board.say("$T=X-2399") == ["ok"]
    assert board.say("$M=G90X-5.001F1200", 1500)[-1] == "ok"
    assert board.table().trigger_pulses == 1


def test_a_measured_move_that_is_broken_off_says_so(board: LockstepBoard) -> None:
    assert board.say("$M=G90X-8F300", 300) == []
    assert board.send(CANCEL, 800) == ["error:62"]
    x = board.table().motor_steps[0]
    assert -3200 < x < 0
    assert steps_of(fields_of(board.say("$P")[0], "POS")[3])[0] == x


def test_trigger_fires_after_rest_and_settle_and_at_step_counts(board: LockstepBoard) -> None:
    assert board.say("$205=100") == ["ok"]
    assert board.say("$J=G91X-2F600", 20) == ["ok"]
    assert board.say("$T", 1000) == ["ok"]
    index, kind, t_us, steps = fields_of(board.say("$L")[0], "STAMP")
    assert (index, kind, steps) == ("0", "T", "-800,0,0")
    rest = fields_of(board.say("$P")[0], "POS")
    rested_us = int(rest[2]) - int(rest[4])
    # The main program looks every millisecond.
    assert 100_000 <= int(t_us) - rested_us <= 102_100
    assert board.say("$T=X-1000,200") == ["ok"]
    assert board.say("$J=G91X-2F600", 600) == ["ok"]
    stamps = [fields_of(line, "STAMP") for line in board.say("$L") if line != "ok"]
    assert [stamp[3] for stamp in stamps] == ["-1000,0,0", "-1200,0,0", "-1400,0,0", "-1600,0,0"]
    # 200 steps at 10 mm/s are 50 ms; the first and last lie in the ramps.
    assert abs(int(stamps[2][2]) - int(stamps[1][2]) - 50_000) < 1_000
    assert board.table().trigger_pulses == 5


def test_strobe_edges_are_stamped_and_losses_admitted(board: LockstepBoard) -> None:
    assert board.say("$206=1") == ["ok"]
    for _ in range(2 * 20):
        board.do("C", 5)
    assert "O" in fields_of(board.say("$P")[0], "POS")[7]
    stamps = [fields_of(line, "STAMP") for line in board.say("$L", 300) if line != "ok"]
    assert [int(stamp[0]) for stamp in stamps] == list(range(4, 20))
    assert {stamp[1] for stamp in stamps} == {"S"}
    gaps = [int(b[2]) - int(a[2]) for a, b in pairwise(stamps)]
    # Two edges are 10 ms apart; a capture is good to a tick, the simulator's instants to an instruction.
    assert max(abs(gap - 10_000) for gap in gaps) <= 3


def test_lost_heartbeat_stops_the_motion_and_the_light_and_keeps_the_position(board: LockstepBoard) -> None:
    assert board.say("$202=200") == ["ok"]
    assert board.say("M3S500") == ["ok"]
    assert board.table().led_duty == 128
    lines = board.say("G1X-20F600", 1000)
    assert lines == ["ok", "[MSG:Heartbeat lost]"]
    table = board.table()
    assert table.led_duty == 0
    # 200 ms of 10 mm/s, and 50 ms prepared, and 20 ms to brake: less than 3 mm.
    assert -1200 < table.motor_steps[0] < -700
    assert board.send(STATUS, 20)[0].startswith("<Hold:0|")
    assert steps_of(fields_of(board.say("$P")[0], "POS")[3]) == table.motor_steps


@pytest.mark.parametrize("kind", KINDS)
def test_a_host_that_falls_silent_while_homing_breaks_it_off(firmware_builds: FirmwareBuilds, kind: str) -> None:
    with firmware_builds.board(kind) as board:
        brisk = [f"${base + i}={value}" for base, value in BRISK.items() for i in range(3)]
        for setting in ("$22=1", "$26=20", "$25=500", "$24=250", "$202=200", *brisk):
            assert board.say(setting, 20) == ["ok"]
        board.do("M 0 0 -8000", 1)
        lines = board.say("$H", 1500)
        assert lines[:3] == ["[MSG:Heartbeat lost]", "ALARM:6", "ok"]
        assert "[MSG:'$H'|'$X' to unlock]" in lines
        stopped = board.table().motor_steps[2] + 8000
        # 500 mm/min for 200 ms are 667 steps; then none.
        assert 500 < stopped < 750
        board.send(b"", 500)
        assert board.table().motor_steps[2] + 8000 == stopped
        assert board.send(STATUS, 20)[0].startswith("<Alarm|")
        # A host that keeps asking homes: 20 mm of Z, then X and Y, take some 7 s.
        assert board.say("$H", 1) == []
        said = [line for _ in range(80) for line in board.send(POSITION, 100)]
        assert [line for line in said if not line.startswith("[POS")] == ["ok"]
        assert fields_of(said[0], "POS")[1] == "Home"
        assert fields_of(said[-1], "POS")[6] == "XYZ"


def test_emergency_stop_ends_the_steps_at_once_and_locks_until_released(board: LockstepBoard) -> None:
    # Closed at rest: the pin is low, and pressing opens it.
    board.do("E 0", 1)
    assert board.say("$203=1") == ["ok"]
    assert board.say("M3S1000") == ["ok"]
    assert board.say("G1X-20F600", 500) == ["ok"]
    before = board.table().motor_steps
    assert board.do("E 1", 700)[:1] == ["ALARM:10"]
    after = board.table()
    # Not one step more than those of the instant it was pressed.
    assert abs(after.motor_steps[0] - before[0]) <= 1
    assert (after.led_duty, after.motors_on) == (0, False)
    lines = board.send(RESET, 1500)
    assert "ALARM:10" in lines
    board.do("E 0", 10)
    lines = board.send(RESET, 500)
    assert "Grbl 1.1h ['$' for help]" in lines
    assert "[MSG:'$H'|'$X' to unlock]" in lines
    assert board.say("$X") == ["[MSG:Caution: Unlocked]", "ok"]


def test_numbered_lines_run_once_however_often_they_are_sent(board: LockstepBoard) -> None:
    move = sealed("N7 $J=G91X-1F1200")
    assert board.say(move, 500) == ["ok"]
    assert board.say(move, 500) == ["ok"]
    assert board.table().motor_steps == (-400, 0, 0)
    assert board.say(sealed("N9 $J=G91X-1F1200")) == ["error:61"]
    assert board.say(sealed("N8 G5")) == ["error:20"]
    assert board.say(sealed("N8 G5")) == ["error:20"]
    assert board.say("$J=G91X-1F1200*00") == ["error:60"]
    assert board.say("$J=G91X-1F1200", 500) == ["ok"]
    assert board.table().motor_steps == (-800, 0, 0)


def test_moves_are_refused_until_every_axis_is_homed(firmware_builds: FirmwareBuilds) -> None:
    with firmware_builds.board("native") as board:
        for setting in ("$22=1", "$20=1", "$26=20", *(f"${120 + i}=200" for i in range(3))):
            assert board.say(setting) == ["ok"]
        assert board.say("G0X-1") == ["error:46"]
        assert board.say("$J=X-1F100") == ["error:46"]
        assert board.say("$H", 15_000) == ["ok"]
        report = fields_of(board.say("$P")[0], "POS")
        assert report[6] == "XYZ"
        assert steps_of(report[3]) == (-250, -250, -250)
        assert board.say("$J=G90X-2F100", 1000) == ["ok"]
        # Homing again finds the same place: nothing was lost, so the counters do not shift.
        assert board.say("$H", 15_000) == ["ok"]
        lines = board.say("$E")
        assert fields_of(lines[3], "SHIFT") == ["0,0,0"]
        # The switch closed at machine zero, a pull-off above where the cycle ended.
        assert [fields_of(line, "EDGE")[1] for line in lines[:3]] == ["0", "0", "0"]
        # Behind its back a motor slips by 7 steps: the next homing tells.
        board.do("M 7 0 0")
        assert board.say("$H", 15_000) == ["ok"]
        assert fields_of(board.say("$E")[3], "SHIFT") == ["7,0,0"]


@pytest.mark.parametrize("kind", KINDS)
def test_settings_and_boot_number_outlive_power_and_no_byte_is_lost_while_they_are_stored(
    firmware_builds: FirmwareBuilds, kind: str, tmp_path: Path
) -> None:
    memory = str(tmp_path / "memory.bin")
    with firmware_builds.board(kind, "--memory", memory) as board:
        assert "[MSG:Settings lost, defaults in use]" in board.greeting
        # Six settings in one burst: GRBL loses five of these lines to its pauses for the memory.
        burst = "".join(f"${100 + i}={300 + i}\n${110 + i}=900\n" for i in range(3))
        assert board.send(burst.encode(), 200) == ["ok"] * 6
        board.send(b"", 800)
        assert fields_of(board.say("$P")[0], "POS")[7] == "-"
    with firmware_builds.board(kind, "--memory", memory) as board:
        assert "[MSG:Reset: power, boot 2]" in board.greeting
        assert "Settings lost" not in board.greeting
        assert {"$100=300.000", "$101=301.000", "$102=302.000"} <= set(board.say("$$", 300))
        lines = board.do("R button", 300)
        assert "[MSG:Reset: button, boot 3]" in lines
        assert fields_of(board.say("$P")[0], "POS")[8] == "3"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("cause", ["power", "button", "brown-out", "watchdog"])
def test_the_welcome_says_what_reset_it_and_positions_are_forgotten(
    firmware_builds: FirmwareBuilds, kind: str, cause: str
) -> None:
    with firmware_builds.board(kind) as board:
        assert board.say("$J=G91X-0.1F300", 500) == ["ok"]
        lines = board.do(f"R {cause}", 500)
        assert lines[0] == "Grbl 1.1h ['$' for help]"
        assert re.match(rf"\[MSG:Reset: {cause}, boot \d+\]", lines[1])
        report = fields_of(board.say("$P")[0], "POS")
        assert (report[3], report[6]) == ("0,0,0", "-")
        assert board.table().motor_steps == (-25, 0, 0)
