"""What a received line means, and how a move is written."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.grbl_ports import linear_axes
from uvgs_bench.devices.gantry.grbl_codes import find_dialect
from uvgs_bench.devices.gantry.grbl_protocol import (
    Alarm,
    Message,
    Reply,
    Report,
    Setting,
    Unknown,
    Welcome,
    check_line,
    plan_path,
    read_received,
    write_move,
)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("ok", Reply(0)),
        ("error:22", Reply(22)),
        ("ALARM:9", Alarm(9)),
        ("$110=500.000", Setting("110", "500.000")),
        ("$N0=", Setting("N0", "")),
        ("[MSG:'$H'|'$X' to unlock]", Message("MSG", "'$H'|'$X' to unlock")),
        ("[VER:1.1h.20190830:]", Message("VER", "1.1h.20190830:")),
        ("[NVS STORAGE:*EEPROM]", Message("NVS STORAGE", "*EEPROM")),
        ("[GC:G0 G54 G17 F0 S0]", Message("GC", "G0 G54 G17 F0 S0")),
        ("Grbl 1.1h ['$' for help]", Welcome("Grbl 1.1h ['$' for help]")),
        ("GrblHAL 1.1f ['$' or '$HELP' for help]", Welcome("GrblHAL 1.1f ['$' or '$HELP' for help]")),
        ("Grbl 3.7 [FluidNC v3.7.8 (wifi) '$' for help]", Welcome("Grbl 3.7 [FluidNC v3.7.8 (wifi) '$' for help]")),
        ("okk", Unknown("okk")),
        ("error:", Unknown("error:")),
        ("ALARM:x", Unknown("ALARM:x")),
        (">G54G20:ok", Unknown(">G54G20:ok")),
    ],
)
def test_received_lines(line: str, expected: object) -> None:
    assert read_received(line) == expected


def test_a_report_with_everything() -> None:
    report = read_received("<Hold:1|WPos:1.500,-2.000,0.000|Bf:14,127|FS:65,500|Pn:XZ|WCO:-1.000,0.000,3.250|A:S|H:0>")
    assert isinstance(report, Report)
    assert (report.activity, report.substate, report.machine) == ("Hold", "1", None)
    np.testing.assert_array_equal(report.work, [1.5, -2.0, 0.0])
    np.testing.assert_array_equal(report.offset, [-1.0, 0.0, 3.25])
    assert report.fields == {"Bf": "14,127", "FS": "65,500", "Pn": "XZ", "A": "S", "H": "0"}


@pytest.mark.parametrize(
    "line",
    [
        "<Idle|MPos:1.0,2.0,x|FS:0,0>",
        "<Idle|MPos:1.0,,3.0>",
        "<Idle|MPos:nan,0.0,0.0>",
        "<Idle|FS:0,0>",
        "<|MPos:0.0,0.0,0.0>",
        "<>",
        "<Idle|MPos:0.000,0.000,0.000|FS:0,0",
        "dle|MPos:0.000,0.000,0.000|FS:0,0>",
    ],
)
def test_a_damaged_report_is_no_position(line: str) -> None:
    assert isinstance(read_received(line), Unknown)


@given(st.text(max_size=60))
def test_any_text_is_read(line: str) -> None:
    read_received(line)
    read_received(f"<{line}>")


def test_moves_are_in_mm_and_absolute_machine_positions() -> None:
    axes = linear_axes()
    assert write_move(axes, np.array([-0.1, 0.0, -0.0123456]), 1234.5678) == (
        "$J=G21G90G53X-100.0000Y0.0000Z-12.3456F1234.568"
    )
    assert (
        write_move(axes, np.array([-1e-9, 0.0, 0.0]), 60.0, style="line") == "G21G90G53G1X0.0000Y0.0000Z0.0000F60.000"
    )
    with pytest.raises(ValueError, match="too slow"):
        write_move(axes, np.zeros(3), 1e-5)


def test_a_line_must_fit_the_buffer_and_be_printable() -> None:
    check_line("X" * 79)
    with pytest.raises(ValueError, match="80 characters"):
        check_line("X" * 80)
    for line in ("G0\nX1", "G0 X1\x18", "G0 X1é"):
        with pytest.raises(ValueError, match="printable"):
            check_line(line)


def test_feed_and_duration_of_a_known_move() -> None:
    """100 mm at 50 mm/s and 200 mm/s^2 take 2.25 s; 5 mm never reach the speed: 2 sqrt(5/200) s."""
    axes = linear_axes()
    plan = plan_path(axes, np.array([0.1, 0.0, 0.0]), 0.05)
    assert plan.feed_per_min == pytest.approx(3000.0, abs=1e-3)
    assert plan.duration_s == pytest.approx(2.25, abs=1e-9)
    assert plan_path(axes, np.array([0.005, 0.0, 0.0]), 0.05).duration_s == pytest.approx(2 * 0.025**0.5, abs=1e-9)


def test_dialects_read_the_same_number_differently() -> None:
    grbl = find_dialect({"VER": "1.1h.20190830:", "OPT": "V,15,128"})
    hal = find_dialect({"VER": "1.1f.20260817:", "FIRMWARE": "grblHAL"})
    assert (grbl.name, hal.name) == ("grbl", "grblHAL")
    assert grbl.has_jog
    assert not find_dialect({"VER": "0.9j.20160303:"}).has_jog
    assert "second motor" in grbl.meaning("alarm", 10)
    assert "emergency stop" in hal.meaning("alarm", 10)
    assert "does not document" in grbl.meaning("error", 79)
