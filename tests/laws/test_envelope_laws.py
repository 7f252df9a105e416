"""Whatever is asked of the driver, no target outside the envelope is ever sent and no path through a keep-out box."""

from __future__ import annotations

import contextlib
import re
from types import SimpleNamespace

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.helpers.grbl_ports import MockGantry, linear_axes
from uvgs_bench.devices.gantry import Axis, Envelope
from uvgs_bench.devices.gantry.grbl_protocol import LONGEST_LINE, plan_path, write_move
from uvgs_bench.devices.sim import bench as sim_bench
from uvgs_bench.devices.sim.grbl_device import GrblDevice
from uvgs_bench.errors import EnvelopeError, GantryError
from uvgs_bench.units import S_PER_MIN

# A little beyond the travel on either side, on the borders, and what is no number at all.
COORDINATE = st.one_of(
    st.floats(-0.06, 0.01),
    st.sampled_from([0.0, -0.01, -0.025, -0.04, -0.05, 1e-9, -0.05 - 1e-9, float("nan"), float("inf"), -1e9]),
)
STEP = st.tuples(st.sampled_from(["move", "jog"]), st.tuples(COORDINATE, COORDINATE, COORDINATE), st.floats(-0.01, 0.2))
BOX = np.array([[-0.03, -0.03, -0.05], [-0.02, -0.02, 0.0]])
_TARGET = re.compile(r"^\$J=G21G90G53X(-?[\d.]+)Y(-?[\d.]+)Z(-?[\d.]+)F([\d.]+)$")


class _NoPatch:
    """Puts the mock into the list of live benches, where it may stay until the next example."""

    def setitem(self, table: dict[str, object], name: str, value: SimpleNamespace) -> None:
        table[name] = value


@settings(max_examples=40)
@given(st.lists(STEP, min_size=1, max_size=6))
@example([("move", (-0.01, -0.01, -0.02), 0.05), ("move", (-0.04, -0.04, -0.02), 0.05)])
def test_nothing_outside_the_envelope_is_ever_sent(steps) -> None:
    envelope = Envelope(linear_axes(travel_m=0.05), (BOX,))
    mock = MockGantry(_NoPatch(), envelope=envelope)
    try:
        at = np.asarray(mock.gantry.home().position)
        for kind, values, speed in steps:
            before = len(mock.spy.moves())
            target = np.array(values) if kind == "move" else at + np.array(values)
            with contextlib.suppress(GantryError):
                at = (mock.gantry.move_to if kind == "move" else mock.gantry.jog)(values, speed).position
            if len(mock.spy.moves()) > before:
                envelope.check_point(target)
        visited = np.full(3, -0.001)
        for line in mock.spy.moves():
            match = _TARGET.match(line)
            assert match, line
            assert len(line) < LONGEST_LINE
            sent = np.array([float(value) for value in match.groups()[:3]]) / 1000.0
            assert np.all(sent >= -0.05)
            assert np.all(sent <= 0.0)
            # Steps of 2.5 um and lines of 0.1 um: a path may graze the box by that much.
            for share in np.linspace(0.0, 1.0, 101):
                point = visited + share * (sent - visited)
                assert not np.all((point > BOX[0] + 5e-6) & (point < BOX[1] - 5e-6)), line
            assert 0.0 < float(match.group(4)) <= 3000.0 * np.sqrt(3) + 0.01
            visited = sent
        now_ns = mock.clock.now_ns()
        position = mock.device.position_at(now_ns)
        assert np.all(position >= -0.05 - 2e-6)
        assert np.all(position <= 2e-6)
    finally:
        mock.gantry.close()
        sim_bench._live.pop("mock", None)


VECTOR = st.tuples(*[st.floats(-3.0, 3.0)] * 4).map(np.array).filter(lambda v: np.max(np.abs(v)) > 1e-4)
MIXED = (*linear_axes(), Axis("A", "rotary", np.array([0.0, 0.0, 1.0]), -3.2, 3.2, 0.5, 2.0))


@given(VECTOR, st.floats(1e-3, 10.0))
def test_the_feed_never_makes_an_axis_too_fast(delta, speed) -> None:
    plan = plan_path(MIXED, delta, speed)
    in_units = np.array([*(delta[:3] * 1000.0), np.degrees(delta[3])])
    cruise_s = float(np.linalg.norm(in_units)) / (plan.feed_per_min / S_PER_MIN)
    assert np.all(np.abs(delta) / cruise_s <= np.array([0.05, 0.05, 0.05, 0.5]) * (1 + 1e-9))
    length_m = float(np.linalg.norm(delta[:3]))
    assert length_m / cruise_s <= speed * (1 + 1e-9)


@given(st.tuples(*[st.floats(-0.2, 0.0)] * 3).map(np.array), st.floats(0.01, 5000.0))
def test_a_written_move_reads_back(position, feed) -> None:
    line = write_move(linear_axes(), position, feed)
    match = _TARGET.match(line)
    assert match
    # Four decimals of a millimetre.
    np.testing.assert_allclose([float(v) for v in match.groups()[:3]], position * 1000.0, atol=0.5001e-4)


@given(st.tuples(*[st.floats(-0.2, 0.0)] * 3).map(np.array), st.tuples(*[st.floats(-0.2, 0.0)] * 3).map(np.array))
def test_a_path_is_refused_exactly_when_it_meets_the_box(start, end) -> None:
    box = np.array([[-0.12, -0.12, -0.12], [-0.08, -0.08, -0.08]])
    envelope = Envelope(linear_axes(), (box,))
    points = start + np.linspace(0.0, 1.0, 2001)[:, None] * (end - start)
    depth = np.min(np.minimum(points - box[0], box[1] - points), axis=1).max()
    try:
        envelope.check_path(start, end)
        is_refused = False
    except EnvelopeError:
        is_refused = True
    if depth > 0.0:
        assert is_refused
    elif depth < -2e-4:  # the sampling step of the longest path
        assert not is_refused


@given(st.lists(st.binary(max_size=30), max_size=10), st.integers(0, 2**32 - 1))
def test_noise_never_breaks_the_controller(pieces, seed) -> None:
    """Whatever bytes come, the mock lives, and after a reset it greets."""
    rng = np.random.default_rng(seed)
    device = GrblDevice.for_axes(linear_axes(), boot_s=0.01)
    t_ns = 20_000_000
    for piece in pieces:
        for byte in piece:
            device.receive(byte, t_ns)
            t_ns += int(rng.integers(0, 200_000_000))
        device.take_output(t_ns)
    t_ns += 5_000_000_000
    device.take_output(t_ns)
    device.receive(0x18, t_ns)
    assert b"Grbl 1.1h ['$' for help]" in device.take_output(t_ns + 2_000_000_000)


# Per axis: 3000 mm/min; looked at every 0.25 s, told to stop at the second look, 20 ms on the wire and in the planner;
# 50 ms until a cancel bites; braking with 200 mm/s^2. m.
_ASTRAY_M = 0.05 * (0.25 + 0.02 + 0.05) + 0.05**2 / (2.0 * 0.2) + 1e-4


@settings(max_examples=40)
@given(st.integers(0, 60), st.integers(0, 7), st.floats(0.005, 0.05))
def test_a_damaged_move_of_plain_grbl_leaves_its_path_by_a_known_bound(place, bit, speed) -> None:
    """A line without a checksum may become another move: the controller keeps the travel, the driver the path."""
    mock = MockGantry(_NoPatch(), envelope=Envelope(linear_axes(travel_m=0.2)))
    try:
        start = np.array([-0.1, -0.1, -0.1])
        target = np.array([-0.15, -0.12, -0.08])
        mock.gantry.home()
        mock.gantry.move_to(start, 0.05)
        begun_ns = mock.clock.now_ns()
        receive, count = mock.device.receive, -1

        def damaged(byte: int, t_ns: int) -> None:
            nonlocal count
            if byte == ord("$") or count >= 0:
                count += 1
            receive(byte ^ (1 << bit) if count == place and byte != 0x0A else byte, t_ns)

        mock.device.receive = damaged  # type: ignore[method-assign]
        with contextlib.suppress(GantryError):
            mock.gantry.move_to(target, speed)
        mock.device.receive = receive  # type: ignore[method-assign]
        with contextlib.suppress(GantryError):
            mock.gantry.stop()
        way = (target - start) / np.linalg.norm(target - start)
        for t_ns in range(begun_ns, mock.clock.now_ns(), 10_000_000):
            at = np.asarray(mock.device.position_at(t_ns))
            assert np.all(at >= -0.2 - 2e-6)
            assert np.all(at <= 2e-6)
            along = np.clip((at - start) @ way, 0.0, np.linalg.norm(target - start))
            assert np.abs(at - start - along * way).max() <= _ASTRAY_M
        assert np.all(mock.device.velocity_at(mock.clock.now_ns()) == 0.0)
    finally:
        mock.gantry.close()
        sim_bench._live.pop("mock", None)
