"""The figures of the paper's missions on the simulated bench: maneuvers, hand-over, SVGS beside uVGS-2."""

from __future__ import annotations

import importlib
import math
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from uvgs_bench.devices.sim.bench import SimulatedBench
from uvgs_bench.geometry.se3 import rotation_angle
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.sessions.bench_setup import read_setup, sweep
from uvgs_bench.sessions.events import EventSink, StageFinished, StageStarted, ignore_events
from uvgs_bench.sessions.figures_table import Figure
from uvgs_bench.store.judging import judge_run
from uvgs_bench.store.run import Run, Sample, read_run
from uvgs_bench.store.workspace import examples_folder
from uvgs_bench.units import deg_from_rad, mm_from_m, ms_from_s, rad_from_deg

# A pose farther than this from the truth belongs to another beacon, or to none: beacons stand 240 mm apart or more.
_WRONG_M, _WRONG_RAD = 0.02, rad_from_deg(3.0)
# Root mean square over the six components; 1 in 10000 steps of honest doubt is larger.
_STEP_SIGMAS = 2.1
_DYNAMIC_MM, _LAG_MS = 1.0, 2.0

MISSIONS: dict[str, str] = {
    "maneuvers": "uvgs_bench.sessions.mission_benchmark:maneuver_figures",
    "handover": "uvgs_bench.sessions.mission_benchmark:handover_figures",
    "fusion": "uvgs_bench.sessions.fusion_benchmark:fusion_figures",
    "follow": "uvgs_bench.sessions.follow_benchmark:follow_figures",
}
"""Name of a part of the benchmark -> function of the seed that gives its figures."""


@dataclass(frozen=True, slots=True)
class HandoverQuality:
    """What a run past several beacons showed, against the truth of the simulated bench.

    Args:
        pose_count: Poses of the motion.
        wrong_count: Those that belong to another beacon.
        handover_count: How often another beacon gave the poses.
        worst_step_m: Largest step of the group's place between the poses around a hand-over, less the true motion, m.
        worst_step_sigmas: Largest such step of the whole pose over its stated doubt, root mean square of six.
        held_count: Captures whose miss was filled by a held pose.
        unflagged_count: Misses within the hold time that are not flagged as held.
    """

    pose_count: int
    wrong_count: int
    handover_count: int
    worst_step_m: float
    worst_step_sigmas: float
    held_count: int
    unflagged_count: int


def handover_quality(run: Run, twin: SimulatedBench, hold_s: float) -> HandoverQuality:
    """Hold the poses of a motion past several beacons against the truth.

    Args:
        run: The run.
        twin: The simulated bench it was taken on.
        hold_s: How long a pose was to be held, s.

    Returns:
        What it showed.
    """
    moving = [sample for sample in run.samples if sample.active]
    wrong = handovers = held = unflagged = 0
    step_m = step_sigmas = 0.0
    before: tuple[PoseEstimate, np.ndarray] | None = None
    for sample in moving:
        outcome = sample.outcome
        if not isinstance(outcome, PoseEstimate):
            held += sample.held_age_s is not None
            is_recent = before is not None and outcome.t_ns - before[0].t_ns <= hold_s * 1e9
            unflagged += bool(is_recent and sample.held_age_s is None)
            continue
        truth = twin.true_camera_from_beacon(outcome.t_ns)
        error = outcome.camera_from_beacon @ truth.inverse()
        off_m = float(np.linalg.norm(outcome.camera_from_beacon.t_m - truth.t_m))
        wrong += off_m > _WRONG_M or rotation_angle(error.R) > _WRONG_RAD
        xi = error.log()
        if before is not None and before[0].beacon != outcome.beacon:
            handovers += 1
            change = xi - before[1]
            doubt = outcome.covariance + before[0].covariance
            step_sigmas = max(step_sigmas, math.sqrt(float(change @ np.linalg.solve(doubt, change)) / 6.0))
            last_truth = twin.true_camera_from_beacon(before[0].t_ns)
            last_off = before[0].camera_from_beacon.t_m - last_truth.t_m
            step_m = max(step_m, float(np.linalg.norm(outcome.camera_from_beacon.t_m - truth.t_m - last_off)))
        before = (outcome, xi)
    poses = sum(sample.is_solved for sample in moving)
    return HandoverQuality(poses, wrong, handovers, step_m, step_sigmas, held, unflagged)


def mission_figures(
    seed: int = 0, parts: Sequence[str] = (), sink: EventSink = ignore_events
) -> Iterator[tuple[str, tuple[Figure, ...]]]:
    """The rows of ``uvgs benchmark missions``.

    Args:
        seed: Seed of everything random.
        parts: Names in ``MISSIONS``; all when empty.
        sink: Receives progress.

    Yields:
        Name of each part and its rows, as soon as they are known.

    Raises:
        UvgsError: A shipped file is missing, a library of an extra is not installed, or the temporary folder cannot be
            written.
    """
    for part in parts or MISSIONS:
        module, name = MISSIONS[part].split(":")
        figures = getattr(importlib.import_module(module), name)
        sink(StageStarted(part, 1))
        yield part, tuple(figures(seed))
        sink(StageFinished(part, "measured"))


def maneuver_figures(seed: int = 0, sink: EventSink = ignore_events, captures_hz: float = 2.0) -> tuple[Figure, ...]:
    """The 30 cm square without stops, by uVGS-2 and by the SVGS baseline: the paper's before and after.

    Args:
        seed: Seed of the simulated bench.
        sink: Receives progress.
        captures_hz: Captures per second.

    Returns:
        The rows.
    """
    rows: list[Figure] = []
    for title, sensor, is_promised in (("uVGS-2", None, True), ("SVGS baseline", "svgs.toml", False)):
        with _taken("svgs_maneuver_2c.toml", "bench.toml", seed, captures_hz, sink, sensor) as (run, _):
            rows += _motion_rows(title, run, is_promised)
    return tuple(rows)


def handover_figures(seed: int = 0, sink: EventSink = ignore_events, captures_hz: float = 4.0) -> tuple[Figure, ...]:
    """Maneuver 3A and 3B past four beacons by hue.

    Args:
        seed: Seed of the simulated bench.
        sink: Receives progress.
        captures_hz: Captures per second.

    Returns:
        The rows.
    """
    rows: list[Figure] = []
    for name in ("3a", "3b"):
        procedure, bench = f"svgs_maneuver_{name}.toml", "bench_maneuvers.toml"
        with _taken(procedure, bench, seed, captures_hz, sink, None) as (run, twin):
            hold_s = 3.0 if name == "3a" else 10.0
            q = handover_quality(run, twin, hold_s)
        what = f"maneuver {name.upper()}, four beacons"
        sigmas = q.worst_step_sigmas if q.handover_count else math.nan
        is_small = q.handover_count >= 3 and sigmas <= _STEP_SIGMAS
        rows += [
            Figure(f"{what}: poses of a wrong beacon", "0", q.wrong_count, f"of {q.pose_count}", q.wrong_count == 0),
            Figure("  hand-overs", "3", q.handover_count, "", q.handover_count == 3),
            Figure("  step at hand-over over stated sigma, worst", f"<= {_STEP_SIGMAS}", sigmas, "sigma", is_small),
            Figure("  the same step of the place", "", mm_from_m(q.worst_step_m), "mm", None),
            Figure("  held poses not flagged", "0", q.unflagged_count, f"of {q.held_count}", q.unflagged_count == 0),
        ]
    return tuple(rows)


def _motion_rows(title: str, run: Run, is_promised: bool) -> Iterator[Figure]:
    moving = [sample for sample in run.samples if sample.is_moving]
    judgement = judge_run(run)
    found = {q.key: q.estimate.value for q in judgement.quantities if not q.group}
    cpu_s = [sum(sample.outcome.stage_s.values()) for sample in moving]
    position_mm = mm_from_m(found["dynamic_position_rms"])
    lag_ms = ms_from_s(found["lag"])
    is_met = position_mm <= _DYNAMIC_MM if is_promised else None
    wanted = f"<= {_DYNAMIC_MM:g} mm" if is_promised else ""
    yield Figure(f"30 cm square without stops, {title}: position RMS", wanted, position_mm, "mm", is_met)
    yield Figure("  attitude RMS", "", deg_from_rad(found["dynamic_attitude_rms"]), "deg", None)
    yield Figure("  position RMS at rest", "", mm_from_m(found["absolute_position_rms"]), "mm", None)
    yield Figure(
        "  lag of poses behind their stamps",
        f"+-{_LAG_MS:g} ms" if is_promised else "",
        lag_ms,
        "ms",
        abs(lag_ms) <= _LAG_MS if is_promised else None,
    )
    yield Figure("  captures with a pose", "", 100.0 * _share(moving), "%", None)
    yield Figure("  time per capture, median (loaded machine)", "", ms_from_s(float(np.median(cpu_s))), "ms", None)


def _share(samples: Sequence[Sample]) -> float:
    return sum(sample.is_solved for sample in samples) / max(len(samples), 1)


@contextmanager
def _taken(
    procedure: str, bench: str, seed: int, captures_hz: float, sink: EventSink, sensor: str | None
) -> Iterator[tuple[Run, SimulatedBench]]:
    """Drive a shipped procedure on a shipped simulated bench, pictures not kept; the run, and the bench's truth."""
    examples = examples_folder()
    set_up = read_setup(
        examples / "procedures" / procedure,
        examples / "calib" / bench,
        seed=seed,
        sensor=None if sensor is None else examples / "calib" / "sensors" / sensor,
    )
    motion = set_up.plan.motion
    assert motion is not None
    slower = replace(motion, captures_hz=min(captures_hz, motion.captures_hz))
    set_up = replace(set_up, plan=replace(set_up.plan, motion=slower))
    twins: list[SimulatedBench] = []
    with tempfile.TemporaryDirectory() as folder:
        result = sweep(set_up, Path(folder), keep="none", sink=sink, on_bench=twins.append)
        yield read_run(result.path), twins[0]
