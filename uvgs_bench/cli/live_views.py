"""The panel beside a waved board: what is covered, what is missing, what came of the last capture."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.panel import Panel

    from uvgs_bench.sessions.events import CoverageShown, Event, EventSink

_SHADES = " .:*#"
_STEPS = (1, 3, 8, 20)


@contextmanager
def live_sink(*, quiet: bool = False) -> Iterator[EventSink]:
    """A sink that draws a panel on stderr, or a line for each view taken where there is no terminal.

    Args:
        quiet: Draw nothing but warnings.

    Yields:
        The sink to hand to the session.
    """
    from rich.live import Live
    from rich.markup import escape

    from uvgs_bench.cli.console import console, progress_sink
    from uvgs_bench.sessions.events import CoverageShown, Remark, StageFinished

    if quiet or not console.is_terminal:
        with progress_sink(quiet=quiet) as plain:

            def say(event: Event) -> None:
                if isinstance(event, CoverageShown) and event.is_taken and not quiet:
                    console.print(escape(f"view {event.views}: {event.said}"), soft_wrap=True)
                plain(event)

            yield say
        return
    with Live(console=console, refresh_per_second=8, transient=False) as live:

        def draw(event: Event) -> None:
            match event:
                case CoverageShown():
                    live.update(_panel(event))
                case StageFinished(stage, detail):
                    console.print(escape(f"{stage}: {detail}"))
                case Remark(level, text):
                    console.print(f"[{'yellow' if level == 'warning' else 'cyan'}]{level}:[/] {escape(text)}")
                case _:
                    pass

        yield draw


def _panel(shown: CoverageShown) -> Panel:
    from rich.panel import Panel
    from rich.text import Text

    text = Text("where the corners were seen:\n")
    for row in shown.counts:
        text.append("  |" + "".join(2 * _shade(count) for count in row) + "|\n", style="cyan")
    text.append(f"{shown.views} views taken of {shown.captures} captures\n", style="bold")
    text.append(f"{shown.said}\n", style="green" if shown.is_taken else "yellow")
    for wish in shown.wishes:
        text.append(f"next: {wish}\n")
    if not shown.wishes:
        text.append("enough\n", style="bold green")
    text.rstrip()
    return Panel(text, title="calibrate", expand=False)


def _shade(count: int) -> str:
    return _SHADES[sum(count >= step for step in _STEPS)]
