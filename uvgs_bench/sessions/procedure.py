"""A procedure: where to go, how to arrive, what to take there, and what it must prove."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from uvgs_bench.accuracy.judgement import QUANTITIES, Limit
from uvgs_bench.errors import ConfigError
from uvgs_bench.sessions.patterns import PATTERNS, AxisValues, Pattern, pattern_class
from uvgs_bench.store.documents import SCHEMA_KEY, parse_document, read_toml
from uvgs_bench.units import mps_from_mm_min, radps_from_deg_min

SCHEMA = 1
# Captures of a station are held in memory until the carriage is known not to have moved meanwhile.
_MOST_REPEATS = 1000
_MOST_CAPTURES = 200

Origin = Literal["machine", "centre"]
Order = Literal["as_written", "serpentine", "shuffled"]
Approach = Literal["none", "from_below", "from_above"]
RegisterRule = Literal["every_third", "corners"]


@dataclass(frozen=True, slots=True)
class ApproachFile:
    """The ``[approach]`` table.

    Args:
        kind: ``none``; ``from_below``: every axis arrives moving upwards; ``from_above``: moving downwards.
        overshoot: How far beside the target the last move begins, by axis and unit; an axis left out takes 1 mm or
            1 deg, or twice its backlash if that is more.
    """

    kind: Approach = "none"
    overshoot: AxisValues = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ProcedureFile:
    """A procedure file without its pattern's table.

    Args:
        name: Name of the procedure; names the run folder.
        pattern: One of ``PATTERNS``; its table of the same name says where the waypoints are.
        feed_mm_min: Speed along the path.
        description: What it is for, for people.
        feed_deg_min: Speed of moves of rotary axes alone; as quick as the axis may when absent.
        settle_s: Wait between arrival and the first exposure.
        captures_per_station: Number of captures at each station.
        repeats: How often all waypoints are visited.
        origin: ``machine``: positions are machine positions; ``centre``: relative to the envelope's centre.
        order: ``as_written``; ``serpentine``: every second row backwards; ``shuffled``: anew for each repeat, by seed.
        register: Which waypoints fit the registration, the others judge it: ``every_third``, ``corners``, a fraction
            of them, or a list of their numbers.
        reference_every: Visit the first waypoint again after so many stations; 0 = never.
        seed: Seed of every random choice.
        approach: How the carriage arrives.
        limits: What must hold to pass: quantity = value.
    """

    name: str
    pattern: str
    feed_mm_min: float
    description: str = ""
    feed_deg_min: float | None = None
    settle_s: float = 0.2
    captures_per_station: int = 1
    repeats: int = 1
    origin: Origin = "machine"
    order: Order = "serpentine"
    register: RegisterRule | float | list[int] = "every_third"
    reference_every: int = 0
    seed: int = 0
    approach: ApproachFile = field(default_factory=ApproachFile)
    limits: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Procedure:
    """A procedure as the program uses it; positions wait in the pattern for the axes they are meant for.

    Args:
        name: Its name.
        pattern: The waypoints.
        feed_mps: Speed along the path, m/s.
        feed_radps: Speed of moves of rotary axes alone, rad/s, or None for the axis' largest.
        settle_s: Wait between arrival and the first exposure, s.
        captures_per_station: Number of captures at each station.
        repeats: How often all waypoints are visited.
        origin: What positions are relative to.
        order: Order of visits.
        register: Which waypoints fit the registration.
        reference_every: Visit the first waypoint again after so many stations; 0 = never.
        seed: Seed of every random choice.
        approach: How the carriage arrives.
        overshoot: How far beside the target the last move begins, by axis and unit, mm or deg.
        limits: What must hold to pass.
        description: What it is for.
        path: The file it was read from, for messages, or empty.

    Raises:
        ConfigError: A value that cannot be meant; the message names the key.
    """

    name: str
    pattern: Pattern
    feed_mps: float
    feed_radps: float | None = None
    settle_s: float = 0.2
    captures_per_station: int = 1
    repeats: int = 1
    origin: Origin = "machine"
    order: Order = "serpentine"
    register: RegisterRule | float | tuple[int, ...] = "every_third"
    reference_every: int = 0
    seed: int = 0
    approach: Approach = "none"
    overshoot: AxisValues = field(default_factory=dict)
    limits: tuple[Limit, ...] = ()
    description: str = ""
    path: str = ""

    def __post_init__(self) -> None:
        if not self.name or any(c in self.name for c in "/\\\0") or self.name.startswith("."):
            raise self.error(f"must be usable as a file name, got {self.name!r}", "name")
        for key, value in (("feed_mm_min", self.feed_mps), ("feed_deg_min", self.feed_radps)):
            if value is not None and not 0.0 < value < float("inf"):
                raise self.error("must be positive", key)
        if not 0.0 <= self.settle_s < float("inf"):
            raise self.error(f"must not be negative, got {self.settle_s}", "settle_s")
        if not 1 <= self.captures_per_station <= _MOST_CAPTURES:
            raise self.error(f"must be 1 to {_MOST_CAPTURES}, got {self.captures_per_station}", "captures_per_station")
        if not 1 <= self.repeats <= _MOST_REPEATS:
            raise self.error(f"must be 1 to {_MOST_REPEATS}, got {self.repeats}", "repeats")
        if self.reference_every < 0:
            raise self.error(f"must not be negative, got {self.reference_every}", "reference_every")
        if self.seed < 0:
            raise self.error(f"must not be negative, got {self.seed}", "seed")
        if isinstance(self.register, float) and not 0.0 < self.register < 1.0:
            raise self.error(f"as a fraction must lie between 0 and 1, got {self.register}", "register")

    def seeded(self, seed: int | None) -> Procedure:
        """The same procedure with another seed, or itself when there is none."""
        return self if seed is None else replace(self, seed=seed)

    def error(self, message: str, key: str = "") -> ConfigError:
        """A complaint about this procedure that names its file."""
        return ConfigError(message, self.path, key)


def read_procedure(path: Path) -> Procedure:
    """Read a procedure file.

    Args:
        path: The file.

    Returns:
        The procedure.

    Raises:
        ConfigError: Missing file, unknown or missing key, wrong unit, or a value that cannot be meant; the message
            names file and key.
    """
    tables = read_toml(path)
    if tables.pop(SCHEMA_KEY, None) != SCHEMA:
        raise ConfigError(f"missing or unknown, expected {SCHEMA}", str(path), SCHEMA_KEY)
    pattern_tables = {name: tables.pop(name) for name in PATTERNS if isinstance(tables.get(name), dict)}
    file = parse_document(tables, ProcedureFile, str(path))
    return Procedure(
        name=file.name,
        pattern=_pattern(file.pattern, pattern_tables, str(path)),
        feed_mps=mps_from_mm_min(file.feed_mm_min),
        feed_radps=None if file.feed_deg_min is None else radps_from_deg_min(file.feed_deg_min),
        settle_s=file.settle_s,
        captures_per_station=file.captures_per_station,
        repeats=file.repeats,
        origin=file.origin,
        order=file.order,
        register=tuple(file.register) if isinstance(file.register, list) else file.register,
        reference_every=file.reference_every,
        seed=file.seed,
        approach=file.approach.kind,
        overshoot=file.approach.overshoot,
        limits=_limits(file.limits, str(path)),
        description=file.description,
        path=str(path),
    )


def _pattern(name: str, tables: Mapping[str, object], path: str) -> Pattern:
    if name not in PATTERNS:
        near = difflib.get_close_matches(name, PATTERNS, n=1)
        hint = f", did you mean '{near[0]}'?" if near else f", expected one of {', '.join(PATTERNS)}"
        raise ConfigError(f"unknown pattern '{name}'{hint}", path, "pattern")
    strangers = [other for other in tables if other != name]
    if strangers:
        raise ConfigError(f"this table belongs to another pattern, the pattern here is '{name}'", path, strangers[0])
    if name not in tables:
        raise ConfigError("this table is required, it says where the waypoints are", path, name)
    return parse_document(tables[name], pattern_class(name), path, name)


def _limits(limits: Mapping[str, float], path: str) -> tuple[Limit, ...]:
    out = []
    for quantity, value in limits.items():
        key = f"limits.{quantity}"
        if quantity not in QUANTITIES:
            near = difflib.get_close_matches(quantity, QUANTITIES, n=1)
            hint = f", did you mean '{near[0]}'?" if near else f", expected one of {', '.join(QUANTITIES)}"
            raise ConfigError(f"unknown quantity{hint}", path, key)
        if not 0.0 <= value < float("inf"):
            raise ConfigError(f"must not be negative, got {value}", path, key)
        if quantity.endswith("_percent") and value > 100.0:
            raise ConfigError(f"must be at most 100, got {value}", path, key)
        out.append(Limit.of(quantity, value))
    return tuple(out)
