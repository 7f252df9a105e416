"""``uvgs fuse``: poses of the sensor, an inertial unit and another localiser become one path with its doubt."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from uvgs_bench.cli.one_core import compute_on_one_core
from uvgs_bench.cli.options import Force, Json, Quiet, Seed
from uvgs_bench.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from uvgs_bench.navigation.fusion_data import FalsePoses
    from uvgs_bench.navigation.fusion_outcome import FusedRun, FusionOutcome

_HOW = "How"
# Columns of a terminal that all figures fit in.
_WIDE = 76


def fuse(
    source: Annotated[
        str,
        typer.Argument(help="sim:square, sim:occlusion, sim:gt2, a run folder, or bags: FILE or bag:FILE,FILE."),
    ],
    method: Annotated[
        Literal["filter", "graph", "ar_swap"],
        typer.Option("--method", help="Error-state filter, factor graph (GTSAM), poses alone as in the AR pipeline."),
    ] = "filter",
    out: Annotated[
        list[Path] | None,
        typer.Option("--out", help="Fused states: .csv, .tum, .jsonl, .bag or .mcap; may be repeated."),
    ] = None,
    report: Annotated[Path | None, typer.Option("--report", help="Folder for a report: HTML, PDF and JSON.")] = None,
    setup: Annotated[
        Path | None, typer.Option("--setup", help="What a bag does not say: mounting, beacon, noise, topics; TOML.")
    ] = None,
    false_poses: Annotated[
        str | None,
        typer.Option("--false-poses", help="SHARE:SIZE_M of false poses to mix in: 0.05:0.3.", rich_help_panel=_HOW),
    ] = None,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Look ahead as well: smoothed states (filter).", rich_help_panel=_HOW)
    ] = False,
    factors: Annotated[
        Literal["pose", "led"],
        typer.Option("--factors", help="The sensor in the graph: poses, or pixels of its LEDs.", rich_help_panel=_HOW),
    ] = "pose",
    learn_beacon: Annotated[
        bool,
        typer.Option("--learn-beacon", help="The beacon's place is a variable of the graph.", rich_help_panel=_HOW),
    ] = False,
    gate_chi2: Annotated[
        float,
        typer.Option(
            "--gate-chi2",
            min=0.1,
            help="Largest squared distance of a pose that is believed, 6 degrees of freedom.",
            rich_help_panel=_HOW,
        ),
    ] = 16.8119,
    min_leds: Annotated[
        int,
        typer.Option(
            "--min-leds", min=3, help="Fewest LEDs the AR pipeline takes; as shipped it is 5.", rich_help_panel=_HOW
        ),
    ] = 4,
    seed: Seed = 0,
    force: Force = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Fuse, judge, and say what does not fit. Ends with 3 when clocks, mounting, readings or poses do not agree."""
    compute_on_one_core()
    from uvgs_bench.cli.console import emit_json, progress_sink
    from uvgs_bench.interop.fused_states import check_fused_path, write_fused_states
    from uvgs_bench.sessions.fuse import FusionOptions
    from uvgs_bench.sessions.fuse_session import read_source, run_fusion
    from uvgs_bench.sessions.fusion_setup import FusionSetup
    from uvgs_bench.sessions.interruption import interruptible
    from uvgs_bench.store.documents import read_document

    _check(method, smooth, factors, learn_beacon)
    paths = out or []
    for path in paths:
        if paths.count(path) > 1:
            raise ConfigError(f"{path} is named twice", "--out")
        check_fused_path(path, force=force)
    if report is not None:
        from uvgs_bench.report.write import check_replaceable

        check_replaceable(report, force=force)
    false = None if false_poses is None else _false_poses(false_poses, seed)
    written = None if setup is None else read_document(setup, FusionSetup)
    options = FusionOptions(gate_chi2, smooth, factors, learn_beacon, min_leds)
    with progress_sink(quiet=quiet) as sink, interruptible():
        outcome = run_fusion(read_source(source, written, seed, sink), method, options, false, sink)
    for path in paths:
        write_fused_states(path, outcome.main.result.states, force=force)
    reports = {} if report is None else _report(outcome, report, seed, force)
    files = [str(path) for path in paths]
    if as_json:
        emit_json(_facts(outcome, seed, files, reports))
    else:
        _print(outcome, files, reports)
    if not outcome.main.result.states or outcome.problems:
        raise typer.Exit(int(ExitCode.INCONCLUSIVE))


def _check(method: str, smooth: bool, factors: str, learn_beacon: bool) -> None:
    if smooth and method != "filter":
        raise ConfigError("smooths the filter's states only", "--smooth")
    for name, is_set in (("--factors led", factors == "led"), ("--learn-beacon", learn_beacon)):
        if is_set and method != "graph":
            raise ConfigError("is an option of --method graph", name)


def _false_poses(text: str, seed: int) -> FalsePoses:
    from uvgs_bench.navigation.fusion_data import FalsePoses

    try:
        share, size = (float(word) for word in text.split(":"))
        return FalsePoses(share, size, seed)
    except ValueError:
        raise ConfigError(
            f"expected SHARE:SIZE_M with a share from 0 to 1 and a positive size, like 0.05:0.3, got '{text}'",
            "--false-poses",
        ) from None


def _report(outcome: FusionOutcome, folder: Path, seed: int, force: bool) -> dict[str, str]:
    from uvgs_bench.report import write_document
    from uvgs_bench.report.fusion_page import build_fusion_document

    document = build_fusion_document(outcome, {"seed": str(seed)})
    return {name: str(path) for name, path in write_document(document, folder, force=force).items()}


def _facts(outcome: FusionOutcome, seed: int, files: list[str], reports: dict[str, str]) -> dict[str, object]:
    from dataclasses import asdict

    return {
        "source": outcome.source.name,
        "method": outcome.main.result.method,
        "seed": seed,
        "is_simulated": outcome.source.is_simulated,
        "runs": [_run_facts(run) for run in outcome.runs],
        "sensor_alone": asdict(outcome.raw),
        "misfit": None if outcome.misfit is None else asdict(outcome.misfit),
        "false_poses": len(outcome.false_ns),
        "problems": list(outcome.problems),
        "remarks": list(outcome.remarks),
        "files": files,
        "reports": reports,
    }


def _run_facts(run: FusedRun) -> dict[str, object]:
    import numpy as np

    score, result = run.score, run.result
    has_truth, timed = len(score.error) > 0, len(result.update_us) > 0
    return {
        "name": run.name,
        "sources": list(result.sources),
        "states": len(result.states),
        "lost_share": score.lost_share,
        "position_rms_m": score.position_rms_m,
        "worst_m": score.worst_m,
        "attitude_rms_rad": score.attitude_rms_rad,
        "mean_nees_9": float(np.nanmean(score.nees)) if has_truth and np.isfinite(score.nees).any() else None,
        "mean_nis_6": {name: float(nis.mean()) for name, nis in score.nis.items() if len(nis)},
        "updates": score.counts,
        "false_believed": score.false_believed,
        "pauses": [
            {
                "start_ns": p.pause.start_ns,
                "length_s": p.pause.length_s,
                "worst_m": p.worst_m,
                "sigma_m": p.sigma_m,
                "jump_sigma": p.jump_sigma,
            }
            for p in score.pauses
        ],
        "update_median_us": float(np.median(result.update_us)) if timed else None,
        "imu_gaps": [{"t_ns": t_ns, "length_s": length_s} for t_ns, length_s in result.gaps_s],
    }


def _print(outcome: FusionOutcome, files: list[str], reports: dict[str, str]) -> None:
    import numpy as np
    from rich.markup import escape
    from rich.table import Table

    from uvgs_bench.cli.console import out, print_path
    from uvgs_bench.units import deg_from_rad, mm_from_m

    def cell(value: float, digits: int) -> str:
        return f"{value:.{digits}f}" if np.isfinite(value) else "–"

    has_truth = outcome.source.truth is not None
    title = f"{outcome.source.name}: {outcome.main.result.method}"
    table = Table(title=escape(title), title_justify="left", box=None, pad_edge=False)
    table.add_column("way", overflow="fold", min_width=15)
    headings = ("RMS mm", "worst mm", "RMS deg") if has_truth else ()
    is_wide = out.width >= _WIDE
    rest = ("σ mm", "NIS", "used", "refused", "µs") if is_wide else ("NIS", "refused")
    for heading in (*headings, *rest):
        table.add_column(heading, justify="right", no_wrap=True)
    for run in outcome.runs:
        s = run.score
        errors = (mm_from_m(s.position_rms_m), mm_from_m(s.worst_m), deg_from_rad(s.attitude_rms_rad))
        cells = [cell(v, k) for v, k in zip(errors, (2, 1, 3), strict=True)] if has_truth else []
        sigma = float(mm_from_m(np.median(s.sigma[:, :3]))) if len(s.sigma) else float("nan")
        nis = np.concatenate(list(s.nis.values())) if s.nis else np.empty(0)
        used = sum(c.get("fused", 0) + c.get("reopened", 0) for c in s.counts.values())
        refused = sum(c.get("refused", 0) for c in s.counts.values())
        spent = float(np.median(run.result.update_us)) if len(run.result.update_us) else float("nan")
        mean_nis = float(nis.mean()) if len(nis) else float("nan")
        tail = (cell(sigma, 2), cell(mean_nis, 1), str(used), str(refused), cell(spent, 0))
        table.add_row(escape(run.name), *cells, *(tail if is_wide else (tail[1], tail[3])))
    out.print(table)
    raw = outcome.raw
    if has_truth:
        out.print(
            f"sensor alone, at its captures: {mm_from_m(raw.position_rms_m):.2f} mm, "
            f"{deg_from_rad(raw.attitude_rms_rad):.3f} deg RMS; {raw.poses} poses, "
            f"silent for {raw.silent_s:.1f} s at most",
            soft_wrap=True,
        )
    for p in outcome.main.score.pauses:
        worst = f"worst error {mm_from_m(p.worst_m):.1f} mm, " if has_truth else ""
        out.print(
            f"pause of {p.pause.length_s:.1f} s: {worst}σ at its end {mm_from_m(p.sigma_m):.1f} mm, jump after it "
            f"{cell(p.jump_sigma, 1)} σ",
            soft_wrap=True,
        )
    if outcome.false_ns:
        out.print(f"{len(outcome.false_ns)} false poses, {outcome.main.score.false_believed} of them believed")
    for text in outcome.problems:
        out.print(f"[bold yellow]does not fit:[/] {escape(text)}", soft_wrap=True)
    for text in outcome.remarks:
        out.print(f"[dim]{escape(text)}[/]", soft_wrap=True)
    for name in files:
        print_path("states", name)
    for kind, name in reports.items():
        print_path(kind, name)
