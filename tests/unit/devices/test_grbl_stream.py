"""Motions told piece by piece: smooth, never outside, stopped first; and the mock that blends blocks."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from tests.helpers.grbl_ports import MockGantry, linear_axes
from uvgs_bench.devices.gantry import Envelope
from uvgs_bench.errors import EnvelopeError, GantryAlarm, GantryError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import ns_from_s

START = np.array([-0.1, -0.1, -0.1])
STEP = np.array([-0.001, 0.0, 0.0])


def homed(monkeypatch: pytest.MonkeyPatch) -> MockGantry:
    mock = MockGantry(monkeypatch, envelope=Envelope(linear_axes()))
    mock.gantry.home()
    mock.gantry.move_to(START, 0.05)
    return mock


def speed_at(mock: MockGantry, t_ns: int) -> float:
    return float(np.linalg.norm(mock.device.velocity_at(t_ns)))


def place(mock: MockGantry) -> FloatArray:
    return np.asarray(mock.device.position_at(mock.clock.now_ns()))


def test_short_pieces_are_passed_without_a_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    mock = homed(monkeypatch)
    begun_ns = mock.clock.now_ns()
    with mock.gantry.streaming() as stream:
        for k in range(1, 41):
            stream.order(START + k * STEP, 0.03)
            while k > 12 and mock.device.position_at(mock.clock.now_ns())[0] > START[0] + (k - 12) * STEP[0]:
                stream.observe()
    np.testing.assert_allclose(place(mock), START + 40 * STEP, atol=1e-6)
    # 40 mm at 30 mm/s with 200 mm/s^2: up to speed after 0.15 s, and 1.33 s long; between there is no slower instant.
    cruise = [speed_at(mock, begun_ns + ns_from_s(t)) for t in np.arange(0.2, 1.2, 0.01)]
    # A feed is told in whole um/min.
    np.testing.assert_allclose(cruise, 0.03, rtol=0.0, atol=2e-8)
    stops = mock.device.motions_until(mock.clock.now_ns()).stops_count
    now_s, begun_s = mock.clock.now_ns() / 1e9, begun_ns / 1e9
    assert stops(now_s) == stops(begun_s) + 1


def test_a_sharp_corner_is_taken_slowly(monkeypatch: pytest.MonkeyPatch) -> None:
    mock = homed(monkeypatch)
    begun_ns = mock.clock.now_ns()
    corner = START + 10 * STEP
    with mock.gantry.streaming() as stream:
        stream.order(corner, 0.03)
        stream.order(corner + np.array([0.0, -0.01, 0.0]), 0.03)
    times = [begun_ns + ns_from_s(t) for t in np.arange(0.0, 1.2, 0.001)]
    nearest = min(times, key=lambda t: float(np.linalg.norm(mock.device.position_at(t) - corner)))
    # Junction deviation 0.01 mm at 200 mm/s^2 and 90 deg allows 2.2 mm/s; 1 ms at 200 mm/s^2 is 0.2 mm/s.
    assert 0.0 < speed_at(mock, nearest) < 0.0026


def test_leaving_the_envelope_stops_first_and_sends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    mock = homed(monkeypatch)
    with pytest.raises(EnvelopeError), mock.gantry.streaming() as stream:  # noqa: PT012
        stream.order(START + 40 * STEP, 0.05)
        mock.clock.sleep(0.3)
        stream.order(np.array([-0.3, -0.1, -0.1]), 0.05)
    assert not any("X-300" in line for line in mock.spy.sent())
    state = mock.gantry.state()
    assert (state.activity, state.is_trusted) == ("Idle", True)
    assert START[0] + 40 * STEP[0] < state.position[0] < START[0]
    # The motion can go on from there.
    mock.gantry.move_to(START, 0.05)


def test_an_interruption_stops_the_motion_before_it_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    mock = homed(monkeypatch)
    with pytest.raises(KeyboardInterrupt), mock.gantry.streaming() as stream:  # noqa: PT012
        for k in range(1, 15):
            stream.order(START + k * 2 * STEP, 0.05)
        mock.clock.sleep(0.2)
        raise KeyboardInterrupt
    at = place(mock)
    mock.clock.sleep(1.0)
    np.testing.assert_array_equal(place(mock), at)
    # Braking follows the path that was told.
    np.testing.assert_allclose(at[1:], START[1:], atol=1e-9)
    assert START[0] + 28 * STEP[0] < at[0] < START[0]


@pytest.mark.parametrize("pieces", [1, 3, 14])
@pytest.mark.parametrize("after_s", [0.01, 0.1, 0.17, 0.25])
def test_braking_follows_a_path_around_corners(monkeypatch: pytest.MonkeyPatch, pieces: int, after_s: float) -> None:
    """A fine arc: wherever it is stopped, it stands on a piece that was told."""
    mock = homed(monkeypatch)
    turns = [np.array([-np.sin(a), np.cos(a) - 1.0, 0.0]) for a in np.linspace(0.0, 1.2, pieces + 1)]
    told = [START + 0.02 * turn for turn in turns]
    with pytest.raises(KeyboardInterrupt), mock.gantry.streaming() as stream:  # noqa: PT012
        for target in told[1:]:
            stream.order(target, 0.05)
        mock.clock.sleep(after_s)
        raise KeyboardInterrupt
    at = place(mock)
    off = []
    for a, b in pairwise(told):
        share = np.clip((at - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        off.append(float(np.linalg.norm(at - a - share * (b - a))))
    # A motor stands on a whole step, 1/250 mm here.
    assert min(off) < 5e-6
    assert mock.gantry.state().is_trusted


def test_a_carriage_that_leaves_the_path_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    mock = homed(monkeypatch)
    with pytest.raises(GantryError, match="left its path"), mock.gantry.streaming() as stream:  # noqa: PT012
        stream.order(START + STEP, 0.05)
        mock.type_behind_its_back("$J=G21G90G53X-101.0Y-150.0F3000")
        for _ in range(200):
            stream.observe()
            mock.clock.sleep(0.02)
    mock.clock.sleep(1.0)
    assert place(mock)[1] > -0.12
    assert mock.gantry.state().activity == "Idle"


def test_a_motion_begins_homed_and_an_alarm_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    mock = MockGantry(monkeypatch)
    with pytest.raises(GantryError, match="homed"), mock.gantry.streaming():
        pass
    assert not mock.spy.moves()
    mock.gantry.home()
    mock.gantry.move_to(START, 0.05)
    with pytest.raises(GantryAlarm), mock.gantry.streaming() as stream:  # noqa: PT012
        stream.order(START + 40 * STEP, 0.05)
        mock.clock.sleep(0.2)
        mock.device.receive(0x18, mock.clock.now_ns())
        for _ in range(10):
            stream.observe()
    assert not mock.gantry.state().is_homed


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_a_speed_that_is_none_is_refused(monkeypatch: pytest.MonkeyPatch, speed: float) -> None:
    mock = homed(monkeypatch)
    sent = len(mock.spy.moves())
    with pytest.raises(GantryError, match="speed"), mock.gantry.streaming() as stream:
        stream.order(START + STEP, speed)
    assert len(mock.spy.moves()) == sent
