"""A gantry, a camera and a sensor that do what a test tells them, on a clock that only moves when asked to."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from uvgs_bench.devices.gantry.axes import Axis, Envelope
from uvgs_bench.devices.gantry.gantry import ControllerInfo, GantryState
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.outcome import Miss, Outcome, PoseEstimate
from uvgs_bench.sessions.patterns import Line
from uvgs_bench.sessions.planning import Plan, plan
from uvgs_bench.sessions.procedure import Procedure
from uvgs_bench.sessions.sweep import Rig
from uvgs_bench.store.run import RunManifest, RunWriter
from uvgs_bench.units import ns_from_s

AXES = tuple(Axis(name, "linear", np.eye(3)[i], -0.3, 0.0, 0.05, 0.2) for i, name in enumerate("XYZ"))
ENVELOPE = Envelope(AXES)


class HandClock:
    """Bench time that moves only by ``sleep``."""

    def __init__(self) -> None:
        self.t_ns = 1_000_000

    def now_ns(self) -> int:
        return self.t_ns

    def sleep(self, duration_s: float) -> None:
        self.t_ns += ns_from_s(duration_s)


class _Closing:
    def close(self) -> None:
        """Nothing to release."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class FakeGantry(_Closing):
    """Goes where it is told at once. ``before_move`` may raise; ``history`` tells what was asked, in order."""

    port = "fake"
    axes = AXES
    envelope = ENVELOPE
    info = ControllerInfo("fake", "1", "", {"100": "400"})

    def __init__(self, clock: HandClock) -> None:
        self.clock = clock
        self.position = np.zeros(3)
        self.is_homed = False
        self.is_trusted = True
        self.history: list[str] = []
        self.before_move: Callable[[int], None] = lambda number: None
        self.moves = 0

    def state(self) -> GantryState:
        is_trusted = self.is_homed and self.is_trusted
        return GantryState(self.clock.now_ns(), "Idle", self.position.copy(), self.is_homed, is_trusted)

    def home(self) -> GantryState:
        self.history.append("home")
        self.is_homed = True
        return self.state()

    def move_to(self, position: Sequence[float] | FloatArray, speed: float) -> GantryState:
        self.history.append("move")
        self.before_move(self.moves)
        self.moves += 1
        self.clock.sleep(1.0)
        self.position = np.array(position, dtype=np.float64)
        return self.state()

    def jog(self, offset: Sequence[float] | FloatArray, speed: float) -> GantryState:
        return self.move_to(self.position + np.asarray(offset), speed)

    def stop(self) -> GantryState:
        self.history.append("stop")
        return self.state()

    def reset(self) -> GantryState:
        self.history.append("reset")
        self.is_homed = False
        return self.state()


class FakeCamera(_Closing):
    """Delivers pictures whose first two pixels hold nothing; ``age_s`` makes them old."""

    spec = "fake:"
    is_live = True
    length = None

    def __init__(self, clock: HandClock) -> None:
        self.clock = clock
        self.age_s: list[float] = []
        self.count = 0
        self.after_grab: Callable[[int], None] = lambda number: None

    def grab(self) -> Capture | None:
        self.clock.sleep(0.01)
        age_s = self.age_s.pop(0) if self.age_s else 0.0
        capture = Capture(
            np.full((4, 4), self.count % 256, dtype=np.uint8),
            self.clock.now_ns() - ns_from_s(age_s),
            "fake",
            self.count,
        )
        self.after_grab(self.count)
        self.count += 1
        return capture

    def __iter__(self) -> Iterator[Capture]:
        while (capture := self.grab()) is not None:
            yield capture


class FakeSensor:
    """Answers where the gantry is, displaced by ``offset_m``; every ``miss_every``-th capture is a miss."""

    def __init__(self, gantry: FakeGantry) -> None:
        self.gantry = gantry
        self.offset_m = np.zeros(3)
        self.miss_every = 0

    def solve(self, capture: Capture, prior: PoseEstimate | None = None) -> Outcome:
        if self.miss_every and capture.index % self.miss_every == 0:
            return Miss("blobs", "too_few_blobs", "", capture.t_ns, "fake")
        t_m = self.gantry.position + self.offset_m + np.array([0.0, 0.0, 1.0])
        return PoseEstimate(
            Pose(np.eye(3), t_m, "camera", "beacon"), 1e-10 * np.eye(6), capture.t_ns, "fake",
            np.zeros((4, 2)), np.zeros((4, 2)), 0.1 + 0.001 * capture.index, 9.0, 4,
        )  # fmt: skip


class FakeRig:
    """All of it, with a plan of a line of stations and a run in a folder."""

    def __init__(self, folder: Path, stations: int = 6, captures: int = 2) -> None:
        self.clock = HandClock()
        self.gantry = FakeGantry(self.clock)
        self.camera = FakeCamera(self.clock)
        self.sensor = FakeSensor(self.gantry)
        self.rig = Rig(self.gantry, self.camera, self.sensor, self.clock)
        zero = {"X_mm": -10.0, "Y_mm": -10.0, "Z_mm": -10.0}
        line = Line(start=zero, end=zero | {"X_mm": -110.0}, count=stations)
        procedure = Procedure("fake", line, 0.05, settle_s=0.5, captures_per_station=captures)
        self.plan: Plan = plan(procedure, ENVELOPE)
        self.path = folder / "run"

    def manifest(self, keep: str = "all") -> RunManifest:
        return RunManifest(
            id="run", created_utc="2026-01-01T00:00:00.000Z", procedure_name="fake", mount="beacon_on_carriage",
            axes=AXES, hashes={"beacon.toml": "aa"}, plan_hash=self.plan.plan_hash, keep=keep,
            station_count=len(self.plan.stations),
            captures_per_station=self.plan.procedure.captures_per_station,
        )  # fmt: skip

    def writer(self, keep: str = "none") -> RunWriter:
        return RunWriter.create(self.path, self.manifest(keep), {})
