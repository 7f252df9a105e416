"""``uvgs run --batch``: many sources, a table at the end."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from uvgs_bench.cli.options import given_options
from uvgs_bench.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uvgs_bench.sessions.batch import SourceResult

# Options that say where something goes: their paths must differ from source to source.
_OUTPUTS = ("--out", "--record", "--debug-images")
# What the batch says itself to every run.
_OWN = frozenset({"--batch", "--workers", "--scheduler", "--json", "--quiet", "--force"})
_DOCUMENTS = ("--camera", "--beacon", "--config")
_ONE_ONLY = ("--udp", "--rate-hz", "--view", "--foxglove")


def run_list(
    context: typer.Context,
    listed: Path,
    *,
    workers: int | None,
    scheduler: str | None,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Solve every source of a list and leave with the exit code of the whole.

    Args:
        context: The command line of ``uvgs run``.
        listed: The list.
        workers: Processes at a time, or None for one per processor.
        scheduler: Address of a Dask scheduler, or None.
        force: Whether to do again what is done.
        as_json: Whether to print JSON.
        quiet: Whether to draw no progress.

    Raises:
        typer.Exit: Always.
        ConfigError: An option cannot be meant for many sources.
    """
    from uvgs_bench.cli.console import emit_json, progress_sink
    from uvgs_bench.sessions.batch import RESULTS_FILE, BatchPlan, read_sources, run_batch

    if workers is not None and scheduler is not None:
        raise ConfigError("the scheduler knows its workers: leave this out", key="--workers")
    if "source" in given_options(context):
        raise ConfigError("the sources are in the list: leave the other one out", "--batch")
    words = written_words(context)
    for option, _ in words:
        if option in _ONE_ONLY:
            raise ConfigError("is for one source at a time", option)
    if ("--handover", ("command",)) in words:
        raise ConfigError("command reads standard input, which many sources cannot share", "--handover")
    outputs = tuple((option, path) for option, values in words for path in values if option in _OUTPUTS)
    plan = BatchPlan(
        tuple(word for option, values in words if option not in _OUTPUTS for word in (option, *values)),
        tuple(_with_name(option, path) for option, path in outputs),
        tuple(value for option, values in words if option in _DOCUMENTS for value in values),
    )
    if not plan.outputs:
        raise ConfigError("is needed: a folder, or a path with {} for the name of the source", "--out")
    sources = read_sources(listed)
    with progress_sink(quiet=quiet) as sink:
        results = run_batch(
            sources,
            plan,
            sink,
            workers=workers or len(os.sched_getaffinity(0)),
            scheduler=scheduler,
            force=force,
        )
    where = plan.folder / RESULTS_FILE
    if as_json:
        emit_json(_facts(results, where))
    else:
        _print(results, where)
    raise typer.Exit(int(_code(results)))


def written_words(context: typer.Context) -> list[tuple[str, tuple[str, ...]]]:
    """The options that were written on the command line, as they would be written again.

    Args:
        context: The command line.

    Returns:
        Option and values of each, an option that was repeated as often as it was; those of the batch itself left out.
    """
    given = given_options(context)
    words: list[tuple[str, tuple[str, ...]]] = []
    for parameter in context.command.params:
        name, value = parameter.name, context.params.get(parameter.name or "")
        if name not in given or not parameter.opts[0].startswith("-"):
            continue
        option = next((text for text in parameter.opts if text.startswith("--")), parameter.opts[0])
        if option in _OWN:
            continue
        if isinstance(value, bool):
            words.append((option if value else parameter.secondary_opts[0], ()))
        elif isinstance(value, list | tuple):
            words += [(option, (str(item),)) for item in value]
        elif value is not None:
            words.append((option, (str(value),)))
    return words


def _with_name(option: str, path: str) -> tuple[str, str]:
    from uvgs_bench.sessions.batch import NAME

    if NAME in path:
        return option, path
    if option != "--out":
        raise ConfigError(f"needs {NAME} for the name of the source, got '{path}'", option)
    if Path(path).suffix and not Path(path).is_dir():
        raise ConfigError(f"expected a folder, or a path with {NAME} for the name of the source, got '{path}'", option)
    return option, str(Path(path) / f"{NAME}.csv")


def _code(results: Sequence[SourceResult]) -> ExitCode:
    failed = {result.code for result in results if not result.is_done}
    if failed:
        # One kind of failure says what it is; of several, something was wrong with the input.
        known = [code for code in ExitCode if failed == {int(code)}]
        return known[0] if known else ExitCode.INPUT
    return ExitCode.DONE if all(result.poses for result in results) else ExitCode.INCONCLUSIVE


def _facts(results: Sequence[SourceResult], where: Path) -> dict[str, object]:
    return {
        "sources": [
            {
                "source": result.source,
                "code": result.code,
                "captures": result.captures,
                "poses": result.poses,
                "held": result.held,
                "misses": result.misses,
                "error": result.error or None,
                "warnings": list(result.warnings),
                "was_done": result.was_done,
                "out": list(result.written),
            }
            for result in results
        ],
        "done": sum(result.is_done for result in results),
        "were_done": sum(result.was_done for result in results),
        "failed": sum(not result.is_done for result in results),
        "captures": sum(result.captures for result in results),
        "poses": sum(result.poses for result in results),
        "results": where,
    }


def _print(results: Sequence[SourceResult], where: Path) -> None:
    from rich.markup import escape
    from rich.table import Table

    from uvgs_bench.cli.console import out, print_path

    table = Table(box=None, pad_edge=False)
    table.add_column("source", overflow="fold")
    for name in ("captures", "poses"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("", overflow="fold")
    table.add_column("out", overflow="fold")
    for result in results:
        word = "[dim]done before[/] " if result.was_done else ""
        most = max(result.misses.items(), key=lambda item: item[1], default=None)
        said = "" if most is None else f"{escape(most[0])} {most[1]}"
        if result.error:
            said = f"[red]failed ({result.code}):[/] {escape(result.error)}"
        elif not result.poses:
            said = f"[yellow]no pose[/] {said}"
        if result.warnings:
            said += f" [yellow]{len(result.warnings)} warning{'s' if len(result.warnings) > 1 else ''}, below[/]"
        table.add_row(
            escape(result.source),
            str(result.captures),
            str(result.poses),
            f"{word}{said}".strip(),
            escape(", ".join(result.written)),
        )
    out.print(table)
    done, poses = sum(result.is_done for result in results), sum(result.poses for result in results)
    captures = sum(result.captures for result in results)
    for result in results:
        for text in result.warnings:
            out.print(f"[yellow]warning:[/] {escape(result.source)}: {escape(text)}", soft_wrap=True)
    out.print(f"{done} of {len(results)} sources done, {poses} of {captures} captures with a pose")
    print_path("results", where)
