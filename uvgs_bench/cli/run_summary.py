"""What ``uvgs run`` says at its end: counts, reasons, flags, times, and where the lines were kept."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from uvgs_bench.sessions.tally import BeaconCount, StageTimes, Tally

_BAR_WIDTH = 24


def show_summary(
    tally: Tally,
    paths: Sequence[Path],
    *,
    timing: bool,
    as_json: bool,
    is_interrupted: bool = False,
    failures: Sequence[str] = (),
) -> None:
    """Print the end of a stream: one JSON object, or tables for people.

    Args:
        tally: The counts.
        paths: The files that were written.
        timing: Whether to show the durations of the stages as histograms.
        as_json: Whether to print JSON.
        is_interrupted: Whether it was stopped before its end.
        failures: What could not be kept, a line each.
    """
    from uvgs_bench.cli.console import emit_json

    if as_json:
        emit_json(_as_object(tally, paths, timing, is_interrupted) | {"failures": list(failures)})
        return
    _show(tally, timing)
    from rich.markup import escape

    from uvgs_bench.cli.console import out

    word = "[yellow]interrupted[/]: " if is_interrupted else ""
    where = escape(", ".join(str(path) for path in paths))
    held = f", {tally.held} held" if tally.held else ""
    misses = tally.misses.total()
    poses = f"{tally.poses} {'pose' if tally.poses == 1 else 'poses'}"
    kept = f"kept in {where}" if paths else "told, no file was asked for"
    out.print(f"{word}{poses}, {misses} {'miss' if misses == 1 else 'misses'}{held} {kept}", soft_wrap=True)
    for text in failures:
        out.print(f"[red]not whole:[/] {escape(text)}", soft_wrap=True)


def _as_object(tally: Tally, paths: Sequence[Path], timing: bool, is_interrupted: bool) -> dict[str, object]:
    result: dict[str, object] = {
        "captures": tally.captures,
        "poses": tally.poses,
        "held": tally.held,
        "misses": dict(tally.misses.most_common()),
        "beacons": {
            name: {
                "poses": count.poses,
                "held": count.held,
                "active_captures": count.active,
                "misses": dict(count.misses.most_common()),
                "flags": dict(count.flags.most_common()),
            }
            for name, count in tally.beacons.items()
        },
        "exposure_changes": tally.exposure_changes,
        "dropped": tally.dropped,
        "gaps_s": list(tally.gaps_s),
        "median_stage_s": tally.median_stage_s(),
        "interrupted": is_interrupted,
        "out": str(paths[0]) if len(paths) == 1 else [str(path) for path in paths],
    }
    if timing:
        result["stage_times"] = {
            stage: {
                "count": times.count,
                "median_s": times.quantile_s(0.5),
                "p95_s": times.quantile_s(0.95),
                "p99_s": times.quantile_s(0.99),
                "longest_s": times.longest_s,
                "histogram": [{"from_s": edge_s, "count": count} for edge_s, count in times.histogram()],
            }
            for stage, times in tally.stages.items()
        }
    return result


def _show(tally: Tally, timing: bool) -> None:
    from rich.table import Table

    from uvgs_bench.cli.console import out
    from uvgs_bench.units import ms_from_s

    several = len(tally.beacons) > 1
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_row("captures", str(tally.captures))
    for name, count in tally.beacons.items():
        if several:
            table.add_row(f"[bold]{name}[/]", f"active in {count.active}")
        _add_counts(table, count)
    if tally.dropped:
        table.add_row("[yellow]dropped[/]", f"{tally.dropped}, the sensor was busy")
    if tally.gaps_s:
        table.add_row("[yellow]camera lost[/]", ", ".join(f"{gap_s:.1f} s" for gap_s in tally.gaps_s))
    if tally.exposure_changes:
        table.add_row("exposure", f"changed {tally.exposure_changes} times")
    if not timing:
        for stage, duration_s in tally.median_stage_s().items():
            table.add_row(f"[dim]median {stage}[/]", f"{ms_from_s(duration_s):.3f} ms")
    out.print(table)
    if timing:
        for stage, times in tally.stages.items():
            _show_times(stage, times)


def _add_counts(table: object, count: BeaconCount) -> None:
    from rich.table import Table

    assert isinstance(table, Table)
    table.add_row("[green]poses[/]", str(count.poses))
    if count.held:
        table.add_row("[yellow]held[/]", str(count.held))
    for reason, number in count.misses.most_common():
        table.add_row(f"[yellow]miss[/] {reason}", str(number))
    for flag, number in count.flags.most_common():
        table.add_row(f"[dim]flag[/] {flag}", str(number))


def _show_times(stage: str, times: StageTimes) -> None:
    from uvgs_bench.cli.console import out
    from uvgs_bench.units import ms_from_s

    median, p95, p99 = (ms_from_s(times.quantile_s(share)) for share in (0.5, 0.95, 0.99))
    out.print(
        f"\n[bold]{stage}[/]  median {median:.3g}, p95 {p95:.3g}, p99 {p99:.3g}, max "
        f"{ms_from_s(times.longest_s):.3g} ms"
    )
    rows = times.histogram()
    most = max(count for _, count in rows)
    for edge_s, count in rows:
        bar = "█" * round(_BAR_WIDTH * count / most) or ("▏" if count else "")
        out.print(f"  from {ms_from_s(edge_s):8.3g} ms  {count:7d}  [cyan]{bar}[/]")
