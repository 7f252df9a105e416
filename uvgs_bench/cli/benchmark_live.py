"""``uvgs benchmark live``: whether the sensor keeps up with a live camera."""

from __future__ import annotations

from typing import Annotated

import typer

from uvgs_bench.cli.options import DEFAULT_BENCH, BenchFile, Json, Quiet, Seed


def live(
    bench: BenchFile = DEFAULT_BENCH,
    rate_hz: Annotated[float, typer.Option("--rate-hz", min=1.0, max=1000.0, help="Pictures per second.")] = 100.0,
    duration_s: Annotated[float, typer.Option("--duration-s", min=1.0, help="How long.")] = 60.0,
    track: Annotated[
        bool,
        typer.Option("--track/--no-track", help="Look for the LEDs where the last pose puts them; else each alone."),
    ] = False,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Solve pictures that another process delivers at a fixed rate; print drops and latency, picture to pose."""
    from dataclasses import asdict
    from pathlib import Path
    from tempfile import TemporaryDirectory

    from uvgs_bench.cli.console import emit_json, out, progress_sink
    from uvgs_bench.sessions.live_benchmark import benchmark_live
    from uvgs_bench.units import ms_from_s

    with TemporaryDirectory() as folder, progress_sink(quiet=quiet) as sink:
        found = benchmark_live(
            bench, Path(folder), sink, rate_hz=rate_hz, duration_s=duration_s, track=track, seed=seed
        )
    if as_json:
        emit_json({"seed": seed, "track": track, **asdict(found)})
        return
    out.print(
        f"{found.width_px}x{found.height_px} at {found.rate_hz:g} Hz: {found.answered} of {found.sent} captures "
        f"answered, {found.dropped} dropped, {found.poses} poses"
    )
    median, p99, longest = (ms_from_s(value) for value in (found.median_s, found.p99_s, found.longest_s))
    out.print(f"picture to written pose: median {median:.2f}, p99 {p99:.2f}, longest {longest:.2f} ms")
