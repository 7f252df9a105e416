"""Short sweeps over a bad line, resumed until they are whole: what may never happen is asserted on the way.

``python -m tests.helpers.fault_runs FIRST COUNT [KIND,KIND STRENGTH]`` runs many and prints how they ended.
"""

from __future__ import annotations

import itertools
import os
import re
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.helpers.fake_rig import FakeCamera
from tests.helpers.grbl_ports import linear_axes
from uvgs_bench.devices.clock import SteppedClock
from uvgs_bench.devices.gantry import Envelope, open_gantry
from uvgs_bench.devices.sim import bench as sim_bench
from uvgs_bench.devices.sim.grbl_device import GrblDevice
from uvgs_bench.devices.sim.grbl_uvgs import UvgsDevice
from uvgs_bench.errors import EnvelopeError, UvgsError
from uvgs_bench.geometry import Pose
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.outcome import Outcome, PoseEstimate
from uvgs_bench.sessions.patterns import Line
from uvgs_bench.sessions.planning import plan
from uvgs_bench.sessions.procedure import Procedure
from uvgs_bench.sessions.resume import resume_sweep
from uvgs_bench.sessions.sweep import Rig, run_sweep
from uvgs_bench.store import run as run_module
from uvgs_bench.store.run import RunManifest, RunWriter, read_run

KINDS = ("drop", "corrupt", "delay", "reset", "alarm", "unplug")
# Highest probability of each: a run has some 2000 bytes and 60 messages, so about one fault of each kind a run.
HIGHEST = {"drop": 1e-3, "corrupt": 1e-3, "delay": 0.05, "reset": 0.02, "alarm": 0.02, "unplug": 0.02}
AXES = linear_axes(travel_m=0.05)
BOX = np.array([[-0.03, -0.03, -0.05], [-0.025, -0.025, 0.0]])
# Half a step of 2.5 um and the last digit of a report.
AT_M = 2.5e-6
ATTEMPTS = 4
_MOVE = re.compile(r"^(?:\$J=G21G90G53|G21G90G53G1)X(-?[\d.]+)Y(-?[\d.]+)Z(-?[\d.]+)F([\d.]+)$")
_SEAL = re.compile(r"^N\d+ |\*[0-9A-F]{2}$")


@dataclass(frozen=True)
class FaultRun:
    """How one ended: ``done``, ``resumed`` or ``refused`` at the first attempt, with the reason."""

    first: str
    reason: str
    attempts: int


class _Log:
    """Everything on the wire, kept and put into the run as soon as there is one."""

    def __init__(self) -> None:
        self.events: list[tuple[str, str]] = []
        self.writer: RunWriter | None = None

    def __call__(self, t_ns: int, direction: str, text: str) -> None:
        self.events.append((direction, text))
        if self.writer is not None:
            self.writer.wire(t_ns, direction, text)


class _TruthSensor:
    """Sees the carriage where the motors are."""

    def __init__(self, device: GrblDevice) -> None:
        self.device = device

    def solve(self, capture: Capture, prior: PoseEstimate | None = None) -> Outcome:
        t_m = self.device.position_at(capture.t_ns) + np.array([0.0, 0.0, 1.0])
        return PoseEstimate(
            Pose(np.eye(3), t_m, "camera", "beacon"), 1e-10 * np.eye(6), capture.t_ns, "fake",
            np.zeros((4, 2)), np.zeros((4, 2)), 0.1, 9.0, 4,
        )  # fmt: skip


def spec_with(rng: np.random.Generator, kinds: tuple[str, ...], strength: float) -> str:
    """A spec with random kinds of faults."""
    chosen = {k: float(rng.uniform(0.0, strength * HIGHEST[k])) for k in kinds if rng.random() < 0.6}
    options = "&".join(f"{name}={value:.6f}" for name, value in chosen.items())
    return f"grbl:fault+sim://faulty?{options}&seed={int(rng.integers(1 << 31))}"


def check_wire(events: list[tuple[str, str]], envelope: Envelope, start: np.ndarray) -> None:
    """Nothing that the driver ever put on the wire leaves the envelope."""
    at = start
    for direction, text in events:
        if direction == ">!":
            assert text in ("0x18", "0x3F", "0x85", "0x21", "0xF0"), text
        elif direction == ">":
            text = _SEAL.sub("", text)
            if text in ("$I", "$$", "$#", "$S", "$H", "G4P0.01"):
                continue
            move = _MOVE.match(text)
            assert move, text
            target = np.array([float(word) for word in move.groups()[:3]]) / 1000.0
            envelope.check_point(target)
            assert 0.0 < float(move.group(4)) <= 3000.0 * 3**0.5 + 0.01
            at = target
    assert np.all(np.isfinite(at))


def fault_run(seed: int, folder: Path, kinds: tuple[str, ...] = KINDS, strength: float = 1.0) -> FaultRun:
    """One sweep over a bad line, resumed over bad lines and at last over a good one.

    Raises:
        AssertionError: Something left the envelope, a sample is lost, doubled or wrong, or an end has no reason.
    """
    rng = np.random.default_rng(seed)
    envelope = Envelope(AXES, (BOX,) if rng.random() < 0.2 else ())
    ends = rng.uniform(-0.048, -0.002, (2, 3))
    line = Line(
        start={f"{a.name}_mm": 1000 * v for a, v in zip(AXES, ends[0], strict=True)},
        end={f"{a.name}_mm": 1000 * v for a, v in zip(AXES, ends[1], strict=True)},
        count=3,
    )
    try:
        planned = plan(Procedure("faulty", line, 0.05, settle_s=0.05, captures_per_station=2), envelope)
    except UvgsError as error:
        return FaultRun("refused", str(error), 0)
    device = (UvgsDevice if rng.random() < 0.25 else GrblDevice).for_axes(AXES, boot_s=0.05)
    # Reports with and without the machine position, other speeds, accelerations and homing.
    device.settings[10] = float(rng.choice([0, 1, 2, 3, 3, 3]))
    device.settings[27] = float(rng.choice([1.0, 2.0]))
    for i in range(3):
        device.settings[110 + i] = float(rng.uniform(1000.0, 3000.0))
        device.settings[120 + i] = float(rng.uniform(50.0, 200.0))
    path = folder / f"run-{seed}"
    manifest = RunManifest(
        id=path.name, created_utc="2026-01-01T00:00:00.000Z", procedure_name="faulty", mount="beacon_on_carriage",
        axes=AXES, plan_hash=planned.plan_hash, station_count=len(planned.stations), captures_per_station=2,
        keep="none",
    )  # fmt: skip
    first, reason, kept = "", "", {}
    clock = SteppedClock()
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sim_bench._live, "faulty", SimpleNamespace(clock=clock, device=device))
        patch.setattr(run_module, "_read_setup", lambda folder: (None, None))
        patch.setattr(os, "fsync", lambda _file: None)  # of a power failure other tests speak
        for attempt in itertools.count(1):
            spec = spec_with(rng, kinds, strength) if attempt < ATTEMPTS else "grbl:sim://faulty"
            log = _Log()
            ended = "done"
            try:
                with open_gantry(spec, envelope, clock=clock, log=log) as gantry:
                    rig = Rig(gantry, FakeCamera(clock), _TruthSensor(device), clock)  # type: ignore[arg-type]
                    if path.exists():
                        run = read_run(path)
                        log.writer = writer = RunWriter.reopen(run, clock.now_ns())
                        resume_sweep(run, planned, rig, writer)
                    else:
                        log.writer = writer = RunWriter.create(path, manifest, {})
                        run_sweep(planned, rig, writer)
            except EnvelopeError as error:
                # The way from home to the first waypoint meets the box, which only the controller's home tells.
                return FaultRun("refused", str(error), attempt)
            except UvgsError as error:
                ended, reason = ("resumed" if path.exists() else "refused"), reason or str(error)
            finally:
                check_wire(log.events, envelope, np.full(3, -0.0125))
            assert ended == "done" or reason.strip()
            first = first or ended
            kept = _check_kept(path, kept, device)
            if ended == "done":
                break
            assert attempt < ATTEMPTS, f"a good line does not end well: {error_text(path, reason)}"
            clock.sleep(20.0)  # what was under way when the port vanished comes to its end
            _check_motors(device, clock)
        _check_motors(device, clock)
        run = read_run(path)
        assert run.is_complete
        assert [(s.station, s.shot) for s in run.samples] == [(i, j) for i in range(3) for j in range(2)]
        for sample in run.samples:
            assert np.allclose(sample.target, planned.stations[sample.station].target, atol=1e-9)
    return FaultRun(first, reason, attempt)


def error_text(path: Path, reason: str) -> str:
    return f"{path}: {reason}"


def _check_kept(path: Path, before: dict[tuple[int, int], np.ndarray], device: GrblDevice) -> dict:
    """Every committed sample stays, none is doubled, and each was taken where its station is."""
    if not path.exists():
        return before
    run = read_run(path)
    places = {}
    for sample in run.samples:
        key = (sample.station, sample.shot)
        assert key not in places, f"doubled {key}"
        outcome = sample.outcome
        assert isinstance(outcome, PoseEstimate)
        places[key] = outcome.camera_from_beacon.t_m
        truth = places[key] - np.array([0.0, 0.0, 1.0])
        assert np.all(np.abs(truth - sample.position) <= AT_M), f"false position {1e3 * (truth - sample.position)} mm"
    for station in {s for s, _ in before}:
        if {(station, 0), (station, 1)} <= set(before):
            for shot in range(2):
                assert np.array_equal(before[station, shot], places[station, shot]), f"lost {station, shot}"
    return places


def _check_motors(device: GrblDevice, clock: SteppedClock) -> None:
    """No motor was ever beyond the travel, and all are at rest."""
    device.take_output(clock.now_ns())
    for motion in device._planner.motors._motions:
        for end in (motion.start, motion.end):
            assert np.all(end >= -50.0 - 0.003), end
            assert np.all(end <= 0.0 + 1.1), end  # homing looks for the switch at 0 and stops a little beyond
    assert np.all(device.velocity_at(clock.now_ns()) == 0.0)


def main(first: int, count: int, kinds: str = ",".join(KINDS), strength: str = "1") -> int:
    """Run many; print the tally and every violation."""
    tally: Counter[str] = Counter()
    reasons: Counter[str] = Counter()
    violations = 0
    shm = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shm if shm.is_dir() else None) as folder:
        for seed in range(first, first + count):
            try:
                result = fault_run(seed, Path(folder), tuple(kinds.split(",")), float(strength))
            except Exception as error:
                violations += 1
                if violations > 20:
                    continue
                print(f"seed {seed}: {type(error).__name__} {str(error)[:400]}", flush=True)
                continue
            tally[result.first] += 1
            tally["attempts"] += result.attempts
            reasons[re.sub(r"[-\d.]+", "#", re.sub(r"^fault\S+ ", "", result.reason))[:90]] += 1
    print(dict(tally), "violations", violations)
    for reason, number in reasons.most_common():
        print(f"{number:6d} {reason}")
    return violations


if __name__ == "__main__":
    raise SystemExit(min(1, main(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:])))
