"""Lead a source of captures through the sensor: live, from files, or from the pictures kept in a run."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from statistics import median

from uvgs_bench.devices.cameras.images import read_image
from uvgs_bench.errors import RunError
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.outcome import Outcome, PoseEstimate
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.sessions.events import EventSink, StageAdvanced, StageFinished, StageStarted
from uvgs_bench.store.run import Run

STAGE = "solve"


class Tally:
    """Counts outcomes as they come."""

    def __init__(self) -> None:
        self.total = 0
        self.ok = 0
        self.reasons: Counter[str] = Counter()
        self._stage_s: dict[str, list[float]] = {}

    def add(self, outcome: Outcome) -> None:
        """Count one."""
        self.total += 1
        if isinstance(outcome, PoseEstimate):
            self.ok += 1
        else:
            self.reasons[f"{outcome.stage}/{outcome.reason}"] += 1
        for stage, duration_s in outcome.stage_s.items():
            self._stage_s.setdefault(stage, []).append(duration_s)

    def median_stage_s(self) -> dict[str, float]:
        """Median duration of each stage, s, over the captures that reached it."""
        return {stage: median(values) for stage, values in self._stage_s.items()}


def solve_source(
    source: Iterable[Capture],
    uvgs: Uvgs,
    sink: EventSink,
    *,
    total: int | None = None,
    limit: int | None = None,
    track: bool = False,
    threads: int = 1,
) -> Iterator[tuple[Capture, Outcome]]:
    """Solve captures: each by itself, so that the answer depends on the picture alone, or each after the last.

    Args:
        source: Captures, an open camera source for example.
        uvgs: The sensor.
        sink: Where progress goes.
        total: Number of captures if known.
        limit: Stop after so many, or None.
        track: Hand the sensor the last pose as a prior while there is one.
        threads: How many threads OpenCV may use; the compiled kernels always use one, so 1 is deterministic real time.

    Yields:
        Each capture with its outcome.

    Raises:
        CaptureError: The source fails.
        CalibrationError: A picture has another size than the calibration.
    """
    known = [n for n in (total, limit) if n is not None]
    sink(StageStarted(STAGE, min(known) if known else None))
    tally = Tally()
    prior: PoseEstimate | None = None
    if limit is None or limit > 0:
        for capture in source:
            _limit_threads(threads)
            outcome = uvgs.solve(capture, prior)
            prior = outcome if track and isinstance(outcome, PoseEstimate) else None
            tally.add(outcome)
            sink(StageAdvanced(STAGE, tally.total, capture.source))
            yield capture, outcome
            if limit is not None and tally.total >= limit:
                break
    sink(StageFinished(STAGE, f"{tally.ok} poses of {tally.total} captures"))


def _limit_threads(threads: int) -> None:
    """Tell OpenCV, once something has loaded it; loading it only for this would cost its memory."""
    cv2 = sys.modules.get("cv2")
    if cv2 is not None and cv2.getNumThreads() != threads:
        cv2.setNumThreads(threads)


def run_captures(run: Run) -> list[tuple[int, str]]:
    """Which pictures of a run are kept.

    Args:
        run: The run.

    Returns:
        Position in ``run.samples`` and picture file of each, in order.

    Raises:
        RunError: None is kept.
    """
    kept = [(i, sample.capture_file) for i, sample in enumerate(run.samples) if sample.capture_file]
    if not kept:
        raise RunError(
            "no picture of this run is kept, so it cannot be solved again (sweep with --keep all)", str(run.path)
        )
    return kept


def read_run_captures(run: Run) -> Iterator[Capture]:
    """The kept pictures of a run as captures with their recorded instants.

    Args:
        run: The run.

    Yields:
        Captures; ``source`` is the picture's file within the run, ``index`` the sample's.

    Raises:
        RunError: No picture is kept.
        CaptureError: A picture cannot be read.
    """
    for position, name in run_captures(run):
        sample = run.samples[position]
        yield Capture(read_image(run.path / name), sample.t_ns, name, sample.index)
