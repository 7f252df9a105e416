"""Gantry drivers by the scheme of their spec: ``grbl:/dev/ttyACM0``, ``grbl:sim://``, ``grbl:spy:///dev/ttyACM0``.

``grbl:fault+ADDRESS?drop=0.001&seed=7`` puts a bad line before any of them, see ``faulty_port``.
"""

from __future__ import annotations

import re
from difflib import get_close_matches
from importlib import import_module
from typing import Any, cast

from uvgs_bench.devices.clock import Clock
from uvgs_bench.devices.gantry.axes import Envelope
from uvgs_bench.devices.gantry.gantry import Gantry, WireLog
from uvgs_bench.errors import ConfigError

GANTRIES = {"grbl": "uvgs_bench.devices.gantry.grbl:GrblGantry"}
"""Scheme to ``module:Class``. The class has ``open`` and ``halt`` with the arguments of the functions below."""

_SIMULATED = re.compile(r"^(?P<scheme>grbl:(?:fault\+)?sim:)(?P<rest>.*)$")
_UNNAMED = re.compile(r"^(?://)?(?P<query>\?.*)?$")


def is_simulated(spec: str) -> bool:
    """Whether a spec means a simulated gantry, a live one by its name or that of the bench file."""
    return _SIMULATED.match(spec) is not None


def spec_on_bench(spec: str, bench_name: str) -> str | None:
    """The spec of the simulated gantry on a live bench, in place of one that names no bench.

    Args:
        spec: ``grbl:sim://``, or the same behind faults: ``grbl:fault+sim://?drop=0.001``.
        bench_name: Name of the live bench.

    Returns:
        The spec with the name, or None when it means something else.
    """
    found = _SIMULATED.match(spec)
    unnamed = None if found is None else _UNNAMED.match(found["rest"])
    if found is None or unnamed is None or (unnamed["query"] and "fault+" not in found["scheme"]):
        return None
    return f"{found['scheme']}//{bench_name}{unnamed['query'] or ''}"


def open_gantry(
    spec: str, envelope: Envelope, *, clock: Clock, log: WireLog, homing_timeout_s: float = 120.0
) -> Gantry:
    """Open a gantry. A controller resets when its port is opened, so it is unhomed afterwards.

    Args:
        spec: ``scheme:port``.
        envelope: What may be reached.
        clock: Bench time.
        log: Called for everything on the wire.
        homing_timeout_s: Longest time a homing cycle may take, s.

    Returns:
        The open gantry, at rest.

    Raises:
        ConfigError: The scheme is unknown or the port is missing.
        GantryError: The port cannot be opened or what answers is no usable controller.
        GantryTimeout: Nothing answers.
    """
    driver, address = _resolve(spec)
    return cast(Gantry, driver.open(address, envelope, clock=clock, log=log, homing_timeout_s=homing_timeout_s))


def halt_gantry(spec: str, *, clock: Clock, log: WireLog) -> bool:
    """Stop whatever moves behind a spec, before anything else is asked; the position is lost.

    Args:
        spec: ``scheme:port``.
        clock: Bench time.
        log: Called for everything on the wire.

    Returns:
        Whether a controller answered.

    Raises:
        ConfigError: The scheme is unknown or the port is missing.
        GantryError: The port cannot be opened or vanished.
    """
    driver, address = _resolve(spec)
    return cast(bool, driver.halt(address, clock=clock, log=log))


def _resolve(spec: str) -> tuple[Any, str]:
    scheme, _, address = spec.partition(":")
    if scheme not in GANTRIES or not address:
        near = get_close_matches(scheme, GANTRIES, n=1)
        hint = f"; did you mean {near[0]}:?" if near and near[0] != scheme else ""
        known = ", ".join(f"{name}:PORT" for name in GANTRIES)
        raise ConfigError(f"gantry spec {spec!r} is not one of {known}{hint}")
    module, _, name = GANTRIES[scheme].partition(":")
    return getattr(import_module(module), name), address
