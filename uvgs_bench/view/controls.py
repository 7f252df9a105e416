"""What a page may ask of a running stream, as plain values. The command line puts the real things behind it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Slider:
    """One value that can be changed.

    Args:
        name: Its name, as in the file.
        value: What it is now.
        least: Smallest value.
        greatest: Largest value.
        step: Step between values; 0 when the slider is logarithmic.
    """

    name: str
    value: float
    least: float
    greatest: float
    step: float


class Controls(Protocol):
    """The sensor's parameters and the camera's exposure; called from any thread, made between two captures.

    An order answers with None when it is taken, else with one line that says why not.
    """

    def sliders(self) -> tuple[Slider, ...]:
        """The parameters that can be changed now; none when a record must stay true."""
        ...

    def exposure(self) -> Slider | None:
        """The exposure, s; None when it cannot be set."""
        ...

    def tune(self, changes: Mapping[str, object]) -> str | None:
        """Change parameters from the next capture on."""
        ...

    def expose(self, exposure_s: float) -> str | None:
        """Change the exposure, s, after the next capture."""
        ...

    def save(self) -> Path:
        """Write the parameters to the sensor file, which is the answer. Raises UvgsError."""
        ...


class Motion(Protocol):
    """A gantry that may be moved by hand. Orders return at once; the gantry's state tells what came of them.

    An order answers with None when it is taken, else with one line that says why not.
    """

    @property
    def axes(self) -> tuple[tuple[str, str], ...]:
        """Name and unit (``m`` or ``rad``) of each axis."""
        ...

    def home(self) -> str | None:
        """Home all axes."""
        ...

    def jog(self, axis: str, offset: float) -> str | None:
        """Move an axis by an offset, m or rad."""
        ...

    def stop(self) -> str | None:
        """Stop what moves."""
        ...
