"""What a camera is to the rest of the program.

To add a source: 1. write a class with the methods of ``CameraSource`` in a file of its own; 2. add one line to
``CAMERAS`` in ``registry.py``; 3. the contract tests of ``tests/unit/devices`` then run over it.

Contract: ``grab`` returns the next capture whose exposure began after the call for a live source, or the next one in
order for a recorded source, and None when a recorded source has ended; indices count from 0 without gaps;
``t_ns`` never runs backwards.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import isclose
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self, runtime_checkable

from uvgs_bench.sensor.capture import Capture

if TYPE_CHECKING:
    from uvgs_bench.camera.calibration import Calibration


class CameraSource(Protocol):
    """A camera, or a recording of one, that is open."""

    @property
    def spec(self) -> str:
        """The spec string it was opened by."""
        ...

    @property
    def is_live(self) -> bool:
        """Whether captures are taken now (True) or were recorded before (False)."""
        ...

    @property
    def length(self) -> int | None:
        """Number of captures if known."""
        ...

    def grab(self) -> Capture | None:
        """Next capture, or None at the end of a recording. Raises CaptureError."""
        ...

    def __iter__(self) -> Iterator[Capture]:
        """All captures until the end."""
        ...

    def close(self) -> None:
        """Release the device or file. Safe to call twice."""
        ...

    def __enter__(self) -> Self:
        """Enter a context that closes the source."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        ...


@runtime_checkable
class Remarking(Protocol):
    """What a recorded source has besides when parts of it may be damaged or doubtful without being useless."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """What there is to say so far, a line each; grows while captures are read."""
        ...


@runtime_checkable
class CarriesCamera(Protocol):
    """What a recorded source has besides when it may say the lens its pictures were taken with."""

    def camera_info(self) -> Calibration | None:
        """The lens as it says; None when it does not. Raises CaptureError when that is no lens."""
        ...


@runtime_checkable
class FreeRunning(Protocol):
    """What a live camera has besides when it delivers frames by itself, whether or not they are asked for."""

    def next_capture(self) -> Capture:
        """The next frame in the camera's order, exposed before or after the call. Raises CaptureError."""
        ...


@runtime_checkable
class OwnClock(Protocol):
    """What a live camera has besides when its captures are stamped by a clock other than the bench's."""

    def now_ns(self) -> int:
        """The time of that clock, ns."""
        ...


@dataclass(frozen=True, slots=True)
class Setting:
    """A property of a camera that was asked for, and what the camera says it is.

    Args:
        name: Name of the option.
        asked: What was asked for; None when nothing was.
        got: What the camera says; None when it does not say.
        unit: Unit of both, or empty.
    """

    name: str
    asked: float | None
    got: float | None
    unit: str = ""

    @property
    def is_kept(self) -> bool:
        """Whether the camera took it, to 2 %."""
        return self.asked is None or (self.got is not None and isclose(self.asked, self.got, rel_tol=0.02))


@runtime_checkable
class ReadBack(Protocol):
    """What a live camera has besides when its properties can be set by options of its spec."""

    @property
    def settings(self) -> tuple[Setting, ...]:
        """What was asked for and what came of it."""
        ...


@runtime_checkable
class ExposureControl(Protocol):
    """What a camera has besides when its exposure can be set. Gain and everything else stay as they are.

    Contract: ``set_exposure_s`` keeps to ``exposure_limits_s`` and answers with what the camera took, which is what
    ``exposure_s`` reads back from then on; captures that do not state their own exposure may have been taken with the
    old one for ``settling_captures`` more.
    """

    @property
    def exposure_s(self) -> float:
        """The exposure as the camera says it, s. Raises CaptureError when it does not say."""
        ...

    @property
    def exposure_limits_s(self) -> tuple[float, float]:
        """Shortest and longest exposure, s."""
        ...

    @property
    def full_scale_dn(self) -> float:
        """Largest value a pixel of its pictures can have, DN: a dark 16-bit picture does not show its depth."""
        ...

    @property
    def settling_captures(self) -> int:
        """How many captures after a change may still be taken with the old exposure and do not say so."""
        ...

    def set_exposure_s(self, exposure_s: float) -> float:
        """Ask for an exposure, s; the answer is what the camera took. Raises CaptureError when it refuses."""
        ...
