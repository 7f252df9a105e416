"""``uvgs gantry``: ask the gantry where it is, home it, move it, stop it.

Every command opens the port anew, and opening resets a controller: its position is unknown until it is homed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.options import DEFAULT_BENCH, Json

if TYPE_CHECKING:
    from uvgs_bench.devices.bench import Bench
    from uvgs_bench.devices.clock import Clock
    from uvgs_bench.devices.gantry import Axis, Gantry, GantryState
    from uvgs_bench.geometry import FloatArray

app = typer.Typer(
    help="Ask the gantry where it is, home it, move it, stop it. Opening a port resets a controller, so its position "
    "is unknown until it is homed.",
    no_args_is_help=True,
)

_BenchPath = Annotated[Path, typer.Option("--bench", help="Bench file with the gantry's port and axes.")]
_Port = Annotated[str | None, typer.Option("--port", help="Gantry in place of the bench's, like grbl:/dev/ttyACM0.")]
_Home = Annotated[bool, typer.Option("--home", help="Home first; without it the position is unknown.")]
_Speed = Annotated[
    float | None,
    typer.Option("--speed-mm-min", min=0.001, help="Feed along the path.  [default: as fast as every axis may go]"),
]
_SimSpeed = Annotated[float, typer.Option("--sim-speed", min=0.1, help="Speed of the simulated gantry.")]
_Words = Annotated[list[str], typer.Argument(metavar="AXIS=VALUE...", help="Like X=-10 Y=-5.5: mm, or deg if rotary.")]


@app.command()
def status(
    bench: _BenchPath = DEFAULT_BENCH, port: _Port = None, sim_speed: _SimSpeed = 10.0, as_json: Json = False
) -> None:
    """Say which controller answers and what it reports. Opening the port resets it."""
    with _opened(bench, port, sim_speed) as gantry:
        _print_state(gantry, gantry.state(), as_json)


@app.command()
def home(
    bench: _BenchPath = DEFAULT_BENCH, port: _Port = None, sim_speed: _SimSpeed = 10.0, as_json: Json = False
) -> None:
    """Run the homing cycle. Ctrl-C stops it."""
    with _opened(bench, port, sim_speed) as gantry:
        _print_state(gantry, _home(gantry), as_json)


@app.command()
def move(
    words: _Words,
    home_first: _Home = False,
    speed_mm_min: _Speed = None,
    bench: _BenchPath = DEFAULT_BENCH,
    port: _Port = None,
    sim_speed: _SimSpeed = 10.0,
    as_json: Json = False,
) -> None:
    """Home, then move in a straight line to machine positions; axes not named stay. Ctrl-C stops the motion first."""
    _travel(words, bench, port, sim_speed, speed_mm_min, as_json, is_homed_first=home_first, is_offset=False)


@app.command()
def jog(
    words: _Words,
    home_first: _Home = False,
    speed_mm_min: _Speed = None,
    bench: _BenchPath = DEFAULT_BENCH,
    port: _Port = None,
    sim_speed: _SimSpeed = 10.0,
    as_json: Json = False,
) -> None:
    """Home, then move by offsets. Ctrl-C stops the motion first."""
    _travel(words, bench, port, sim_speed, speed_mm_min, as_json, is_homed_first=home_first, is_offset=True)


@app.command()
def stop(
    bench: _BenchPath = DEFAULT_BENCH, port: _Port = None, sim_speed: _SimSpeed = 10.0, as_json: Json = False
) -> None:
    """Stop whatever moves, at once and before anything else is asked. The position is lost."""
    from uvgs_bench.cli.console import emit_json, out
    from uvgs_bench.devices.gantry.registry import halt_gantry

    with _spec_and_clock(bench, port, sim_speed) as (_, spec, clock):
        has_answered = halt_gantry(spec, clock=clock, log=_no_log)
    if as_json:
        emit_json({"port": spec, "stop_sent": True, "controller_answered": has_answered})
    elif has_answered:
        out.print(f"{spec}: stopped and reset; home before the next move", soft_wrap=True)
    else:
        out.print(f"{spec}: stop and reset were sent, but nothing answered: look at the machine", soft_wrap=True)
    if not has_answered:
        from uvgs_bench.errors import ExitCode

        raise typer.Exit(int(ExitCode.HARDWARE))


def _travel(
    words: Sequence[str],
    bench: Path,
    port: str | None,
    sim_speed: float,
    speed_mm_min: float | None,
    as_json: bool,
    *,
    is_homed_first: bool,
    is_offset: bool,
) -> None:
    from uvgs_bench.errors import ConfigError
    from uvgs_bench.store.bench import read_bench
    from uvgs_bench.units import mps_from_mm_min

    axes = read_bench(bench).envelope.axes
    values = _read_words(words, axes)
    if not is_homed_first:
        raise ConfigError("opening the port resets the controller, so its position is unknown: add --home")
    if not is_offset:
        _check_named(axes, values)
    speed = min(axes[i].max_speed for i in values) if speed_mm_min is None else mps_from_mm_min(speed_mm_min)
    with _opened(bench, port, sim_speed) as gantry:
        target = _home(gantry).position.copy()
        for i, value in values.items():
            target[i] = target[i] + value if is_offset else value
        _print_state(gantry, gantry.move_to(target, speed), as_json)


def _read_words(words: Sequence[str], axes: Sequence[Axis]) -> dict[int, float]:
    """Values in m or rad by the index of their axis. Raises ConfigError."""
    from math import isfinite

    from uvgs_bench.errors import ConfigError
    from uvgs_bench.units import m_from_mm, rad_from_deg

    indices = {axis.name.upper(): i for i, axis in enumerate(axes)}
    values: dict[int, float] = {}
    for word in words:
        name, _, text = word.partition("=")
        index = indices.get(name.upper())
        if index is None:
            raise ConfigError(f"expected {' '.join(f'{axis}=VALUE' for axis in indices)}, got {word!r}")
        if index in values:
            raise ConfigError(f"axis {name.upper()} is given twice")
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not isfinite(value):
            raise ConfigError(f"{word!r}: the value must be a number, like {name}=-10.5")
        values[index] = m_from_mm(value) if axes[index].kind == "linear" else rad_from_deg(value)
    return values


def _check_named(axes: Sequence[Axis], values: dict[int, float]) -> None:
    """Refuse a target outside an axis' bounds before the port is opened, which would reset the controller."""
    from uvgs_bench.devices.gantry import Envelope

    for i, value in values.items():
        Envelope((axes[i],)).check_point([value])


def _home(gantry: Gantry) -> GantryState:
    from uvgs_bench.cli.console import console

    console.print(f"homing {gantry.port} ...", soft_wrap=True)
    return gantry.home()


@contextmanager
def _opened(bench: Path, port: str | None, sim_speed: float) -> Iterator[Gantry]:
    from uvgs_bench.devices.gantry import open_gantry

    is_open = False
    try:
        with (
            _spec_and_clock(bench, port, sim_speed) as (setup, spec, clock),
            open_gantry(
                spec, setup.envelope, clock=clock, log=_no_log, homing_timeout_s=setup.homing_timeout_s
            ) as gantry,
        ):
            is_open = True
            yield gantry
    except KeyboardInterrupt:
        if is_open:
            from uvgs_bench.cli.console import console

            # Leaving the gantry's context stopped the motion.
            console.print("the gantry was stopped: home before the next move")
        raise


@contextmanager
def _spec_and_clock(bench: Path, port: str | None, sim_speed: float) -> Iterator[tuple[Bench, str, Clock]]:
    """The bench, the spec to open, and its time; a simulated gantry lives as long as this."""
    from uvgs_bench.devices.clock import RealClock
    from uvgs_bench.store.bench import read_bench

    setup = read_bench(bench)
    if port is not None:
        setup = replace(setup, gantry_port=port)
    if setup.gantry_port != "grbl:sim://":
        yield setup, setup.gantry_port, RealClock()
        return
    from uvgs_bench.devices.sim.bench import start_simulated_bench
    from uvgs_bench.store.beacons import read_beacon

    simulated = start_simulated_bench(setup, read_beacon(Path(setup.beacon_file)), speed=sim_speed)
    try:
        yield setup, simulated.gantry_spec, simulated.clock
    finally:
        simulated.close()


def _no_log(_t_ns: int, _direction: str, _text: str) -> None:
    pass


def _print_state(gantry: Gantry, state: GantryState, as_json: bool) -> None:
    from uvgs_bench.cli.console import emit_json, out

    info, positions = gantry.info, _in_file_units(gantry.axes, state.position)
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
            }
        )
        return
    homed = "homed" if state.is_homed else "not homed, so the position means nothing"
    out.print(f"controller   {info.firmware} {info.version} on {gantry.port}", soft_wrap=True)
    out.print(f"state        {state.activity}, {homed}", soft_wrap=True)
    for axis, value in zip(gantry.axes, state.position, strict=True):
        out.print(f"{axis.name:<12} {axis.described(float(value))}")


def _in_file_units(axes: Sequence[Axis], position: FloatArray) -> dict[str, float]:
    from uvgs_bench.units import deg_from_rad, mm_from_m

    return {
        f"{axis.name}_mm" if axis.kind == "linear" else f"{axis.name}_deg": round(
            mm_from_m(float(value)) if axis.kind == "linear" else deg_from_rad(float(value)), 6
        )
        for axis, value in zip(axes, position, strict=True)
    }
