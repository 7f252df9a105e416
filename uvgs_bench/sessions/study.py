"""Studies of the judging itself: do intervals cover, is what is planted found, how many stations does it take.

To add a study: 1. write its function in ``study_tasks.py``; 2. one function here that turns rows into ``Share``s;
3. one line in ``STUDIES``.

Source: E. B. Wilson, Probable inference, the law of succession, and statistical inference (1927).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from uvgs_bench.errors import ConfigError
from uvgs_bench.sessions.events import EventSink
from uvgs_bench.sessions.study_runner import RESULTS_FILE, Row, Work, run_benches
from uvgs_bench.sessions.study_tasks import ALONG, DIAGNOSIS_KINDS, PLANNED_HALF, PLANNING_KINDS, planning_name

Met = Literal["pass", "fail", "inconclusive", ""]

_NORMAL_95 = 1.959964
_COVERAGE = 0.95
_BAND = 0.015
_LEAST_POWER = 0.95
_MOST_FALSE_ALARMS = 0.05
_TASKS = "uvgs_bench.sessions.study_tasks"


@dataclass(frozen=True, slots=True)
class Target:
    """What a share should be.

    Args:
        low: Smallest share allowed, 0 to 1.
        high: Largest share allowed.
    """

    low: float
    high: float

    @property
    def text(self) -> str:
        """The target in words people read."""
        if self.high >= 1.0:
            return f"at least {100.0 * self.low:g} %"
        if self.low <= 0.0:
            return f"at most {100.0 * self.high:g} %"
        return f"{100.0 * self.low:g} to {100.0 * self.high:g} %"


@dataclass(frozen=True, slots=True)
class Share:
    """How often something came true.

    Args:
        name: What.
        hits: Number of benches where it did.
        count: Number of benches.
        low: Lower end of the 95 % interval of the share (Wilson), 0 to 1.
        high: Upper end.
        target: What the share should be, or None.
        verdict: ``fail`` when the interval lies beside the target; ``pass`` when it lies within, or, for a target with
            two ends, when the share lies within and the interval is no wider than the target; empty without a target.
        note: What else these benches say, or empty.
    """

    name: str
    hits: int
    count: int
    low: float
    high: float
    target: Target | None
    verdict: Met
    note: str = ""

    @property
    def share(self) -> float:
        """Hits over benches; NaN without benches."""
        return self.hits / self.count if self.count else float("nan")

    @classmethod
    def of(cls, name: str, hits: int, count: int, target: Target | None = None, note: str = "") -> Share:
        """Judge a count.

        Args:
            name: What is counted.
            hits: Number of benches where it came true.
            count: Number of benches.
            target: What the share should be.
            note: What else is to be said.

        Returns:
            The share with its interval and verdict.
        """
        low, high = wilson_interval(hits, count)
        return cls(name, hits, count, low, high, target, _verdict(hits, count, low, high, target), note)


@dataclass(frozen=True, slots=True)
class StudyResult:
    """A study as a table.

    Args:
        study: Its name.
        benches: Number of benches.
        seed: Its seed.
        shares: The lines of the table.
        remarks: What the reader must know, one line each.
        results: The file with one line per bench.
    """

    study: str
    benches: int
    seed: int
    shares: tuple[Share, ...]
    remarks: tuple[str, ...]
    results: str

    @property
    def verdict(self) -> Met:
        """``fail`` if any line fails, else ``inconclusive`` if any is, else ``pass``; empty without targets."""
        words = {share.verdict for share in self.shares} - {""}
        order: tuple[Met, ...] = ("fail", "inconclusive", "pass")
        for word in order:
            if word in words:
                return word
        return ""


@dataclass(frozen=True, slots=True)
class Study:
    """One kind of study.

    Args:
        task: What is done for a bench.
        kinds: Number of kinds of benches that take turns; each gets the number of benches asked for.
        table: From rows to the lines of the table.
        remarks: What is said below every table.
    """

    task: str
    kinds: int
    table: Callable[[Sequence[Row]], tuple[Share, ...]]
    remarks: tuple[str, ...]


def wilson_interval(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share by Wilson's score.

    Args:
        hits: Number of times it came true.
        count: Number of times it could.

    Returns:
        Lower and upper end, 0 to 1; everything when ``count`` is 0.
    """
    if count == 0:
        return 0.0, 1.0
    z2 = _NORMAL_95**2
    share, spread = hits / count, 1.0 + z2 / count
    middle = (share + 0.5 * z2 / count) / spread
    half = _NORMAL_95 / spread * float(np.sqrt(share * (1.0 - share) / count + 0.25 * z2 / count**2))
    # Exact at the ends, where rounding would leave a trace.
    return (0.0 if hits == 0 else middle - half), (1.0 if hits == count else middle + half)


def run_study(
    name: str,
    benches: int,
    seed: int,
    folder: Path,
    sink: EventSink,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    resume: bool = False,
    force: bool = False,
) -> StudyResult:
    """Run a study, or go on with one.

    Args:
        name: One of ``STUDIES``.
        benches: Number of benches of each kind.
        seed: Seed of everything random; the same seed gives the same table on any number of workers.
        folder: Where the results are kept.
        sink: Where progress goes.
        workers: Processes on this machine.
        scheduler: Address of a Dask scheduler in place of processes.
        resume: Whether to go on with the results in the folder.
        force: Whether results in the folder may be replaced.

    Returns:
        The table.

    Raises:
        ConfigError: An unknown study, or results that are there already or are of another study.
        UvgsError: No cluster, or a worker died.
    """
    if name not in STUDIES:
        raise ConfigError(f"unknown study '{name}', expected one of {', '.join(STUDIES)}", key="STUDY")
    study = STUDIES[name]
    results = folder / RESULTS_FILE
    rows = run_benches(
        Work(study.task, seed, {}),
        benches * study.kinds,
        results,
        sink,
        workers=workers,
        scheduler=scheduler,
        resume=resume,
        force=force,
    )
    return StudyResult(name, len(rows), seed, study.table(rows), study.remarks, str(results))


def _verdict(hits: int, count: int, low: float, high: float, target: Target | None) -> Met:
    if target is None:
        return ""
    if count == 0:
        return "inconclusive"
    if high < target.low or low > target.high:
        return "fail"
    if target.low <= low and high <= target.high:
        return "pass"
    has_two_ends = target.low > 0.0 and target.high < 1.0
    is_sharp = has_two_ends and high - low <= target.high - target.low
    return "pass" if is_sharp and target.low <= hits / count <= target.high else "inconclusive"


def coverage_table(rows: Sequence[Row]) -> tuple[Share, ...]:
    """How often each interval held the truth."""
    target = Target(_COVERAGE - _BAND, _COVERAGE + _BAND)
    names = list(dict.fromkeys(name for row in rows for name in row["inside"]))
    shares = []
    for name in names:
        told = [row for row in rows if name in row["inside"]]
        hits = sum(row["inside"][name] for row in told)
        open_above = sum(name in row["open"] for row in told)
        notes = []
        if open_above:
            notes.append(f"{open_above} open above")
        if len(told) < len(rows):
            notes.append(f"{len(rows) - len(told)} benches without it")
        shares.append(Share.of(name, hits, len(told), target, ", ".join(notes)))
    for part in dict.fromkeys(part for row in rows for part in row["failed"]):
        failed = sum(part in row["failed"] for row in rows)
        shares.append(Share.of(f"not stated: {part}", failed, len(rows)))
    return tuple(shares)


def diagnosis_table(rows: Sequence[Row]) -> tuple[Share, ...]:
    """How often each planted cause is named first, and how often anything is named on a clean bench."""
    shares = []
    for kind in DIAGNOSIS_KINDS:
        of_kind = [row for row in rows if row["kind"] == kind]
        told = [row["named"] for row in of_kind if "failed" not in row]
        if kind == "clean":
            alarms = sum(bool(named) for named in told)
            shares.append(Share.of("false alarm on a clean bench", alarms, len(told), Target(0.0, _MOST_FALSE_ALARMS)))
            continue
        if kind.endswith(ALONG):
            shares.append(_along_an_axis(kind, of_kind))
            continue
        first = sum(named[:1] == [kind] for named in told)
        anywhere = sum(kind in named for named in told)
        right = sum(row.get("right", False) for row in of_kind)
        alone = sum(named == [kind] for named in told)
        note = f"named at all {anywhere}, alone {alone}, right part first {right}"
        words = kind.replace("_", " ")
        # A bench that could not be registered did not name its cause.
        shares.append(Share.of(f"{words} named first", first, len(of_kind), Target(_LEAST_POWER, 1.0), note))
    return tuple(shares)


def _along_an_axis(kind: str, rows: Sequence[Row]) -> Share:
    """A cause that data may be unable to show, or to tell from another: it must then be said so."""
    cause = kind.removesuffix(ALONG)
    first = sum(row["named"][:1] == [cause] for row in rows)
    pair = sum(cause in row["alike"] for row in rows)
    beyond = sum(row["beyond"] and not row["named"] for row in rows)
    note = f"named first {first}, with what looks alike {pair}, said to be beyond this run {beyond}"
    words = kind.replace("_", " ")
    return Share.of(
        f"{words}: named, or said why not", first + pair + beyond, len(rows), Target(_LEAST_POWER, 1.0), note
    )


def planning_table(rows: Sequence[Row]) -> tuple[Share, ...]:
    """How often a number of places gives an interval of the position RMS that is narrow enough."""
    shares = []
    for places, shots, layout in PLANNING_KINDS:
        name = planning_name(places, shots, layout)
        of_kind = [row for row in rows if row["kind"] == name]
        halves = np.array([row["half"] for row in of_kind if row.get("half") is not None])
        hits = int((halves <= PLANNED_HALF).sum())
        note = f"{len(of_kind) - len(halves)} without a bound" if len(halves) < len(of_kind) else ""
        if len(halves):
            typical, most = np.quantile(halves, (0.5, 0.9))
            share = float(np.median([row["share"] for row in of_kind if "share" in row]))
            said = f"{typical:.0%}, worst tenth {most:.0%}; registration {share:.0%}"
            note = "; ".join(filter(None, (said, note)))
        shares.append(Share.of(name, hits, len(of_kind), None, note))
    return tuple(shares)


STUDIES: dict[str, Study] = {
    "coverage": Study(
        f"{_TASKS}:coverage_bench",
        1,
        coverage_table,
        (
            "Share of benches whose 95 % interval holds the truth: for spread, RMS and p95 that of 4000 other places "
            "of the same bench, for a bias 0, for registration and terms what was planted.",
            "Registration: what three linear axes can see. Axis terms: less what looks like the sensor's own scale.",
        ),
    ),
    "diagnosis": Study(
        f"{_TASKS}:diagnosis_bench",
        len(DIAGNOSIS_KINDS),
        diagnosis_table,
        (
            "Planted: LED 1 mm, axis scale 0.2 %, squareness 1 mrad, delay 20 ms, focal length 0.5 %, backlash 0.1 mm "
            "on all axes, at a random part; 36 places, 12 seen again, 12 captures in motion.",
            "The camera looks obliquely to all axes, but for the last kinds: along an axis its scale and the focal "
            "length are the same thing, and its leans hide in depth errors. There a cause counts that is named first "
            "or with what looks like it, or of which the run said that it could not show one of that size.",
        ),
    ),
    "planning": Study(
        f"{_TASKS}:planning_bench",
        len(PLANNING_KINDS),
        planning_table,
        (
            f"Share of benches where half the 95 % interval of the position RMS is at most {PLANNED_HALF:.0%} of the "
            "RMS; a third of the places registers, the others judge.",
            "Beside it: half the interval over the RMS, typical and in the worst tenth of benches, and the part the "
            "registration has in the squared errors. Boxes: 280 x 280 x 240 mm, 0.8 to 1.1 m away.",
        ),
    ),
}
"""Name of a study -> what it does."""
