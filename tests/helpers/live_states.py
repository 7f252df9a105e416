"""Running streams made up for panels and pages: solved pictures of spots, and people who ask for things."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.helpers import spots
from uvgs_bench.errors import UvgsError
from uvgs_bench.interop.trajectories import LineNote
from uvgs_bench.sensor import Capture, PoseEstimate, Uvgs, UvgsConfig
from uvgs_bench.sensor.handover import Held
from uvgs_bench.sensor.outcome import Miss
from uvgs_bench.view.controls import Slider
from uvgs_bench.view.live_state import LiveState

BEACON = spots.beacon().name


def sensor() -> Uvgs:
    return Uvgs(spots.calibration(), spots.beacon(), UvgsConfig())


def solved(seed: int = 1) -> tuple[Capture, PoseEstimate]:
    """A picture with a pose."""
    rng = np.random.default_rng(seed)
    pose = spots.random_pose(rng, cone_deg=20.0)
    image = spots.draw(spots.lens().project(pose.apply(spots.beacon().positions_m)), rng)
    capture = Capture(image, seed * 10_000_000, "made up", seed, 0.003)
    outcome = sensor().solve(capture, None)
    assert isinstance(outcome, PoseEstimate)
    return capture, outcome


def miss(capture: Capture) -> Miss:
    return Miss("blobs", "too_few", "3 candidates <b>where</b> 4 are needed", capture.t_ns, BEACON, 3, {})


def shown_state(kind: str = "ok", count: int = 3) -> LiveState:
    """A state after some captures, the last of a kind: ``ok``, ``held`` or ``miss``."""
    state = LiveState()
    capture, outcome = solved()
    for k in range(count):
        shown = Capture(capture.image, k * 10_000_000, "made up", k, 0.003)
        is_last = k + 1 == count
        if not is_last or kind == "ok":
            said: object = outcome
        elif kind == "held":
            said = Held(last=outcome, age_ns=250_000_000, miss=miss(shown))
        else:
            said = miss(shown)
        state.put(shown, {BEACON: (said, LineNote(("low_margin",)))}, latency_s=0.004, dropped=2)  # type: ignore[dict-item]
    return state


class FakeControls:
    """Keeps what was asked."""

    def __init__(self) -> None:
        self.asked: list[object] = []
        self.value = 2.0

    def sliders(self) -> tuple[Slider, ...]:
        return (Slider("threshold_k", self.value, 0.0, 10.0, 0.1),)

    def exposure(self) -> Slider | None:
        return Slider("exposure_s", 0.004, 1e-5, 0.1, 0.0)

    def tune(self, changes) -> str | None:
        self.asked.append(dict(changes))
        if changes["threshold_k"] < 0:
            return "threshold_k must not be negative"
        self.value = changes["threshold_k"]
        return None

    def expose(self, exposure_s: float) -> str | None:
        self.asked.append(exposure_s)
        return None

    def save(self) -> Path:
        raise UvgsError("the disk is full")


class FakeMotion:
    """Keeps what was ordered."""

    axes = (("X", "m"), ("C", "rad"))

    def __init__(self) -> None:
        self.asked: list[object] = []

    def home(self) -> str | None:
        self.asked.append("home")
        return None

    def jog(self, axis: str, offset: float) -> str | None:
        self.asked.append((axis, offset))
        return None

    def stop(self) -> str | None:
        self.asked.append("stop")
        return None
