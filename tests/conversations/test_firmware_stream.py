"""A path told piece by piece to our firmware, at the pace of the wall clock."""

from __future__ import annotations

import numpy as np

from tests.helpers.firmware_board import FirmwareBuilds
from tests.helpers.grbl_ports import Spy, linear_axes
from tests.helpers.pin_bench import TerminalBoard
from uvgs_bench.devices.clock import RealClock
from uvgs_bench.devices.gantry import Envelope
from uvgs_bench.devices.gantry.grbl import GrblGantry

STEPS_PER_MM = 80
SWITCHES = (240, 320, 400)
SETTINGS = [
    "$22=1", "$20=1", "$1=255", "$10=3", "$26=5", "$24=300", "$25=1800", "$27=0.5", "$202=3000",
    *(f"${base + i}={value}" for base, value in ((100, STEPS_PER_MM), (110, 3000), (120, 200), (130, 30))
      for i in range(3)),
]  # fmt: skip


def test_an_arc_is_driven_without_a_stop(firmware_builds: FirmwareBuilds) -> None:
    switches = ",".join(str(steps) for steps in SWITCHES)
    with TerminalBoard([*firmware_builds.command("native"), "--switches", switches]) as board:
        board.set_up(SETTINGS)
        envelope = Envelope(linear_axes(0.03))
        with GrblGantry.open(board.port, envelope, clock=RealClock(), log=Spy()) as gantry:
            gantry.home()
            begin = gantry.move_to([-0.005, -0.005, -0.005], 0.04).position
            # A half circle of 16 mm in pieces of 0.5 mm; 20 mm/s need 50 mm/s^2, the axes have 200.
            angles = np.linspace(0.0, np.pi, 51)
            arc = begin + 0.008 * np.stack([np.cos(angles) - 1.0, -np.sin(angles), 0.0 * angles], axis=1)
            seen, numbers = [], []
            with gantry.recording() as kept, gantry.streaming() as stream:
                for k, target in enumerate(arc[1:]):
                    stream.order(target, 0.02)
                    if k > 8:
                        seen.append(stream.observe()[0])
                        numbers.append(len(kept) - 1)
            end = gantry.state()
        counted = board.table().motor_steps
    assert end.is_trusted
    # Half a step and three decimals of a millimetre.
    np.testing.assert_allclose(end.position, arc[-1], atol=8e-6)
    np.testing.assert_array_equal(counted, np.round(1e3 * end.position * STEPS_PER_MM) + np.array(SWITCHES))
    # On the circle all the way: chords of 0.5 mm lie 4 um inside, a report has whole steps of 12.5 um.
    centre = begin - np.array([0.008, 0.0, 0.0])
    radii = [np.linalg.norm(stamp.position - centre) for stamp in seen]
    assert len(radii) > 10
    np.testing.assert_allclose(radii, 0.008, atol=4e-5)
    # The controller's own time is at least as sure as the answers are, and within their doubt of it.
    for stamp, number in zip(seen, numbers, strict=True):
        np.testing.assert_array_equal(kept[number].position, stamp.position)
        assert abs(kept[number].t_ns - stamp.t_ns) <= kept[number].doubt_ns + stamp.doubt_ns + 10_000_000
    assert len({tuple(stamp.position) for stamp in seen}) > 5
