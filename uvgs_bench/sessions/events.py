"""How sessions speak: plain values handed to a sink. The terminal draws them; a test collects them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class StageStarted:
    """A stage of work began.

    Args:
        stage: Stable name, shown to people.
        total: Number of steps, or None when unknown.
    """

    stage: str
    total: int | None = None


@dataclass(frozen=True, slots=True)
class StageAdvanced:
    """A step of a stage is done.

    Args:
        stage: Stable name.
        done: Steps done so far.
        detail: What was just done, in a few words.
    """

    stage: str
    done: int
    detail: str = ""


@dataclass(frozen=True, slots=True)
class StageFinished:
    """A stage ended.

    Args:
        stage: Stable name.
        detail: Its result in one line.
    """

    stage: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Remark:
    """Something people should read.

    Args:
        level: ``info`` or ``warning``.
        text: One line.
    """

    level: Literal["info", "warning"]
    text: str


@dataclass(frozen=True, slots=True)
class CoverageShown:
    """Where the taking of board views stands after a capture.

    Args:
        views: Views taken so far.
        captures: Captures looked at.
        counts: Corners in each cell of the picture, row by row.
        wishes: What is missing, most useful first.
        said: What came of this capture, in a few words.
        is_taken: Whether this capture was taken.
    """

    views: int
    captures: int
    counts: tuple[tuple[int, ...], ...]
    wishes: tuple[str, ...]
    said: str
    is_taken: bool


Event = StageStarted | StageAdvanced | StageFinished | Remark | CoverageShown
EventSink = Callable[[Event], None]


def ignore_events(_event: Event) -> None:
    """A sink that drops everything."""
