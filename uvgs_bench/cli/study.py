"""``uvgs study``: prove the judging itself on simulated benches."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.one_core import compute_on_one_core
from uvgs_bench.cli.options import Force, Json, Quiet, Seed
from uvgs_bench.errors import ExitCode

if TYPE_CHECKING:
    from uvgs_bench.sessions.study import StudyResult


def study(
    name: Annotated[str, typer.Argument(metavar="STUDY", help="coverage, diagnosis or planning.")],
    benches: Annotated[int, typer.Option("--benches", min=1, help="Number of simulated benches of each kind.")] = 100,
    seed: Seed = 0,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="Processes; one per processor when left out.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", help="Dask scheduler in place of processes, like tcp://host:8786.")
    ] = None,
    folder: Annotated[
        Path | None, typer.Option("--out", help="Folder of the results; reports/study_STUDY_SEED when left out.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with results that are there.")] = False,
    force: Force = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Monte-Carlo over simulated benches: coverage of intervals, power of the diagnosis, how many stations it takes.

    The same seed gives the same table on any number of workers.
    Ctrl-C keeps what is done; --resume goes on, also with more benches.
    Ends with 1 when a target is missed, 3 when the benches are too few to tell.
    """
    compute_on_one_core()
    from uvgs_bench.cli.console import emit_json, progress_sink
    from uvgs_bench.errors import ConfigError
    from uvgs_bench.sessions.study import run_study

    if resume and force:
        raise ConfigError("either go on with the results that are there or replace them", key="--resume --force")
    if workers is not None and scheduler is not None:
        raise ConfigError("the scheduler knows its workers: leave this out", key="--workers")
    with progress_sink(quiet=quiet) as sink:
        result = run_study(
            name,
            benches,
            seed,
            folder or Path("reports") / f"study_{name}_{seed}",
            sink,
            workers=workers or _processors(),
            scheduler=scheduler,
            resume=resume,
            force=force,
        )
    if as_json:
        emit_json(_facts(result))
    else:
        _print(result)
    codes = {"fail": ExitCode.LIMITS_MISSED, "inconclusive": ExitCode.INCONCLUSIVE}
    if result.verdict in codes:
        raise typer.Exit(int(codes[result.verdict]))


def _processors() -> int:
    return len(os.sched_getaffinity(0))


def _facts(result: StudyResult) -> dict[str, object]:
    return {
        "study": result.study,
        "benches": result.benches,
        "seed": result.seed,
        "verdict": result.verdict or None,
        "shares": [
            {
                "name": share.name,
                "hits": share.hits,
                "count": share.count,
                "share": share.share,
                "low": share.low,
                "high": share.high,
                "target": None if share.target is None else [share.target.low, share.target.high],
                "verdict": share.verdict or None,
                "note": share.note,
            }
            for share in result.shares
        ],
        "remarks": list(result.remarks),
        "results": result.results,
    }


def _print(result: StudyResult) -> None:
    from rich.markup import escape
    from rich.table import Table

    from uvgs_bench.cli.console import out, print_path, verdict_markup

    table = Table(
        title=f"{result.study}, {result.benches} benches, seed {result.seed}", title_justify="left", box=None,
        pad_edge=False,
    )  # fmt: skip
    table.add_column("what", overflow="fold")
    table.add_column("share", justify="right", no_wrap=True)
    table.add_column("95 %", justify="right", no_wrap=True)
    has_target = any(share.target for share in result.shares)
    has_note = any(share.note for share in result.shares)
    if has_target:
        table.add_column("target")
        table.add_column("", no_wrap=True)
    if has_note:
        table.add_column("note", overflow="fold")
    for share in result.shares:
        cells = [
            escape(share.name),
            f"{100.0 * share.share:.1f} %",
            f"{100.0 * share.low:.1f} to {100.0 * share.high:.1f}",
        ]
        if has_target:
            cells.append(share.target.text if share.target else "")
            cells.append(verdict_markup(share.verdict) if share.verdict else "")
        if has_note:
            cells.append(escape(share.note))
        table.add_row(*cells)
    out.print(table)
    for remark in result.remarks:
        out.print(escape(remark))
    if result.verdict:
        out.print(f"verdict      {verdict_markup(result.verdict)}")
    print_path("results", result.results)
