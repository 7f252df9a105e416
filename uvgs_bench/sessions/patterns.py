"""Patterns of waypoints: what a table of a procedure file means in machine positions.

To add a pattern: 1. write a frozen dataclass whose fields are the keys of its table, with the method ``points`` of
``Pattern``; 2. add one line to ``PATTERNS``; 3. the contract tests of ``tests/laws`` then run over it.

Contract: ``points`` gives finite positions in the order they are written, one row per waypoint, the same for the same
generator state; it draws from the generator only if the pattern is random; it does not check the envelope.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol, cast

import numpy as np

from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import m_from_mm, rad_from_deg

_MOST_PLACES = 100_000

PATTERNS: dict[str, str] = {
    "waypoints": "uvgs_bench.sessions.patterns:Waypoints",
    "line": "uvgs_bench.sessions.patterns:Line",
    "grid": "uvgs_bench.sessions.patterns:Grid",
    "square": "uvgs_bench.sessions.patterns:Square",
    "ladder": "uvgs_bench.sessions.patterns:Ladder",
    "random": "uvgs_bench.sessions.patterns:RandomVolume",
    "trajectory": "uvgs_bench.sessions.pattern_trajectory:TrajectoryPattern",
}
"""Name of the pattern and of its table -> class."""

AxisValues = dict[str, float]
"""A position as people write it: ``{ X_mm = -10.0, A_deg = 5.0 }``."""


class Pattern(Protocol):
    """One kind of waypoint pattern."""

    def points(self, axes: Sequence[Axis], rng: np.random.Generator) -> FloatArray:
        """Machine positions relative to the procedure's origin.

        Args:
            axes: The axes in the controller's order.
            rng: Generator, used by random patterns only.

        Returns:
            Positions, shape (..., A), m or rad; a leading shape of more than one number names rows for a serpentine.

        Raises:
            ConfigError: A position names an unknown axis or unit, lacks an axis, or a count is too small.
        """
        ...


def pattern_class(name: str) -> type[Pattern]:
    """The class of a pattern.

    Args:
        name: One of ``PATTERNS``.

    Returns:
        Its dataclass.
    """
    module, attribute = PATTERNS[name].split(":")
    return cast("type[Pattern]", getattr(importlib.import_module(module), attribute))


def position_key(axis: Axis) -> str:
    """How a position on this axis is called in a procedure file: ``X_mm`` or ``A_deg``."""
    return f"{axis.name}_{'mm' if axis.kind == 'linear' else 'deg'}"


def si_from_file(axis: Axis, value: float) -> float:
    """A position of a procedure file in m or rad."""
    return m_from_mm(value) if axis.kind == "linear" else rad_from_deg(value)


def axis_vector(values: AxisValues, axes: Sequence[Axis], key: str, default: float | None = None) -> FloatArray:
    """A position of a procedure file as an array.

    Args:
        values: Values by ``position_key``.
        axes: The axes in the controller's order.
        key: Dotted key in the file, for messages.
        default: Value of an axis that is left out, mm or deg; None when every axis must be named.

    Returns:
        Positions, shape (A,), m or rad.

    Raises:
        ConfigError: An unknown axis or unit, a value that is not finite, or an axis that is left out.
    """
    names = [position_key(axis) for axis in axes]
    for name, value in values.items():
        if name not in names:
            raise ConfigError(f"unknown axis or unit, this bench has {', '.join(names)}", key=f"{key}.{name}")
        if not np.isfinite(value):
            raise ConfigError(f"must be finite, got {value}", key=f"{key}.{name}")
    out = np.empty(len(axes))
    for i, (axis, name) in enumerate(zip(axes, names, strict=True)):
        given = values.get(name, default)
        if given is None:
            raise ConfigError("this axis is required", key=f"{key}.{name}")
        out[i] = si_from_file(axis, given)
    return out


def _check_count(count: int, least: int, key: str) -> None:
    if not least <= count <= _MOST_PLACES:
        raise ConfigError(f"must be {least} to {_MOST_PLACES}, got {count}", key=key)


@dataclass(frozen=True, slots=True)
class Waypoints:
    """Places named one by one.

    Args:
        at: Positions by axis and unit.
    """

    at: list[AxisValues]

    def points(self, axes: Sequence[Axis], rng: np.random.Generator) -> FloatArray:
        """See ``Pattern``."""
        _check_count(len(self.at), 1, "waypoints.at")
        return np.array([axis_vector(values, axes, f"waypoints.at.{i}") for i, values in enumerate(self.at)])


@dataclass(frozen=True, slots=True)
class Line:
    """Evenly spaced places on a straight line, both ends included.

    Args:
        start: First place.
        end: Last place.
        count: Number of places.
    """

    start: AxisValues
    end: AxisValues
    count: int

    def points(self, axes: Sequence[Axis], rng: np.random.Generator) -> FloatArray:
        """See ``Pattern``."""
        _check_count(self.count, 2, "line.count")
        start, end = axis_vector(self.start, axes, "line.start"), axis_vector(self.end, axes, "line.end")
        return np.linspace(start, end, self.count)


@dataclass(frozen=True, slots=True)
class Grid:
    """A box of evenly spaced places, the last axis quickest.

    Args:
        lower: One corner.
        upper: The opposite corner.
        counts: Number of places along each axis by its name; 1 puts the axis in the middle.
    """

    lower: AxisValues
    upper: AxisValues
    counts: dict[str, int]

    def points(self, axes: Sequence[Axis], rng: np.random.Generator) -> FloatArray:
        """See ``Pattern``."""
        lower, upper = axis_vector(self.lower, axes, "grid.lower"), axis_vector(self.upper, axes, "grid.upper")
        names = [axis.name for axis in axes]
        for name in self.counts:
            if name not in names:
                raise ConfigError(f"unknown axis, this bench has {', '.join(names)}", key=f"grid.counts.{name}")
        columns = []
        for axis, low, high in zip(axes, lower, upper, strict=True):
            if axis.name not in self.counts:
                raise ConfigError("this axis is required", key=f"grid.counts.{axis.name}")
            count = self.counts[axis.name]
            _check_count(count, 1, f"grid.counts.{axis.name}")
            columns.append(np.array([0.5 * (low + high)]) if count == 1 else np.linspace(low, high, count))
        total = math.prod(len(column) for column in columns)
        if total > _MOST_PLACES:
            raise ConfigError(f"must give at most {_MOST_PLACES} places together, got {total}", key="grid.counts")
        return np.stack(np.meshgrid(*columns, indexing="ij"), axis=-1)


@dataclass(frozen=True, slots=True)
class Square:
    """The outline of a square in the plane of two linear axes, its corners included once each.

    Args:
        centre: Its centre.
        side_mm: Length of its sides.
        plane: Names of the two axes.
        points_per_side: Number of steps along a side.
    """

    centre: AxisValues
    side_mm: float
    plane: tuple[str, str]
    points_per_side: int = 1

    def points(self, axes: Sequence[Axis], rng: np.random.Generator) -> FloatArray:
        """See ``Pattern``."""
        _check_count(self.points_per_side, 1, "square.points_per_side")
        if not (np.isfinite(self.side_mm) and self.side_mm > 0.0):
            raise ConfigError(f"must be positive, got {self.side_mm}", key="square.side_mm")
        linear = [axis.name for axis in axes if axis.kind == "linear"]
        if self.plane[0] == self.plane[1] or not set(self.plane) <= set(linear):
            raise ConfigError(f"must name two different axes of {', '.join(linear)}", key="square.plane")
        corners = 0.5 * m_from_mm(self.side_mm) * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        steps = np.arange(self.points_per_side) / self.points_per_side
        outline = np.concatenate(
            [a + steps[:, None] * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)]
        )
        out = np.tile(axis_vector(self.centre, axes, "square.centre"), (len(outline), 1))
        columns = [[axis.name for axis in axes].index(name) for name in self.plane]
        out[:, columns] += outline
        return out


@dataclass(frozen=True, slots=True)
class Ladder:
    """Rungs across a line: at each of several places along it, places across it; for errors against range.

    Args:
        start: Middle of the first rung.
        end: Middle of the last rung.
        count: Number of rungs.
        across: Half of a rung by axis and unit; axes left out stay. Empty for the middle only.
        spacing: ``even``, or ``widening`` from the start: each gap is longer than the one before by the same ratio.
        widening_ratio: That ratio.
    """

    start: AxisValues
    end: AxisValues
    count: int
    across: AxisValues = field(default_factory=dict)
    spacing: Literal["even", "widening"] = "even"
    widening_ratio: float = 1.25

    def points(self, axes: Sequence[Axis], rng: np.random.Generator) -> FloatArray:
        """See ``Pattern``."""
        _check_count(self.count, 2, "ladder.count")
        if not self.widening_ratio > 0.0:
            raise ConfigError(f"must be positive, got {self.widening_ratio}", key="ladder.widening_ratio")
        start, end = axis_vector(self.start, axes, "ladder.start"), axis_vector(self.end, axes, "ladder.end")
        half = axis_vector(self.across, axes, "ladder.across", default=0.0)
        ratio = 1.0 if self.spacing == "even" else self.widening_ratio
        gaps = ratio ** np.arange(self.count - 1)
        along = np.concatenate([[0.0], np.cumsum(gaps) / gaps.sum()])
        middles = start + along[:, None] * (end - start)
        sides = np.array([-1.0, 0.0, 1.0]) if self.across else np.array([0.0])
        return middles[:, None, :] + sides[None, :, None] * half


@dataclass(frozen=True, slots=True)
class RandomVolume:
    """Uniformly random places in a box, the same for the same seed.

    Args:
        lower: One corner.
        upper: The opposite corner.
        count: Number of places.
    """

    lower: AxisValues
    upper: AxisValues
    count: int

    def points(self, axes: Sequence[Axis], rng: np.random.Generator) -> FloatArray:
        """See ``Pattern``."""
        _check_count(self.count, 1, "random.count")
        lower, upper = axis_vector(self.lower, axes, "random.lower"), axis_vector(self.upper, axes, "random.upper")
        return lower + rng.random((self.count, len(axes))) * (upper - lower)
