"""The figures of following: rendered pictures, the sensor as it is, a simulated free-flyer."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

from uvgs_bench.sessions.events import EventSink, ignore_events
from uvgs_bench.sessions.figures_table import Figure
from uvgs_bench.sessions.follow import follow, simulated_margin
from uvgs_bench.sessions.follow_scenario import SCENARIOS, FollowFaults
from uvgs_bench.sessions.follow_setup import read_follow_setup
from uvgs_bench.store.workspace import examples_folder
from uvgs_bench.units import mm_from_m

_STEADY_MM = 10.0
# Share of the latency the loop bears that is promised: at the limit itself an error lives on for ever.
_PROMISED = 0.8
# The loop is linear and its body is not quite; the two may differ by this share, and by what a bisection leaves.
_AGREEMENT = 0.1


def follow_figures(seed: int = 0, bench: Path | None = None, sink: EventSink = ignore_events) -> tuple[Figure, ...]:
    """Follow a 30 cm square at 0.5 m, 5 cm/s, and hold a station at the latency that is printed.

    Args:
        seed: Seed of everything random.
        bench: The bench file whose camera and beacon are taken; the shipped one when None.
        sink: Receives progress.

    Returns:
        One row per figure.

    Raises:
        UvgsError: A file is broken, or the temporary folder cannot be written.
    """
    described = examples_folder() / "calib" / "bench.toml" if bench is None else bench
    square = read_follow_setup(SCENARIOS["square"], described, seed=seed)
    margins = square.margins()
    tried_s = simulated_margin(square, margins)
    promised_s = _PROMISED * min(margins.largest_latency_s, tried_s)
    added_s = max(promised_s - margins.latency_s, 0.0)
    late = read_follow_setup(SCENARIOS["hold"], described, FollowFaults(latency_s=added_s), seed)
    # Already at the station, so that what is seen is whether the error stays small.
    late = replace(late, scenario=replace(late.scenario, start_error_mm=(10.0, 0.0, 0.0)))
    with tempfile.TemporaryDirectory() as folder:
        on_time = follow(square, Path(folder), tried_s=tried_s, sink=sink)
        delayed = follow(late, Path(folder), tried_s=tried_s, sink=sink)
    quality, held = on_time.quality, delayed.quality
    agreement = tried_s / margins.largest_latency_s
    is_stable = delayed.run.ending == "completed" and held.steady_worst_m <= 1e-2 and promised_s > 0.0
    return (
        _row("follower, square 5 cm/s at 0.5 m: steady error, worst", mm_from_m(quality.steady_worst_m), _STEADY_MM),
        _row("  the same while the leader is on its way", mm_from_m(quality.cruise_worst_m), _STEADY_MM),
        Figure("  overshoot at corners, worst", "", mm_from_m(quality.overshoot_m or 0.0), "mm", None),
        Figure("  largest error at corners", "", mm_from_m(quality.worst_m), "mm", None),
        Figure("follower: latency borne, by the loop", "", margins.largest_latency_s, "s", None),
        Figure("  the same by trying", f"within {_AGREEMENT:.0%}", tried_s, "s", abs(agreement - 1.0) <= _AGREEMENT),
        Figure("  latency promised, held with rendered pictures", "stable", promised_s, "s", is_stable),
    )


def _row(name: str, measured_mm: float, limit_mm: float) -> Figure:
    return Figure(name, f"<= {limit_mm:g} mm", measured_mm, "mm", bool(measured_mm <= limit_mm))
