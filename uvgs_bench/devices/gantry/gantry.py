"""What a gantry is to the rest of the program.

To add a driver: 1. write a class with the methods of ``Gantry``; 2. add one line to ``GANTRIES``; 3. the contract tests
of ``tests/unit/devices`` then run over it. A driver never moves unhomed, outside the envelope, or after an alarm.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from types import TracebackType
from typing import Literal, Protocol, Self

from uvgs_bench.devices.gantry.axes import Axis, Envelope
from uvgs_bench.geometry import FloatArray

WireDirection = Literal[">", ">!", "<", "#"]
WireLog = Callable[[int, WireDirection, str], None]
"""Called for everything on the wire: bench time ns, direction (line out, byte out, line in, remark), text."""


@dataclass(frozen=True, slots=True, eq=False)
class GantryState:
    """The gantry at one instant.

    Args:
        t_ns: Bench time, ns.
        activity: The controller's word: Idle, Run, Jog, Hold, Alarm, Home, Door, Check, Sleep.
        position: Machine axis positions, shape (A,), m or rad.
        is_homed: Whether homing completed since the last loss of position.
        is_trusted: Whether the position can be used as truth (homed, at rest, no alarm since).
        details: Other fields of the report by name, as text.
    """

    t_ns: int
    activity: str
    position: FloatArray
    is_homed: bool
    is_trusted: bool
    details: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ControllerInfo:
    """Who answered, as read at connection.

    Args:
        firmware: Name of the firmware.
        version: Its version.
        options: How it was built.
        settings: Numbered settings, as text.
        parameters: Stored offsets and positions by name (``G54``, ``G28``), as text.
        warnings: What is unwise about the settings, one line each.
    """

    firmware: str
    version: str
    options: str
    settings: dict[str, str]
    parameters: dict[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class StampedPosition:
    """Where the axes were at an instant.

    Args:
        t_ns: Bench time, ns: the middle between question and answer.
        doubt_ns: Half of the time between, ns; the true instant is no further away.
        position: Machine axis positions, shape (A,), m or rad.
    """

    t_ns: int
    doubt_ns: int
    position: FloatArray

    @classmethod
    def between(cls, asked_ns: int, heard_ns: int, position: FloatArray) -> Self:
        """A position reported between two instants, bench time, ns."""
        return cls((asked_ns + heard_ns) // 2, (heard_ns - asked_ns + 1) // 2, position)


class MotionStream(Protocol):
    """A motion under way that is told piece by piece."""

    @property
    def end(self) -> FloatArray:
        """Where the motion that was told ends, shape (A,), m or rad."""
        ...

    def order(self, position: FloatArray, speed: float) -> None:
        """Tell one more straight piece, to machine axis positions, at a speed as for ``Gantry.move_to``.

        Raises:
            EnvelopeError: It leaves the envelope; nothing was sent.
            GantryError: Refused, alarm, lost, or no answer.
        """
        ...

    def observe(self) -> tuple[StampedPosition, GantryState]:
        """Ask where the carriage is now. Raises GantryError when it left the path, was broken off, or as ``state``."""
        ...


class Gantry(Protocol):
    """A gantry that is open."""

    @property
    def port(self) -> str:
        """The port as the user named it."""
        ...

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The axes in the controller's order."""
        ...

    @property
    def envelope(self) -> Envelope:
        """What may be reached."""
        ...

    @property
    def info(self) -> ControllerInfo:
        """Who answered."""
        ...

    def state(self) -> GantryState:
        """Ask the controller where it is. Raises GantryLost, GantryTimeout, GantryAlarm."""
        ...

    def home(self) -> GantryState:
        """Run the homing cycle and wait for its end. Raises GantryAlarm, GantryLost, GantryTimeout."""
        ...

    def move_to(self, position: Sequence[float] | FloatArray, speed: float) -> GantryState:
        """Move in a straight line to machine axis positions and return when truly arrived and at rest.

        Args:
            position: Machine axis positions, length A, m or rad.
            speed: Speed along the path, m/s (rad/s for a purely rotary move).

        Returns:
            The state at rest, position equal to the target within the controller's resolution.

        Raises:
            EnvelopeError: Target or path outside the envelope; nothing was sent.
            GantryError: Not homed, refused, alarm, lost, or no answer.
        """
        ...

    def jog(self, offset: Sequence[float] | FloatArray, speed: float) -> GantryState:
        """Move by an offset; the same rules as ``move_to``."""
        ...

    def stop(self) -> GantryState:
        """Stop the motion now, controlled, so that the position stays known. Never raises for being at rest."""
        ...

    def recording(self) -> AbstractContextManager[list[StampedPosition]]:
        """Within this, every position the controller reports is kept with its time, in the list that is given."""
        ...

    def streaming(self) -> AbstractContextManager[MotionStream]:
        """Move along a path that is told piece by piece; the end of the block waits until it is done.

        Whatever leaves the block early stops the motion first. Raises GantryError: not homed, not at rest, or as
        ``MotionStream``.
        """
        ...

    def ask(self, line: str) -> list[str]:
        """Send a line that moves nothing, and return the lines that answer it.

        Raises:
            ConfigError: The line could move something; nothing was sent.
            GantryError: Refused, alarm, lost, or no answer.
        """
        ...

    def reread(self) -> ControllerInfo:
        """Read identity and settings anew, after one was changed. Raises GantryError."""
        ...

    def reset(self) -> GantryState:
        """Stop hard: steps cease at once, and the position is lost. Raises GantryTimeout, GantryLost."""
        ...

    def close(self) -> None:
        """Stop any motion and release the port. Safe to call twice."""
        ...

    def __enter__(self) -> Self:
        """Enter a context that closes the gantry."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        ...
