"""``uvgs gantry``: ask the gantry where it is, home it, move it, stop it; and what else can be asked of it.

Every command opens the port anew, and opening resets a controller: its position is unknown until it is homed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.gantry_characterise import characterise
from uvgs_bench.cli.gantry_door import Door, found, no_log, opened, print_state, with_door
from uvgs_bench.cli.gantry_tools import ask, settings
from uvgs_bench.cli.options import Force

if TYPE_CHECKING:
    from uvgs_bench.devices.gantry import Axis, Gantry, GantryState

app = typer.Typer(
    help="Ask the gantry where it is, home it, move it, stop it. Opening a port resets a controller, so its position "
    "is unknown until it is homed.",
    no_args_is_help=True,
)
app.command("console")(with_door(ask))
app.command()(with_door(settings))
app.command()(with_door(characterise))

_Home = Annotated[bool, typer.Option("--home", help="Home first; without it the position is unknown.")]
_Speed = Annotated[
    float | None,
    typer.Option("--speed-mm-min", min=0.001, help="Feed along the path.  [default: as fast as every axis may go]"),
]
_Record = Annotated[
    Path | None,
    typer.Option("--record", help="CSV of the positions reported on the way, with their times; also of a broken move."),
]
_Words = Annotated[list[str], typer.Argument(metavar="AXIS=VALUE...", help="Like X=-10 Y=-5.5: mm, or deg if rotary.")]


@app.command()
@with_door
def status(door: Door) -> None:
    """Say which controller answers and what it reports. Opening the port resets it."""
    with found(door) as setup, opened(setup) as gantry:
        print_state(gantry, gantry.state(), door.as_json)


@app.command()
@with_door
def home(door: Door) -> None:
    """Home all axes ($H; there is no homing of one axis alone). Ctrl-C stops it."""
    with found(door) as setup, opened(setup) as gantry:
        print_state(gantry, _home(gantry), door.as_json)


@app.command()
@with_door
def move(
    door: Door,
    words: _Words,
    home_first: _Home = False,
    speed_mm_min: _Speed = None,
    record: _Record = None,
    force: Force = False,
) -> None:
    """Home, then move in a straight line to machine positions; axes not named stay. Ctrl-C stops the motion first."""
    _travel(door, words, speed_mm_min, _Track(record, force), is_homed_first=home_first, is_offset=False)


@app.command()
@with_door
def jog(
    door: Door,
    words: _Words,
    home_first: _Home = False,
    speed_mm_min: _Speed = None,
    record: _Record = None,
    force: Force = False,
) -> None:
    """Home, then move by offsets. Ctrl-C stops the motion first."""
    _travel(door, words, speed_mm_min, _Track(record, force), is_homed_first=home_first, is_offset=True)


@app.command()
@with_door
def stop(door: Door) -> None:
    """Stop whatever moves, at once and before anything else is asked. The position is lost."""
    from uvgs_bench.cli.console import emit_json, out
    from uvgs_bench.devices.gantry.registry import halt_gantry

    with found(door) as setup:
        spec = setup.spec
        has_answered = halt_gantry(spec, clock=setup.clock, log=no_log)
    if door.as_json:
        emit_json({"port": spec, "stop_sent": True, "controller_answered": has_answered})
    elif has_answered:
        out.print(f"{spec}: stopped and reset; home before the next move", soft_wrap=True)
    else:
        out.print(f"{spec}: stop and reset were sent, but nothing answered: look at the machine", soft_wrap=True)
    if not has_answered:
        from uvgs_bench.errors import ExitCode

        raise typer.Exit(int(ExitCode.HARDWARE))


@dataclass(frozen=True, slots=True)
class _Track:
    """Where the positions on the way are written; nowhere when there is no file."""

    file: Path | None
    force: bool

    def check(self) -> None:
        """Refuse a file that may not be replaced, before anything moves."""
        if self.file is not None and self.file.exists() and not self.force:
            from uvgs_bench.errors import ConfigError

            raise ConfigError("exists already; use --force to replace it", str(self.file))

    @contextmanager
    def kept(self, gantry: Gantry) -> Iterator[None]:
        """Write what the gantry reported within this, also when the move failed: the gantry is at rest by then."""
        if self.file is None:
            yield
            return
        from uvgs_bench.store.gantry_records import write_positions

        with gantry.recording() as positions:
            try:
                yield
            except BaseException:
                gantry.close()
                raise
            finally:
                write_positions(self.file, gantry.axes, positions, force=self.force)


def _travel(
    door: Door,
    words: Sequence[str],
    speed_mm_min: float | None,
    track: _Track,
    *,
    is_homed_first: bool,
    is_offset: bool,
) -> None:
    from uvgs_bench.errors import ConfigError
    from uvgs_bench.store.bench import read_bench
    from uvgs_bench.units import mps_from_mm_min

    axes = read_bench(door.bench).envelope.axes
    values = _read_words(words, axes)
    if not is_homed_first:
        raise ConfigError("opening the port resets the controller, so its position is unknown: add --home")
    if not is_offset:
        _check_named(axes, values)
    track.check()
    speed = min(axes[i].max_speed for i in values) if speed_mm_min is None else mps_from_mm_min(speed_mm_min)
    with found(door) as setup, opened(setup) as gantry:
        target = _home(gantry).position.copy()
        for i, value in values.items():
            target[i] = target[i] + value if is_offset else value
        with track.kept(gantry):
            reached = gantry.move_to(target, speed)
        print_state(gantry, reached, door.as_json)


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
