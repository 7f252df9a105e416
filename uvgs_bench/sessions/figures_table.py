"""One row of a table of figures: what was promised, what was measured, and whether that holds."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Figure:
    """A measured figure beside its promise.

    Args:
        name: What it is, for people.
        wanted: The promise as text with its unit, for example ``<= 5 mm``; empty where none is made.
        measured: The figure, in ``unit``; NaN where it could not be measured.
        unit: Its unit as printed, for example ``mm``; empty for a count.
        is_met: Whether the promise holds; None where none is made.
    """

    name: str
    wanted: str
    measured: float
    unit: str
    is_met: bool | None
