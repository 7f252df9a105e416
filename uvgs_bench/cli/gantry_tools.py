"""``uvgs gantry console`` and ``uvgs gantry settings``: the controller's own words, and its numbered settings."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from uvgs_bench.cli.gantry_door import Door, found, opened


def ask(door: Door) -> None:
    """Type the controller's own words and see its answers; an empty line or Ctrl-D ends it.

    Only words that move nothing are sent (? $$ $# $I $G $N and settings like $130=400): a move typed here could not be
    checked against the envelope. Use move and jog for those.
    """
    from uvgs_bench.cli.console import console, emit_json, out
    from uvgs_bench.errors import GantryRefused

    said: list[dict[str, object]] = []
    with found(door) as setup, opened(setup) as gantry:
        if sys.stdin.isatty():
            console.print(f"{gantry.info.firmware} {gantry.info.version}; words that move nothing, like $$ or ?")
        while line := _typed():
            try:
                answers = gantry.ask(line)
            except GantryRefused as refusal:
                answers = [str(refusal)]
            said.append({"line": line, "answers": answers})
            if not door.as_json:
                for answer in answers:
                    out.print(answer, markup=False, soft_wrap=True)
    if door.as_json:
        emit_json({"port": setup.spec, "conversation": said})


def _typed() -> str:
    if sys.stdin.isatty():
        sys.stderr.write("> ")
        sys.stderr.flush()
    return sys.stdin.readline().strip()


def settings(
    door: Door,
    changes: Annotated[
        list[str] | None, typer.Argument(metavar="[NUMBER=VALUE]...", help="Settings to change, like 130=400.")
    ] = None,
) -> None:
    """Show the controller's settings and what is unwise about them; change some, one at a time, and read them back."""
    from uvgs_bench.cli.console import emit_json, out
    from uvgs_bench.errors import ConfigError, GantryError

    wanted: dict[str, str] = {}
    for change in changes or []:
        number, equals, value = change.removeprefix("$").partition("=")
        if not (number.isdigit() and equals and value):
            raise ConfigError(f"expected NUMBER=VALUE, like 130=400, got {change!r}")
        wanted[number] = value
    with found(door) as setup, opened(setup) as gantry:
        for number, value in wanted.items():
            gantry.ask(f"${number}={value}")
        if wanted:
            read_back = gantry.reread().settings
            for number, value in wanted.items():
                if not _is_same(read_back.get(number, ""), value):
                    raise GantryError(f"${number} reads {read_back.get(number, 'nothing')} after {value} was written")
        info = gantry.info
    if door.as_json:
        emit_json(
            {
                "port": setup.spec,
                "firmware": info.firmware,
                "version": info.version,
                "options": info.options,
                "settings": info.settings,
                "parameters": info.parameters,
                "warnings": info.warnings,
            }
        )
        return
    out.print(f"{info.firmware} {info.version}, {info.options}", markup=False, soft_wrap=True)
    for name, value in [*((f"${n}", v) for n, v in info.settings.items()), *info.parameters.items()]:
        out.print(f"{name:<6} {value}", markup=False, soft_wrap=True)


def _is_same(read: str, written: str) -> bool:
    try:
        return abs(float(read) - float(written)) <= 0.0005 + 1e-6 * abs(float(written))
    except ValueError:
        return False
