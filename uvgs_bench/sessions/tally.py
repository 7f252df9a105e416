"""Counts of a stream as it runs: poses, held poses, misses by reason, flags, and how long each stage took."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import floor, log10

from uvgs_bench.interop.trajectories import LineNote
from uvgs_bench.sensor.handover import Held
from uvgs_bench.sensor.outcome import Outcome, PoseEstimate

_BINS_PER_DECADE = 100
_FIRST_S, _DECADES = 1e-7, 10
ALL_STAGES = "all stages"
LATENCY = "capture to answer"


class StageTimes:
    """Durations of one stage in a histogram of fixed size, so that a day of captures takes no more memory."""

    def __init__(self) -> None:
        self.count = 0
        self.longest_s = 0.0
        self._bins = [0] * (_BINS_PER_DECADE * _DECADES)

    def add(self, duration_s: float) -> None:
        """Count one, s."""
        place = floor(log10(max(duration_s, _FIRST_S) / _FIRST_S) * _BINS_PER_DECADE)
        self._bins[min(place, len(self._bins) - 1)] += 1
        self.count += 1
        self.longest_s = max(self.longest_s, duration_s)

    def quantile_s(self, share: float) -> float:
        """The duration that this share does not exceed, s, right to 1.2 %; 0 when nothing was counted."""
        wanted, seen = share * self.count, 0
        for place, count in enumerate(self._bins):
            seen += count
            if count and seen >= wanted:
                middle_s: float = _FIRST_S * 10.0 ** ((place + 0.5) / _BINS_PER_DECADE)
                return min(middle_s, self.longest_s)
        return 0.0

    def histogram(self, bins_per_decade: int = 5) -> list[tuple[float, int]]:
        """Coarser bins, from the first to the last that is not empty: lower edge, s, and count."""
        step = _BINS_PER_DECADE // bins_per_decade
        coarse = [sum(self._bins[k : k + step]) for k in range(0, len(self._bins), step)]
        filled = [k for k, count in enumerate(coarse) if count]
        if not filled:
            return []
        return [(_FIRST_S * 10.0 ** (k / bins_per_decade), coarse[k]) for k in range(filled[0], filled[-1] + 1)]


@dataclass(slots=True)
class BeaconCount:
    """Lines of one beacon.

    Args:
        poses: Fresh poses.
        held: Repeated poses; their misses are counted as misses too.
        misses: Count of each ``stage/reason``.
        flags: Count of each flag.
        active: Captures in which it was the one believed.
    """

    poses: int = 0
    held: int = 0
    misses: Counter[str] = field(default_factory=Counter)
    flags: Counter[str] = field(default_factory=Counter)
    active: int = 0


class Tally:
    """Counts lines as they come.

    Args:
        beacons: Names of the beacons.
    """

    def __init__(self, beacons: tuple[str, ...]) -> None:
        self.captures = 0
        self.exposure_changes = 0
        self.dropped = 0
        self.gaps_s: tuple[float, ...] = ()
        self.beacons = {name: BeaconCount() for name in beacons}
        self.stages: dict[str, StageTimes] = {}

    @property
    def poses(self) -> int:
        """Fresh poses of all beacons."""
        return sum(count.poses for count in self.beacons.values())

    @property
    def held(self) -> int:
        """Repeated poses of all beacons."""
        return sum(count.held for count in self.beacons.values())

    @property
    def misses(self) -> Counter[str]:
        """Misses of all beacons by ``stage/reason``."""
        return sum((count.misses for count in self.beacons.values()), Counter())

    def add(self, beacon: str, outcome: Outcome | Held, flags: tuple[str, ...] = (), *, is_active: bool = True) -> None:
        """Count one line.

        Args:
            beacon: Its beacon.
            outcome: What stands in it.
            flags: Flags besides the outcome's own.
            is_active: Whether the beacon is the one believed.
        """
        counts = self.beacons[beacon]
        counts.active += is_active
        told = outcome.miss if isinstance(outcome, Held) else outcome
        counts.held += isinstance(outcome, Held)
        if isinstance(told, PoseEstimate):
            counts.poses += 1
            flags = (*told.flags, *flags)
        else:
            counts.misses[f"{told.stage}/{told.reason}"] += 1
        counts.flags.update(flags)
        for stage, duration_s in told.stage_s.items():
            self._times(stage).add(duration_s)
        if told.stage_s:
            self._times(ALL_STAGES).add(sum(told.stage_s.values()))

    def take(self, lines: Mapping[str, tuple[Outcome | Held, LineNote]], latency_s: float | None = None) -> None:
        """Count a capture.

        Args:
            lines: Its outcome and note by beacon.
            latency_s: How long after its instant it was answered, s; None for a recording.
        """
        if latency_s is not None:
            self._times(LATENCY).add(latency_s)
        for name, (outcome, note) in lines.items():
            self.add(name, outcome, note.flags, is_active=note.is_active)
        self.captures += 1
        self.exposure_changes += any(note.next_exposure_s for _, note in lines.values())

    def median_stage_s(self) -> dict[str, float]:
        """Median duration of each stage, s, over the captures that reached it."""
        return {stage: times.quantile_s(0.5) for stage, times in self.stages.items()}

    def _times(self, stage: str) -> StageTimes:
        return self.stages.setdefault(stage, StageTimes())
