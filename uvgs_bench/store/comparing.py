"""Put runs on disk side by side: what differed in the set-up, and what differs in the figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Literal

import numpy as np

from uvgs_bench.accuracy.clusters import Clusters
from uvgs_bench.accuracy.comparison import Change, compare_tables, judged
from uvgs_bench.accuracy.distributions import t_quantile
from uvgs_bench.accuracy.iso_figures import Precision, precision
from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.errors import ConfigError, RunError
from uvgs_bench.store.judging import judge_run
from uvgs_bench.units import S_PER_DAY

if TYPE_CHECKING:
    from uvgs_bench.store.run_types import Run

Baseline = Literal["first", "previous"]

_FEWEST_FOR_TREND = 4
_TAIL = 0.025
# m or rad; below the steps of any gantry, above the rounding of a file.
_SAME_TARGET = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class ComparedRun:
    """One run beside the others.

    Args:
        run: The run.
        judgement: Its errors.
        against: Number of the run it is compared with, or -1 for the first.
        setup: What of the set-up differs from that run: name, there, here.
        changes: Changes of the figures against that run; empty for the first.
        is_paired: Whether places were compared with themselves.
    """

    run: Run
    judgement: Judgement
    against: int
    setup: tuple[tuple[str, str, str], ...]
    changes: tuple[Change, ...]
    is_paired: bool


@dataclass(frozen=True, slots=True)
class Trend:
    """How a figure wanders from run to run.

    Args:
        key: The figure.
        per_day: Relative change per day.
        low: Lower end of its 95 % interval.
        high: Upper end.
    """

    key: str
    per_day: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Runs side by side, in the order of their dates.

    Args:
        runs: The runs.
        baseline: What each is compared with.
        allowed: Worsening that is tolerated, as a fraction.
        trends: One per figure, when there are enough runs on different days.
        precision: Repeatability within and reproducibility between the runs of the same places, position per axis, each
            run about its own registration; None when the runs are not of the same places.
    """

    runs: tuple[ComparedRun, ...]
    baseline: Baseline
    allowed: float
    trends: tuple[Trend, ...]
    precision: Precision | None = None

    def has(self, word: str) -> bool:
        """Whether any change got this word."""
        return any(change.word == word for compared in self.runs for change in compared.changes)


def compare_runs(
    runs: Sequence[Run], *, baseline: Baseline = "first", allowed: float = 0.0, seed: int = 0
) -> Comparison:
    """Judge every run by itself, then compare it with the first or the previous one.

    Args:
        runs: Two or more different runs, in any order.
        baseline: Whether each run is held against the first one or the one before it, by date.
        allowed: Worsening that is tolerated, as a fraction.
        seed: Seed of the percentiles' resamples.

    Returns:
        The comparison.

    Raises:
        ConfigError: Fewer than two runs, or one given twice.
        RunError: A run of which nothing can be judged, or runs of benches that move different parts.
    """
    if len(runs) < 2:
        raise ConfigError(f"comparing needs two or more runs, got {len(runs)}")
    ids = [str(run.path.resolve()) for run in runs]
    for i, name in enumerate(ids):
        if name in ids[:i]:
            raise ConfigError("is given twice", str(runs[i].path))
    ordered = sorted(runs, key=lambda run: (run.manifest.created_utc, run.manifest.id))
    mounts = {run.manifest.mount for run in ordered}
    if len(mounts) > 1:
        odd = next(run for run in ordered if run.manifest.mount != ordered[0].manifest.mount)
        raise RunError(f"has {odd.manifest.mount}, the others do not: their errors are not comparable", str(odd.path))
    judgements = [judge_run(run) for run in ordered]
    for run, judgement in zip(ordered, judgements, strict=True):
        if judgement.table is None:
            why = next((alert.text for alert in judgement.alerts if alert.level == "error"), "there are no errors")
            raise RunError(f"nothing to compare: {why}", str(run.path))
    rng = np.random.default_rng(seed)
    changes: list[tuple[Change, ...]] = []
    pairs: list[tuple[int, bool]] = []
    for i in range(1, len(ordered)):
        against = 0 if baseline == "first" else i - 1
        is_paired = _have_same_places(ordered[against], ordered[i])
        before, after = judgements[against].table, judgements[i].table
        assert before is not None
        assert after is not None
        changes.append(compare_tables(before, after, rng, is_paired=is_paired))
        pairs.append((against, is_paired))
    named = judged(changes, allowed=allowed)
    compared = [ComparedRun(ordered[0], judgements[0], -1, (), (), False)]
    for i, (against, is_paired) in enumerate(pairs, start=1):
        setup = _setup_differences(ordered[against], ordered[i])
        compared.append(ComparedRun(ordered[i], judgements[i], against, setup, named[i - 1], is_paired))
    precise = _precision(ordered, judgements, rng)
    return Comparison(tuple(compared), baseline, allowed, _trends(ordered, judgements), precise)


def _precision(runs: Sequence[Run], judgements: Sequence[Judgement], rng: np.random.Generator) -> Precision | None:
    """ISO 5725 over the runs, at the places that all of them have in common."""
    if not all(_have_same_places(runs[0], run) for run in runs[1:]):
        return None
    tables = [j.table.select(j.table.is_solved) for j in judgements if j.table is not None]
    common = set(tables[0].place.tolist())
    for table in tables[1:]:
        common &= set(table.place.tolist())
    if not common:
        return None
    kept = [table.select(np.isin(table.place, sorted(common))) for table in tables]
    errors = np.concatenate([table.translation_error_m for table in kept])
    place = np.concatenate([table.place for table in kept])
    of_run = np.repeat(np.arange(len(kept)), [table.count for table in kept])
    return precision(errors, Clusters.of(place, rng), of_run)


def _have_same_places(first: Run, second: Run) -> bool:
    """Whether a number of a place means the same target in both runs, in whatever order they were visited."""
    targets = {sample.waypoint: sample.target for sample in first.samples}
    common = [sample for sample in second.samples if sample.waypoint in targets]
    return bool(common) and all(
        sample.target.shape == targets[sample.waypoint].shape
        and float(np.abs(sample.target - targets[sample.waypoint]).max()) < _SAME_TARGET
        for sample in common
    )


def _setup_differences(first: Run, second: Run) -> tuple[tuple[str, str, str], ...]:
    """Name, value there, value here, of everything that was not the same."""
    sides = [_setup(first), _setup(second)]
    names = list(dict.fromkeys([*sides[0], *sides[1]]))
    told = ((name, sides[0].get(name, "not recorded"), sides[1].get(name, "not recorded")) for name in names)
    return tuple((name, there, here) for name, there, here in told if there != here)


def _setup(run: Run) -> dict[str, str]:
    m = run.manifest
    return {
        "bench": "simulated" if m.simulated else "hardware",
        "procedure": m.procedure_name,
        "plan": m.plan_hash[:12],
        "stations": str(m.station_count),
        "captures per station": str(m.captures_per_station),
        "settle time (s)": f"{m.settle_s:g}",
        "camera": run.calibration.camera_name,
        "lens": run.calibration.lens.model,
        "beacon": run.beacon.name,
        "camera source": m.camera_spec,
        "gantry": m.gantry_spec,
        "controller": " ".join(m.gantry_info.get(key, "") for key in ("firmware", "version")).strip(),
        "gantry's judge": m.gantry_info.get("judged_by", ""),
        **{f"file {name}": value[:12] for name, value in sorted(m.hashes.items())},
        **{f"version of {name}": value for name, value in sorted(m.versions.items())},
    }


def _trends(runs: Sequence[Run], judgements: Sequence[Judgement]) -> tuple[Trend, ...]:
    """Slope of each figure's logarithm over time, by least squares; the runs' own scatter gives its doubt."""
    if len(runs) < _FEWEST_FOR_TREND:
        return ()
    days = np.array([_day(run) for run in runs])
    x = days - days.mean()
    if not np.isfinite(x).all() or float(x @ x) <= 0.0:
        return ()
    found = []
    for component in ("position", "attitude"):
        values = [j.summary.components[component].rms.value if j.summary else float("nan") for j in judgements]
        y = np.log(np.array(values))
        if not np.isfinite(y).all():
            continue
        slope = float(x @ y / (x @ x))
        rest = y - y.mean() - slope * x
        freedom = len(runs) - 2
        reach = float(t_quantile(1.0 - _TAIL, freedom) * np.sqrt(rest @ rest / freedom / (x @ x)))
        found.append(Trend(f"{component}_rms", slope, slope - reach, slope + reach))
    return tuple(found)


def _day(run: Run) -> float:
    try:
        return datetime.fromisoformat(run.manifest.created_utc).timestamp() / S_PER_DAY
    except ValueError:
        return float("nan")
