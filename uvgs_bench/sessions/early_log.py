"""A log of the gantry's wire that may begin before there is a run to write it to."""

from __future__ import annotations

from typing import Self

from uvgs_bench.store.run import RunWriter


class EarlyLog:
    """Holds what passes on the wire until it is told of a run; then hands it on."""

    def __init__(self) -> None:
        self._held: list[tuple[int, str, str]] = []
        self._writer: RunWriter | None = None

    def __call__(self, t_ns: int, direction: str, text: str) -> None:
        """One line of the wire, as ``WireLog``."""
        if self._writer is None:
            self._held.append((t_ns, direction, text))
        else:
            self._writer.wire(t_ns, direction, text)

    def forward_to(self, writer: RunWriter) -> Self:
        """Write what is held and all that follows to a run."""
        for held in self._held:
            writer.wire(*held)
        self._held.clear()
        self._writer = writer
        return self
