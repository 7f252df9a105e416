"""The gantry behind the page of ``uvgs run --view --allow-motion``."""

from __future__ import annotations

from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from uvgs_bench.cli.gantry_door import Setup
    from uvgs_bench.devices.clock import Clock
    from uvgs_bench.devices.gantry import Gantry
    from uvgs_bench.sessions.jog_desk import JogDesk
    from uvgs_bench.view.live_state import GantryShown


def found_gantry(bench: Path, stack: ExitStack) -> Setup:
    """The gantry of a bench file; a simulated one lives as long as the stack.

    Raises:
        ConfigError: The file is broken or missing.
    """
    from uvgs_bench.cli.gantry_door import Door, found

    return stack.enter_context(found(Door(bench, None, 1.0, as_json=False)))


def open_desk(setup: Setup, stack: ExitStack) -> JogDesk:
    """Open the gantry; leaving the stack stops it first.

    Raises:
        GantryError: Nothing answers.
    """
    from uvgs_bench.cli.gantry_door import no_log
    from uvgs_bench.devices.gantry import open_gantry
    from uvgs_bench.sessions.jog_desk import JogDesk

    def opening(clock: Clock) -> AbstractContextManager[Gantry]:
        bench = setup.bench
        return open_gantry(setup.spec, bench.envelope, clock=clock, log=no_log, homing_timeout_s=bench.homing_timeout_s)

    desk = JogDesk(opening, setup.clock)
    stack.callback(desk.close)
    return desk


def shown_gantry(desk: JogDesk) -> GantryShown:
    """The gantry, as panels and pages show it."""
    from uvgs_bench.view.live_state import GantryShown

    state = desk.state
    is_homed = state is not None and state.is_homed
    if desk.is_moving:
        # What was true before the motion is true no more.
        return GantryShown("moving", is_homed, tuple((name, "moving") for name, _ in desk.axes), desk.said)
    positions = desk.positions if is_homed else tuple((name, "unknown") for name, _ in desk.axes)
    return GantryShown("unknown" if state is None else state.activity, is_homed, positions, desk.said)
