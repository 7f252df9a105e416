"""The panel says what a reader must know, in every width, and never shows an old pose as a fresh one."""

from __future__ import annotations

from math import nan

import pytest
from rich.console import Console

from tests.helpers.live_states import shown_state
from uvgs_bench.view import terminal
from uvgs_bench.view.live_state import GantryShown, LiveState
from uvgs_bench.view.terminal import LivePanel, sparkline


def drawn(state: LiveState, width: int = 100) -> str:
    console = Console(width=width, force_terminal=True, color_system=None, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    with console.file:
        console.print(LivePanel(state))
    return console.export_text()


@pytest.mark.parametrize("width", [40, 60, 100, 200])
def test_it_fits_into_every_width(width):
    state = shown_state()
    state.gantry = lambda: GantryShown("Idle", True, (("X", "-10.000 mm"), ("Y", "0.000 mm")))
    text = drawn(state, width)
    assert max(len(line) for line in text.splitlines()) <= width
    for word in ("OK", "±", "mm", "margin", "3 with a pose", "2 dropped", "latency", "exposure", "Idle"):
        assert word in " ".join(text.replace("│", " ").split())


def test_a_held_pose_is_said_to_be_old_and_has_no_deviations():
    text = drawn(shown_state("held"))
    assert "HELD" in text
    assert "repeated for 0.25 s" in text
    assert "±" not in text
    assert "rms" not in text


def test_a_miss_says_why_and_shows_no_numbers():
    text = drawn(shown_state("miss"))
    assert "MISS" in text
    assert "blobs/too_few" in text
    assert "<b>where</b>" in text
    assert "x y z" not in text


def test_an_unhomed_gantry_is_said_to_be_nowhere():
    state = shown_state()
    state.gantry = lambda: GantryShown("Alarm", False, (("X", "0.000 mm"),))
    assert "not homed: positions mean nothing" in " ".join(drawn(state).replace("│", " ").split())


def test_what_is_not_new_is_said_to_be_old(monkeypatch):
    state = shown_state()
    later = terminal.monotonic() + 5.0
    monkeypatch.setattr(terminal, "monotonic", lambda: later)
    assert "nothing new for 5 s" in drawn(state)
    state.end()
    assert "nothing new" not in drawn(state)


def test_before_the_first_capture_it_waits():
    assert "opening" in drawn(LiveState())


def test_sparkline():
    assert sparkline([0.0, nan, 0.5, 1.0], 10) == "▁·▅█"
    assert sparkline([3.0, 3.0], 10) == "▁▁"
    assert sparkline([nan], 10) == "·"
    assert sparkline([], 10) == ""
    assert len(sparkline([float(k) for k in range(100)], 7)) == 7
