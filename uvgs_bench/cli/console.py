"""Printing: results on stdout, progress and remarks on stderr, one line per error."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn

from uvgs_bench.sessions.events import Event, EventSink, Remark, StageAdvanced, StageFinished, StageStarted


class _PipedConsole(Console):
    """A console whose broken pipe is an exception: rich would leave with 1, which means limits missed."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


# No emoji: a source named uvc:x: must not turn into a cross.
console = Console(stderr=True, highlight=False, emoji=False)
out = _PipedConsole(highlight=False, emoji=False)

_VERDICT_STYLE = {"pass": "bold green", "fail": "bold red", "inconclusive": "bold yellow"}


def verdict_markup(verdict: str) -> str:
    """A verdict word with its colour, as rich markup."""
    style = _VERDICT_STYLE.get(verdict, "bold")
    return f"[{style}]{escape(verdict.upper())}[/]"


def emit_json(value: object) -> None:
    """Print one strict JSON object on stdout; what is not finite becomes null."""
    sys.stdout.write(json.dumps(_strict(value), ensure_ascii=False, indent=2, allow_nan=False) + "\n")
    sys.stdout.flush()


def _strict(value: object) -> object:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): _strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(item) for item in value]
    if value is None or isinstance(value, str | int | bool):
        return value
    if hasattr(value, "tolist"):
        return _strict(value.tolist())
    return str(value)


def print_error(text: str) -> None:
    """One clear line on stderr."""
    console.print(f"[bold red]error:[/] {escape(' '.join(text.split()))}", soft_wrap=True)


def print_path(label: str, path: object) -> None:
    """A path on stdout, never wrapped, so that it can be copied."""
    out.print(f"{label:<12} {escape(str(path))}", soft_wrap=True)


@contextmanager
def progress_sink(*, quiet: bool = False) -> Iterator[EventSink]:
    """A sink that draws progress bars on stderr, or a line per finished stage where there is no terminal.

    Args:
        quiet: Draw nothing but warnings.

    Yields:
        The sink to hand to a session.
    """
    if quiet or not console.is_terminal:
        yield lambda event: _print_plainly(event, quiet)
        return
    columns = (
        SpinnerColumn(finished_text="[green]✓[/]"),
        TextColumn("{task.description:<12}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("[dim]{task.fields[detail]}"),
    )
    with Progress(*columns, console=console, transient=False) as progress:
        tasks: dict[str, TaskID] = {}

        def draw(event: Event) -> None:
            match event:
                case StageStarted(stage, total):
                    tasks[stage] = progress.add_task(escape(stage), total=total, detail="")
                case StageAdvanced(stage, done, detail) if stage in tasks:
                    progress.update(tasks[stage], completed=done, detail=escape(detail))
                case StageFinished(stage, detail) if stage in tasks:
                    task = progress.tasks[progress.task_ids.index(tasks[stage])]
                    end = task.total if task.total is not None else max(task.completed, 1)
                    progress.update(tasks[stage], total=end, completed=end, detail=escape(detail))
                case Remark(level, text):
                    progress.console.print(_remark_line(level, text), soft_wrap=True)
                case _:
                    pass

        yield draw


def _print_plainly(event: Event, quiet: bool) -> None:
    if isinstance(event, StageFinished) and not quiet:
        console.print(escape(f"{event.stage}: {event.detail or 'done'}"), soft_wrap=True)
    elif isinstance(event, Remark) and (event.level == "warning" or not quiet):
        console.print(_remark_line(event.level, event.text), soft_wrap=True)


def _remark_line(level: str, text: str) -> str:
    colour = "yellow" if level == "warning" else "cyan"
    return f"[{colour}]{level}:[/] {escape(text)}"
