"""``uvgs report``: a run as web page, PDF and JSON."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.one_core import compute_on_one_core, no_garbage_sought
from uvgs_bench.cli.options import Force, IntervalSeed, Json
from uvgs_bench.cli.registering import BoardFile, BoardRun, LinkFile, Terms, judge_registered
from uvgs_bench.errors import ExitCode

if TYPE_CHECKING:
    from uvgs_bench.report import Document

_EXIT_CODES = {"pass": ExitCode.DONE, "fail": ExitCode.LIMITS_MISSED}


def report(
    run: Annotated[Path, typer.Argument(help="Run folder, finished or not.", show_default=False)],
    formats: Annotated[str, typer.Option("--format", help="Comma-separated: html, pdf, json.")] = "html,pdf,json",
    out_folder: Annotated[
        Path | None, typer.Option("--out", help="Folder for the files; the run's own by default.", show_default=False)
    ] = None,
    force: Force = False,
    seed: IntervalSeed = None,
    terms: Terms = None,
    board_file: BoardFile = None,
    link_file: LinkFile = None,
    board_run: BoardRun = None,
    as_json: Json = False,
) -> None:
    """Judge a run and write its report; exit 0 limits met, 1 limits missed, 3 inconclusive."""
    compute_on_one_core()
    with no_garbage_sought():
        from uvgs_bench.report import build_document, check_formats, write_document
        from uvgs_bench.store.run import read_run

        names = check_formats(formats.split(","))
        found = read_run(run)
        document = build_document(found, judge_registered(found, seed, terms, board_file, link_file, board_run))
        # In the run's own folder reports are derived from what lies beside them, so they are rebuilt without asking.
        is_own = out_folder is None or out_folder.resolve() == run.resolve()
        paths = write_document(document, out_folder or run, names, force=force or is_own)
    from uvgs_bench.cli.console import emit_json, print_path

    if as_json:
        figures = [figure.data() for figure in document.key_figures]
        files = {name: str(path) for name, path in paths.items()}
        summary = {"verdict": document.verdict, "headline": document.headline, "key_figures": figures, "files": files}
        emit_json(summary | {"banners": [banner.text for banner in document.banners]})
    else:
        _print_summary(document)
        for name, path in paths.items():
            print_path(name, path)
    raise typer.Exit(int(_EXIT_CODES.get(document.verdict, ExitCode.INCONCLUSIVE)))


def _print_summary(document: Document) -> None:
    from rich.markup import escape

    from uvgs_bench.cli.console import out, verdict_markup

    for banner in document.banners:
        out.print(f"[bold yellow]{escape(banner.text)}[/]", soft_wrap=True)
    out.print(f"{verdict_markup(document.verdict)}  {escape(document.headline)}", soft_wrap=True)
    for figure in document.key_figures:
        interval = "" if figure.interval is None else f"95 %: {figure.interval.shown}"
        line = f"{figure.label:<26} {figure.number.shown:>8} {figure.number.unit:<4} {interval:<24} {figure.note}"
        out.print(escape(line), soft_wrap=True)
