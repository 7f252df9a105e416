"""The gantry moved by hand, on the simulated controller: nothing moves unhomed or outside, and a stop stops."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from uvgs_bench.devices.gantry import open_gantry
from uvgs_bench.devices.sim.bench import start_simulated_bench
from uvgs_bench.errors import GantryError
from uvgs_bench.sessions.jog_desk import MOST_M, JogDesk
from uvgs_bench.store.beacons import read_beacon
from uvgs_bench.store.bench import read_bench

CALIB = Path(__file__).parents[3] / "calib"


def wait_until(is_true: Callable[[], bool]) -> None:
    ends_s = time.monotonic() + 60.0
    while not is_true():
        assert time.monotonic() < ends_s
        time.sleep(0.01)


def log(_t_ns, _direction, _text):
    pass


@pytest.fixture
def twin():
    bench = read_bench(CALIB / "bench.toml")
    # Twenty times as fast: homing takes half a second, a jog of 50 mm an eighth.
    made = start_simulated_bench(bench, read_beacon(CALIB / "beacons" / "tetra_small.toml"), speed=20.0)
    yield made
    made.close()


@pytest.fixture
def desk(twin):
    bench = read_bench(CALIB / "bench.toml")
    made = JogDesk(
        lambda clock: open_gantry(twin.gantry_spec, bench.envelope, clock=clock, log=log, homing_timeout_s=120.0),
        twin.clock,
    )
    yield made
    made.close()


def home(desk: JogDesk) -> None:
    assert desk.home() is None
    wait_until(lambda: desk.said == "homing: done")
    wait_until(lambda: desk.state is not None and desk.state.is_homed)


def motors(twin) -> list[float]:
    return [round(float(value), 6) for value in twin.true_axis_position(twin.clock.now_ns())]


def test_nothing_moves_before_it_is_homed(twin, desk):
    before = motors(twin)
    assert "home first" in desk.jog("X", -0.001)
    time.sleep(0.1)
    assert motors(twin) == before
    assert desk.axes == (("X", "m"), ("Y", "m"), ("Z", "m"))


def test_home_jog_refuse_and_stop(twin, desk):
    home(desk)
    start = motors(twin)
    assert desk.jog("X", -0.01) is None
    wait_until(lambda: desk.said == "jogging X by -10.000 mm: done")
    # The controller counts steps of 0.01 mm.
    assert motors(twin)[0] == pytest.approx(start[0] - 0.01, abs=1e-5)
    wait_until(lambda: desk.positions[0] == ("X", "-11.000 mm"))

    here = motors(twin)
    assert desk.jog("X", 0.05) is None
    wait_until(lambda: desk.said.startswith("refused: axis X"))
    for axis, offset in (("X", 1.01 * MOST_M), ("X", 0.0), ("Q", 0.001), ("X", float("nan"))):
        assert isinstance(desk.jog(axis, offset), str)
    assert motors(twin) == here

    assert desk.jog("X", -MOST_M) is None
    wait_until(lambda: motors(twin)[0] < here[0] - 0.005)
    assert desk.jog("Y", -0.001) == "the gantry is still moving"
    assert desk.stop() is None
    wait_until(lambda: desk.said == "jogging X by -50.000 mm: stopped")
    there = motors(twin)
    assert here[0] - MOST_M + 0.001 < there[0] < here[0]
    time.sleep(0.2)
    assert motors(twin) == there
    # A controlled stop keeps the position, so that the next jog is measured from there.
    wait_until(lambda: desk.state.is_homed and not desk.is_moving)
    assert desk.jog("X", -0.001) is None
    wait_until(lambda: desk.said == "jogging X by -1.000 mm: done")
    assert motors(twin)[0] == pytest.approx(there[0] - 0.001, abs=2e-5)


@pytest.mark.parametrize("is_homing", [False, True])
def test_leaving_stops_what_moves(twin, desk, is_homing):
    if is_homing:
        assert desk.home() is None
    else:
        home(desk)
        assert desk.jog("X", -MOST_M) is None
    wait_until(lambda: desk.is_moving)
    time.sleep(0.03)
    desk.close()
    there = motors(twin)
    time.sleep(0.2)
    assert motors(twin) == there
    assert isinstance(desk.jog("X", -0.001), str)
    assert isinstance(desk.home(), str)


def test_a_stop_while_nothing_moves_spoils_nothing(twin, desk):
    assert desk.stop() is None
    home(desk)
    assert desk.stop() is None
    assert desk.jog("Z", -0.002) is None
    wait_until(lambda: desk.said == "jogging Z by -2.000 mm: done")


def test_a_gantry_that_cannot_be_opened_is_said_at_once(twin):
    def opening(clock):
        raise GantryError("nothing answers", "grbl:nowhere")

    with pytest.raises(GantryError, match="nothing answers"):
        JogDesk(opening, twin.clock)
