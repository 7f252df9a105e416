"""``uvgs compare``: runs side by side, and what of their differences the data show."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from uvgs_bench.cli.one_core import compute_on_one_core
from uvgs_bench.cli.options import Force, Json
from uvgs_bench.errors import ExitCode

if TYPE_CHECKING:
    from uvgs_bench.store.comparing import Comparison


class Baseline(StrEnum):
    """What each run is compared with."""

    FIRST = "first"
    PREVIOUS = "previous"


def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Two or more run folders; sorted by date.")],
    baseline: Annotated[Baseline, typer.Option("--against", help="Compare with the first run or the one before.")] = (
        Baseline.FIRST
    ),
    is_gate: Annotated[
        bool, typer.Option("--fail-on-worse", help="Exit 1 when a figure got worse, 3 when that cannot be told.")
    ] = False,
    allow_percent: Annotated[
        float, typer.Option("--allow-percent", min=0.0, max=1000.0, help="Worsening that is tolerated.")
    ] = 0.0,
    out_folder: Annotated[
        Path | None, typer.Option("--out", help="Folder for report.html, .pdf and .json.", show_default=False)
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Compare runs: which figures changed, by how much, and which change could have been seen at all."""
    compute_on_one_core()
    from uvgs_bench.cli.console import emit_json, out, print_path, verdict_markup
    from uvgs_bench.report import check_replaceable, write_document
    from uvgs_bench.report.compare_page import build_comparison_document
    from uvgs_bench.store.comparing import compare_runs
    from uvgs_bench.store.run import read_run
    from uvgs_bench.units import fraction_from_percent

    if out_folder is not None:
        check_replaceable(out_folder, force=force)
    comparison = compare_runs(
        [read_run(run) for run in runs], baseline=baseline.value, allowed=fraction_from_percent(allow_percent)
    )
    document = build_comparison_document(comparison)
    paths = {} if out_folder is None else write_document(document, out_folder, force=force)
    if as_json:
        emit_json(
            {
                "schema": 1,
                "verdict": document.verdict_word,
                "headline": document.headline,
                "runs": [_run_data(compared) for compared in comparison.runs],
                "trends": [_plain(trend) for trend in comparison.trends],
                "precision_mm": _precision_mm(comparison),
                "files": {name: str(path) for name, path in paths.items()},
            }
        )
    else:
        out.print(f"{verdict_markup(document.verdict_word)}  ", end="")
        out.print(document.headline, soft_wrap=True, markup=False)
        _print_changes(comparison)
        for name, path in paths.items():
            print_path(name, path)
    if is_gate and comparison.has("worse"):
        raise typer.Exit(int(ExitCode.LIMITS_MISSED))
    if is_gate and comparison.has("inconclusive"):
        raise typer.Exit(int(ExitCode.INCONCLUSIVE))


def _plain(value: Any) -> dict[str, Any]:
    from dataclasses import asdict

    return asdict(value)


def _precision_mm(comparison: Comparison) -> dict[str, Any] | None:
    """Standard deviations per axis and limits after ISO 5725 with their intervals, mm."""
    from uvgs_bench.units import mm_from_m

    found = comparison.precision
    if found is None:
        return None
    r, R = found.limits
    named = {
        "repeatability_sd": found.within,
        "between_runs_sd": found.between,
        "reproducibility_sd": found.total,
        "repeatability_limit": r,
        "reproducibility_limit": R,
    }
    return {key: _plain(estimate.scaled(mm_from_m(1.0))) for key, estimate in named.items()}


def _run_data(compared: Any) -> dict[str, Any]:
    return {
        "id": compared.run.manifest.id,
        "created_utc": compared.run.manifest.created_utc,
        "against": compared.against,
        "is_paired": compared.is_paired,
        "setup_differences": [{"what": w, "there": there, "here": here} for w, there, here in compared.setup],
        "changes": [_plain(change) for change in compared.changes],
    }


def _print_changes(comparison: Comparison) -> None:
    from rich.table import Table

    from uvgs_bench.cli.console import out
    from uvgs_bench.report.compare_page import change_words, effect_words

    for i, compared in enumerate(comparison.runs):
        if i == 0:
            out.print(f"run 1  {compared.run.manifest.id}", soft_wrap=True, markup=False)
            continue
        out.print(f"run {i + 1}  {compared.run.manifest.id}, against run {compared.against + 1}", soft_wrap=True)
        for name, there, here in compared.setup:
            out.print(f"  not the same: {name}: {there or '-'} -> {here or '-'}", soft_wrap=True, markup=False)
        table = Table(box=None, pad_edge=False)
        for heading in ("figure", "verdict", "change"):
            table.add_column(heading)
        for change in compared.changes:
            table.add_row(change_words(change), change.word, change.note or effect_words(change))
        out.print(table)
    for key, e in (_precision_mm(comparison) or {}).items():
        words = f"{key.replace('_', ' ')} {e['value']:.3f} mm ({e['low']:.3f} to {e['high']:.3f})"
        out.print(words + (f", {e['note']}" if e["note"] else ""), soft_wrap=True)
    out.print("Intervals are 95 % each; a verdict is false in at most 5 % of such comparisons, all figures together.")
