"""The GRBL driver believes nothing it has not checked, and after anything that goes wrong it knows what it knows."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.grbl_ports import MockGantry, linear_axes
from uvgs_bench.devices.gantry import Envelope
from uvgs_bench.devices.sim.grbl_device import GrblDevice
from uvgs_bench.errors import (
    EnvelopeError,
    GantryError,
)
from uvgs_bench.units import s_from_ns

FAST = 0.05
# Half a step of 1/400 mm, and half the last digit of a report.
AT_M = 1.25e-6 + 0.75e-6


def test_opening_finds_out_who_answers_and_knows_no_position(mock: MockGantry) -> None:
    info = mock.gantry.info
    assert (info.firmware, info.version, info.options) == ("grbl", "1.1h.20190830", "V,15,128")
    assert info.settings["130"] == "200.000"
    state = mock.gantry.state()
    assert not state.is_homed
    assert not state.is_trusted


def test_refuses_to_move_unhomed_and_sends_nothing(mock: MockGantry) -> None:
    with pytest.raises(GantryError, match="not homed"):
        mock.gantry.move_to([-0.1, -0.1, -0.1], FAST)
    assert not mock.spy.moves()


def test_homing_gives_the_machine_position(mock: MockGantry) -> None:
    state = mock.gantry.home()
    assert state.is_trusted
    np.testing.assert_allclose(state.position, [-0.001] * 3, atol=AT_M)
    np.testing.assert_allclose(mock.device.position_at(mock.clock.now_ns()), [-0.001] * 3, atol=AT_M)


def test_arrived_means_at_rest_at_the_target(mock: MockGantry) -> None:
    mock.gantry.home()
    for target in ([-0.1, -0.05, -0.02], [0.0, 0.0, 0.0], [-0.2, -0.2, -0.2], [-0.19999, -0.2, -0.2]):
        before = mock.gantry.state()
        state = mock.gantry.move_to(target, FAST)
        assert state.is_trusted
        assert state.activity == "Idle"
        np.testing.assert_allclose(state.position, target, atol=AT_M)
        now_ns = mock.clock.now_ns()
        np.testing.assert_array_equal(mock.device.velocity_at(now_ns), 0.0)
        np.testing.assert_allclose(mock.device.position_at(now_ns), target, atol=AT_M)
        # No motion along this path is quicker than its length at full speed.
        length_m = float(np.linalg.norm(np.array(target) - before.position))
        assert s_from_ns(state.t_ns - before.t_ns) >= length_m / FAST


def test_nothing_is_polled_while_homing(mock: MockGantry) -> None:
    mock.gantry.home()
    events = [(direction, text) for _, direction, text in mock.spy.events]
    begin = events.index((">", "$H"))
    assert events[begin + 1] == ("<", "ok")


def test_a_target_outside_is_refused_before_a_move_is_sent(mock: MockGantry) -> None:
    mock.gantry.home()
    for target in ([0.001, 0, 0], [0, -0.201, 0], [np.nan, 0, 0], [0, 0]):
        with pytest.raises(EnvelopeError):
            mock.gantry.move_to(target, FAST)
    with pytest.raises(EnvelopeError):
        mock.gantry.jog([0.01, 0.0, 0.0], FAST)
    assert not mock.spy.moves()


def test_a_path_through_a_keep_out_box_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    box = np.array([[-0.11, -0.2, -0.2], [-0.09, 0.0, 0.0]])
    with MockGantry(monkeypatch, envelope=Envelope(linear_axes(), (box,))).gantry as gantry:
        gantry.home()
        gantry.move_to([-0.08, -0.1, -0.1], FAST)
        with pytest.raises(EnvelopeError, match="keep-out"):
            gantry.move_to([-0.15, -0.1, -0.1], FAST)


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_speed_must_be_positive(mock: MockGantry, speed: float) -> None:
    mock.gantry.home()
    with pytest.raises(GantryError, match="speed"):
        mock.gantry.move_to([-0.1, 0, 0], speed)


def test_no_axis_is_told_to_be_faster_than_it_may(mock: MockGantry) -> None:
    mock.gantry.home()
    mock.gantry.move_to([-0.101, -0.001, -0.001], 10.0)
    assert mock.spy.moves()[-1].endswith("F3000.000")


def test_a_controller_slower_than_the_bench_file_says_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """199 mm at the controller's own 300 mm/min take 40 s, not the 4 s of the bench's 3000 mm/min."""
    device = GrblDevice.for_axes(linear_axes())
    device.settings.update({110: 300.0, 120: 10.0})
    mock = MockGantry(monkeypatch, device)
    mock.gantry.home()
    state = mock.gantry.move_to([-0.2, -0.001, -0.001], FAST)
    np.testing.assert_allclose(state.position, [-0.2, -0.001, -0.001], atol=AT_M)
    assert mock.spy.moves()[-1].endswith(("F300.000", "F299.999"))
    mock.gantry.close()


def test_jog_moves_by_an_offset(mock: MockGantry) -> None:
    mock.gantry.home()
    state = mock.gantry.jog([-0.01, 0.0, -0.02], FAST)
    np.testing.assert_allclose(state.position, [-0.011, -0.001, -0.021], atol=AT_M)


def test_any_interruption_leaves_a_gantry_that_stops_and_knows_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C is simulated at every single event on the wire of a move, in turn."""

    class Stop:
        def __init__(self, at: int) -> None:
            self.at = at
            self.has_fired = False

        def __call__(self, number: int, _direction: str, _text: str) -> None:
            if number == self.at:
                self.has_fired = True
                raise KeyboardInterrupt

    mock = MockGantry(monkeypatch)
    mock.gantry.home()
    broken_off = 0
    for after in range(1, 9):
        mock.gantry.move_to([-0.001] * 3, FAST)
        interruption = Stop(len(mock.spy.events) + after)
        mock.spy.on_event = interruption
        with pytest.raises(KeyboardInterrupt):
            mock.gantry.move_to([-0.15, -0.1, -0.05], FAST)
        assert interruption.has_fired
        state = mock.gantry.stop()
        now_ns = mock.clock.now_ns()
        np.testing.assert_array_equal(mock.device.velocity_at(now_ns), 0.0)
        assert state.is_trusted, after
        np.testing.assert_allclose(state.position, mock.device.position_at(now_ns), atol=AT_M)
        broken_off += bool(-0.149 < state.position[0] < -0.002)
        mock.clock.sleep(2.0)
        np.testing.assert_array_equal(
            mock.device.position_at(mock.clock.now_ns()), mock.device.position_at(now_ns), "moved after the stop"
        )
    assert broken_off >= 3
    mock.gantry.close()


def test_an_interruption_inside_the_port_leaves_a_gantry_that_stops(mock: MockGantry) -> None:
    """The line is out but nothing was read yet; or it was cut in two, and its rest would join the next line."""
    mock.gantry.home()
    port = mock.gantry._wire._port
    whole_write = port.write

    def write_and_raise(data: bytes, count: int) -> int:
        if data.startswith(b"$J"):
            whole_write(data[:count])
            raise KeyboardInterrupt
        return whole_write(data)

    for count in (1, 20, 1000):
        port.write = lambda data, count=count: write_and_raise(data, count)
        with pytest.raises(KeyboardInterrupt):
            mock.gantry.move_to([-0.15, -0.1, -0.05], FAST)
        port.write = whole_write
        state = mock.gantry.stop()
        assert state.is_trusted
        np.testing.assert_allclose(state.position, mock.device.position_at(mock.clock.now_ns()), atol=AT_M)
        np.testing.assert_array_equal(mock.device.velocity_at(mock.clock.now_ns()), 0.0)
        np.testing.assert_allclose(mock.gantry.move_to([-0.001] * 3, FAST).position, [-0.001] * 3, atol=AT_M)


def test_interrupted_homing_is_stopped_and_not_homed(mock: MockGantry) -> None:
    def interrupt(_number: int, direction: str, text: str) -> None:
        if (direction, text) == (">", "$H"):
            raise KeyboardInterrupt

    mock.spy.on_event = interrupt
    with pytest.raises(KeyboardInterrupt):
        mock.gantry.home()
    mock.spy.on_event = lambda *_: None
    assert not mock.gantry.stop().is_homed
    assert mock.gantry.home().is_trusted


def test_stop_at_rest_does_nothing(mock: MockGantry) -> None:
    mock.gantry.home()
    before = mock.gantry.state().position
    state = mock.gantry.stop()
    assert state.is_trusted
    np.testing.assert_array_equal(state.position, before)


def test_closing_stops_the_motion(mock: MockGantry) -> None:
    mock.gantry.home()

    def interrupt(_number: int, direction: str, text: str) -> None:
        if direction == "<" and text.startswith("<Jog"):
            raise KeyboardInterrupt

    mock.spy.on_event = interrupt
    with pytest.raises(KeyboardInterrupt):
        mock.gantry.move_to([-0.2] * 3, 0.02)
    mock.spy.on_event = lambda *_: None
    mock.gantry.close()
    mock.gantry.close()
    np.testing.assert_array_equal(mock.device.velocity_at(mock.clock.now_ns()), 0.0)
    assert mock.device.position_at(mock.clock.now_ns())[0] > -0.2
    with pytest.raises(GantryError, match="closed"):
        mock.gantry.state()
