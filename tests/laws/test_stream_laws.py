"""Whatever pieces a stream is told, no move outside the envelope is sent, and whatever ends it, the carriage stands."""

from __future__ import annotations

import re
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.grbl_ports import MockGantry, linear_axes
from uvgs_bench.devices.gantry import Envelope
from uvgs_bench.devices.sim import bench as sim_bench
from uvgs_bench.errors import EnvelopeError, GantryError

COORDINATE = st.one_of(
    st.floats(-0.06, 0.01), st.sampled_from([0.0, -0.05, -0.05 - 1e-9, -0.025, float("nan"), float("inf"), -1e9])
)
SPEED = st.one_of(st.floats(-0.01, 0.2), st.sampled_from([float("nan"), float("inf")]))
PIECE = st.tuples(st.tuples(COORDINATE, COORDINATE, COORDINATE), SPEED, st.floats(0.0, 0.3))
BOX = np.array([[-0.03, -0.03, -0.05], [-0.02, -0.02, 0.0]])
_TARGET = re.compile(r"^\$J=G21G90G53X(-?[\d.]+)Y(-?[\d.]+)Z(-?[\d.]+)F([\d.]+)$")


class _NoPatch:
    def setitem(self, table: dict[str, object], name: str, value: SimpleNamespace) -> None:
        table[name] = value


@settings(max_examples=40)
@given(st.lists(PIECE, min_size=1, max_size=8), st.sampled_from(["", "KeyboardInterrupt", "ValueError"]))
def test_nothing_outside_is_sent_and_the_carriage_stands_at_the_end(
    pieces: list[tuple[tuple[float, float, float], float, float]], ending: str
) -> None:
    envelope = Envelope(linear_axes(0.05), (BOX,))
    mock = MockGantry(_NoPatch(), envelope=envelope)  # type: ignore[arg-type]
    try:
        mock.gantry.home()
        begin = mock.gantry.move_to([-0.01, -0.01, -0.01], 0.05).position
        sent_before = len(mock.spy.moves())
        refused = False
        try:
            with mock.gantry.streaming() as stream:
                for position, speed, wait_s in pieces:
                    stream.order(np.array(position), speed)
                    mock.clock.sleep(wait_s)
                    stream.observe()
                if ending:
                    raise {"KeyboardInterrupt": KeyboardInterrupt, "ValueError": ValueError}[ending]
        except (EnvelopeError, GantryError, KeyboardInterrupt, ValueError):
            refused = True
        told = [begin]
        for line in mock.spy.moves()[sent_before:]:
            match = _TARGET.match(line)
            assert match is not None
            target = np.array([float(match[k]) for k in (1, 2, 3)]) / 1000.0
            envelope.check_point(target)
            told.append(target)
        for a, b in pairwise(told):
            envelope.check_path(a, b)
        now = mock.clock.now_ns()
        assert not mock.device.velocity_at(now).any()
        at = np.asarray(mock.device.position_at(now))
        mock.clock.sleep(1.0)
        np.testing.assert_array_equal(mock.device.position_at(mock.clock.now_ns()), at)
        state = mock.gantry.state()
        assert state.is_trusted
        if not refused:
            # Steps of 1/250 mm, and three decimals of a mm.
            np.testing.assert_allclose(at, told[-1], atol=4e-6)
    finally:
        mock.gantry.close()
        sim_bench._live.pop("mock", None)
