"""What every ``uvgs gantry`` command has in common: which gantry, how it is opened, how its state is printed.

Every command opens the port anew, and opening resets a controller: its position is unknown until it is homed.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Concatenate, ParamSpec

import typer

from uvgs_bench.cli.options import DEFAULT_BENCH, Json

if TYPE_CHECKING:
    from uvgs_bench.devices.bench import Bench
    from uvgs_bench.devices.clock import Clock
    from uvgs_bench.devices.gantry import Axis, Gantry, GantryState
    from uvgs_bench.devices.sim.bench import SimulatedBench
    from uvgs_bench.geometry import FloatArray

_Own = ParamSpec("_Own")

_COMMON = {
    "bench": (
        Annotated[Path, typer.Option("--bench", help="Bench file with the gantry's port and axes.")],
        DEFAULT_BENCH,
    ),
    "port": (
        Annotated[str | None, typer.Option("--port", help="Gantry in place of the bench's, like grbl:/dev/ttyACM0.")],
        None,
    ),
    "sim_speed": (
        Annotated[float, typer.Option("--sim-speed", min=0.1, help="Speed of the simulated gantry.")],
        10.0,
    ),
    "as_json": (Json, False),
}


@dataclass(frozen=True, slots=True)
class Door:
    """The options every command has.

    Args:
        bench: Bench file.
        port: Spec of the gantry in place of the bench's, or None.
        sim_speed: Speed of a simulated gantry.
        as_json: Whether to print one JSON object.
    """

    bench: Path
    port: str | None
    sim_speed: float
    as_json: bool


def with_door(command: Callable[Concatenate[Door, _Own], None]) -> Callable[..., None]:
    """Give a command the common options, handed to it as its first argument."""
    parameters = list(inspect.signature(command, eval_str=True).parameters.values())[1:]
    own = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in parameters]
    common = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
        for name, (annotation, default) in _COMMON.items()
    ]

    def opened_by_name(**given: Any) -> None:
        door = Door(**{name: given.pop(name) for name in _COMMON})
        command(door, **given)  # type: ignore[call-arg]

    opened_by_name.__name__ = command.__name__
    opened_by_name.__doc__ = command.__doc__
    opened_by_name.__annotations__ = {}
    opened_by_name.__signature__ = inspect.Signature([*own, *common])  # type: ignore[attr-defined]
    return opened_by_name


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """What a door leads to.

    Args:
        bench: The bench.
        spec: The gantry to open.
        clock: Its time.
        twin: The simulated bench, or None.
    """

    bench: Bench
    spec: str
    clock: Clock
    twin: SimulatedBench | None = None


@contextmanager
def found(door: Door) -> Iterator[Setup]:
    """The bench and the spec to open; a simulated gantry lives as long as this."""
    from uvgs_bench.devices.clock import RealClock
    from uvgs_bench.devices.gantry.registry import spec_on_bench
    from uvgs_bench.store.bench import read_bench

    bench = read_bench(door.bench)
    if door.port is not None:
        bench = replace(bench, gantry_port=door.port)
    if spec_on_bench(bench.gantry_port, "") is None:
        yield Setup(bench, bench.gantry_port, RealClock())
        return
    from uvgs_bench.devices.sim.bench import start_simulated_bench
    from uvgs_bench.store.beacons import read_beacon

    twin = start_simulated_bench(bench, read_beacon(Path(bench.beacon_file)), speed=door.sim_speed)
    try:
        yield Setup(bench, spec_on_bench(bench.gantry_port, twin.name) or twin.gantry_spec, twin.clock, twin)
    finally:
        twin.close()


@contextmanager
def opened(setup: Setup) -> Iterator[Gantry]:
    """The open gantry; Ctrl-C, SIGTERM and any failure stop its motion before the port is left."""
    from uvgs_bench.cli.console import console
    from uvgs_bench.devices.gantry import open_gantry
    from uvgs_bench.sessions.interruption import interruptible

    is_open = False
    try:
        with ExitStack() as stack:
            stack.enter_context(interruptible())
            bench = setup.bench
            gantry = stack.enter_context(
                open_gantry(
                    setup.spec,
                    bench.envelope,
                    clock=setup.clock,
                    log=no_log,
                    homing_timeout_s=bench.homing_timeout_s,
                )
            )
            is_open = True
            for warning in gantry.info.warnings:
                console.print(f"warning: {warning}", style="yellow", soft_wrap=True, markup=False)
            yield gantry
    except KeyboardInterrupt:
        if is_open:
            # Leaving the gantry's context stopped the motion.
            console.print("the gantry was stopped: home before the next move")
        raise


def no_log(_t_ns: int, _direction: str, _text: str) -> None:
    """A wire log that keeps nothing."""


def print_state(gantry: Gantry, state: GantryState, as_json: bool) -> None:
    """Say who answered, what it is doing and where it stands."""
    from uvgs_bench.cli.console import emit_json, out

    info, positions = gantry.info, in_file_units(gantry.axes, state.position)
    if as_json:
        emit_json(
            {
                "port": gantry.port,
                "firmware": info.firmware,
                "version": info.version,
                "activity": state.activity,
                "is_homed": state.is_homed,
                "is_trusted": state.is_trusted,
                "position": positions,
                "details": state.details,
                "settings": info.settings,
                "warnings": info.warnings,
            }
        )
        return
    homed = "homed" if state.is_homed else "not homed, so the position means nothing"
    out.print(f"controller   {info.firmware} {info.version} on {gantry.port}", soft_wrap=True)
    out.print(f"state        {state.activity}, {homed}", soft_wrap=True)
    for axis, value in zip(gantry.axes, state.position, strict=True):
        out.print(f"{axis.name:<12} {axis.described(float(value))}")


def in_file_units(axes: Sequence[Axis], position: FloatArray) -> dict[str, float]:
    """Axis positions by name and unit: ``{"X_mm": -10.0}``."""
    from uvgs_bench.units import deg_from_rad, mm_from_m

    return {
        f"{axis.name}_mm" if axis.kind == "linear" else f"{axis.name}_deg": round(
            mm_from_m(float(value)) if axis.kind == "linear" else deg_from_rad(float(value)), 6
        )
        for axis, value in zip(axes, position, strict=True)
    }
