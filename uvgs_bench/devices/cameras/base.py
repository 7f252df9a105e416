"""What all sources share: iteration and the context that closes them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from types import TracebackType
from typing import Self

from uvgs_bench.sensor.capture import Capture


class ClosingSource(ABC):
    """A ``CameraSource`` with the parts that never differ.

    Args:
        spec: The spec string it was opened by.
        is_live: Whether captures are taken now.
        length: Number of captures if known.
    """

    def __init__(self, spec: str, *, is_live: bool, length: int | None) -> None:
        self._spec = spec
        self._is_live = is_live
        self._length = length

    @property
    def spec(self) -> str:
        """The spec string it was opened by."""
        return self._spec

    @property
    def is_live(self) -> bool:
        """Whether captures are taken now (True) or were recorded before (False)."""
        return self._is_live

    @property
    def length(self) -> int | None:
        """Number of captures if known."""
        return self._length

    @abstractmethod
    def grab(self) -> Capture | None:
        """Next capture, or None at the end of a recording. Raises CaptureError."""

    def close(self) -> None:  # noqa: B027  (most sources hold nothing that must be released)
        """Release the device or file. Safe to call twice."""

    def __iter__(self) -> Iterator[Capture]:
        """All captures until the end."""
        while (capture := self.grab()) is not None:
            yield capture

    def __enter__(self) -> Self:
        """Enter a context that closes the source."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()
