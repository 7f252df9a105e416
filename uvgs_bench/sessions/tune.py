"""Propose sensor parameters for a scene, say why, and prove on its captures that they are better and never worse.

Only detection and selection are tuned. What decides whether a pose is believed (margins, chance fits, residuals) is
never touched: it is what keeps a wrong pose from being published.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from math import ceil, sqrt

import numpy as np

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.errors import CaptureError
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.outcome import Miss, Outcome, PoseEstimate
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.sessions.events import EventSink, StageAdvanced, StageFinished, StageStarted
from uvgs_bench.sessions.tune_light import light_remarks
from uvgs_bench.sessions.tune_measure import (
    SceneLights,
    SceneNoise,
    hue_range_deg,
    measure_lights,
    measure_noise,
)
from uvgs_bench.units import mm_from_m

STAGE = "tune"
# With fewer captures there is nothing to set aside for the check.
_LEAST_TO_SPLIT = 6
_TRIALS: dict[str, tuple[object, ...]] = {
    "threshold_floor": (0.04, 0.02, 0.01, 0.005, 0.15),
    "min_contrast": (0.02, 0.01),
    "max_area_px2": (1500.0, 400.0, 150.0, 20000.0),
    "min_area_px2": (6.0, 12.0, 2.0),
    "min_circularity": (0.3, 0.7),
    "window_px": (31, 121),
    "max_blobs": (24,),
}
# Where the search begins besides the given parameters: for dim LEDs, and for many small lights.
_SENSITIVE = {"threshold_floor": 0.01, "min_contrast": 0.02, "min_area_px2": 2.0, "max_blobs": 24}
_STRICT = {"min_area_px2": 8.0, "min_circularity": 0.7, "max_area_px2": 1500.0}
_ROUNDS = 2
_HUE_MARGIN_DEG = 25.0
_TIGHT = 1.25
_DISAGREE_SIGMAS = 6.0
_DISAGREE_M = 1e-3
# How far a capture came, for climbing while nothing is solved yet.
_PROGRESS = {"preprocess": 0.0, "blobs": 0.05, "selection": 0.1, "correspondence": 0.3, "solve": 0.35, "validate": 0.4}


@dataclass(frozen=True, slots=True)
class Score:
    """How a config does on captures.

    Args:
        captures: Number of captures.
        poses: With a pose.
        median_sigma_m: Median root of the summed position variances, m; NaN without poses.
        misses: Count of each ``stage/reason``.
    """

    captures: int
    poses: int
    median_sigma_m: float
    misses: dict[str, int]


@dataclass(frozen=True, slots=True)
class Change:
    """One parameter that matters.

    Args:
        key: Its name.
        before: Its value so far.
        after: The proposed value.
        why: One line with the measured numbers.
        worth: Poses lost without it.
    """

    key: str
    before: object
    after: object
    why: str
    worth: int


@dataclass(frozen=True, slots=True, eq=False)
class TuneResult:
    """The proposal and what speaks for it.

    Args:
        before: The given config.
        proposed: The proposal; the given config when nothing better was found.
        changes: What differs, and why.
        noise: The pictures without their lights.
        lights: LEDs and other lights, with the proposal.
        score_before: On all captures.
        score_proposed: On all captures.
        check_before: On captures the proposal was not chosen on; None when there were too few to set aside.
        check_proposed: The same for the proposal.
        remarks: Lines about exposure, ranges and doubts.
        captures: The captures looked at.
        outcomes_before: Their outcomes with the given config.
        outcomes_proposed: Their outcomes with the proposal.
    """

    before: UvgsConfig
    proposed: UvgsConfig
    changes: tuple[Change, ...]
    noise: SceneNoise
    lights: SceneLights
    score_before: Score
    score_proposed: Score
    check_before: Score | None
    check_proposed: Score | None
    remarks: tuple[str, ...]
    captures: tuple[Capture, ...] = field(repr=False, default=())
    outcomes_before: tuple[Outcome, ...] = field(repr=False, default=())
    outcomes_proposed: tuple[Outcome, ...] = field(repr=False, default=())


def tune(
    source: Iterable[Capture],
    calibration: Calibration,
    beacon: Beacon,
    sink: EventSink,
    *,
    start: UvgsConfig | None = None,
    limit: int = 20,
) -> TuneResult:
    """Look at captures and propose parameters.

    Every other capture is set aside; the proposal is chosen on the rest and then checked on all. It is dropped when it
    loses a capture that the given config solves, when a pose disagrees, or when it solves no more than before.

    Args:
        source: Captures.
        calibration: The camera.
        beacon: The beacon.
        sink: Where progress goes.
        start: Parameters to start from; the default when None.
        limit: Look at so many captures at most.

    Returns:
        The proposal.

    Raises:
        CaptureError: There is no capture, or the source fails.
        CalibrationError: A capture has another size than the calibration.
    """
    captures = tuple(islice(source, limit))
    if not captures:
        raise CaptureError("has no captures, expected at least one to tune on")
    before = UvgsConfig() if start is None else start
    sink(StageStarted(STAGE))
    bench = _Bench(calibration, beacon, captures, sink)
    chosen_on = range(0, len(captures), 2) if len(captures) >= _LEAST_TO_SPLIT else range(len(captures))
    set_aside = [i for i in range(len(captures)) if i not in set(chosen_on)]
    noise = measure_noise(captures)
    proposed = _search(bench, before, chosen_on, noise)
    proposed, remarks = _verified(bench, before, proposed)
    lights = measure_lights(captures, bench.solve(proposed), proposed)
    changes = _changes(bench, before, proposed, noise, lights)
    remarks += light_remarks(captures, lights, calibration, beacon, proposed)
    everything = range(len(captures))
    sink(StageFinished(STAGE, f"{len(changes)} parameters proposed"))
    return TuneResult(
        before,
        proposed,
        changes,
        noise,
        lights,
        bench.score(before, everything),
        bench.score(proposed, everything),
        bench.score(before, set_aside) if set_aside else None,
        bench.score(proposed, set_aside) if set_aside else None,
        tuple(remarks),
        captures,
        bench.solve(before),
        bench.solve(proposed),
    )


class _Bench:
    """Solves the captures with any config, once each."""

    def __init__(
        self, calibration: Calibration, beacon: Beacon, captures: tuple[Capture, ...], sink: EventSink
    ) -> None:
        self._calibration = calibration
        self.beacon = beacon
        self.captures = captures
        self._sink = sink
        self._known: dict[tuple[UvgsConfig, int], Outcome] = {}
        self._tried: set[UvgsConfig] = set()

    def solve(self, config: UvgsConfig, which: Iterable[int] | None = None) -> tuple[Outcome, ...]:
        indices = range(len(self.captures)) if which is None else which
        uvgs = Uvgs(self._calibration, self.beacon, config)
        outcomes = []
        for i in indices:
            if (config, i) not in self._known:
                self._known[config, i] = uvgs.solve(self.captures[i])
            outcomes.append(self._known[config, i])
        if config not in self._tried:
            self._tried.add(config)
            self._sink(StageAdvanced(STAGE, len(self._tried), f"{len(self._tried)} settings tried"))
        return tuple(outcomes)

    def score(self, config: UvgsConfig, which: Iterable[int]) -> Score:
        outcomes = self.solve(config, which)
        poses = [o for o in outcomes if isinstance(o, PoseEstimate)]
        misses = Counter(f"{o.stage}/{o.reason}" for o in outcomes if isinstance(o, Miss))
        sigma = float(np.median([_sigma_m(pose) for pose in poses])) if poses else float("nan")
        return Score(len(outcomes), len(poses), sigma, dict(misses.most_common()))

    def progress(self, config: UvgsConfig, which: Iterable[int]) -> float:
        """Poses, plus a little for how far each missed capture came."""
        total = 0.0
        for outcome in self.solve(config, which):
            if isinstance(outcome, PoseEstimate):
                total += 1.0
            else:
                total += _PROGRESS.get(outcome.stage, 0.0)
                if outcome.reason == "too_few_blobs":
                    total += 0.04 * min(outcome.blob_count, 4)
        return total


def _sigma_m(pose: PoseEstimate) -> float:
    return sqrt(float(np.trace(pose.position_covariance_m2)))


def _search(bench: _Bench, before: UvgsConfig, which: Sequence[int], noise: SceneNoise) -> UvgsConfig:
    """Climb from three starts, then give back every change that earns nothing, then take measured values."""
    if bench.score(before, which).poses == len(which):
        return before
    starts = [before, *(replace(before, **change) for change in (_SENSITIVE, _STRICT))]  # type: ignore[arg-type]
    best, height = before, bench.progress(before, which)
    for start in starts:
        config, reached = _climb(bench, start, which)
        if reached > height + 1e-9:
            best, height = config, reached
    return _settle(bench, before, _reduced(bench, before, best, which), which, noise)


def _climb(bench: _Bench, config: UvgsConfig, which: Sequence[int]) -> tuple[UvgsConfig, float]:
    height = bench.progress(config, which)
    for _ in range(_ROUNDS):
        at_start = height
        for key, values in _trials(bench, config).items():
            for value in values:
                trial = _with(config, key, value)
                if trial is None:
                    continue
                reached = bench.progress(trial, which)
                if reached > height + 1e-9:
                    config, height = trial, reached
        if height >= len(which) or height <= at_start + 1e-9:
            break
    return config, height


def _trials(bench: _Bench, config: UvgsConfig) -> dict[str, tuple[object, ...]]:
    """Values to try; a hue gate where pictures have colour and nobody has named one."""
    is_colour = bench.captures[0].image.ndim == 3
    if not is_colour or bench.beacon.hue != "any" or config.hue_deg is not None:
        return _TRIALS
    return {**_TRIALS, "hue_deg": ((330.0, 30.0), (80.0, 160.0), (200.0, 270.0))}


def _with(config: UvgsConfig, key: str, value: object) -> UvgsConfig | None:
    """The config with one other value; None when it has that value already or it does not go with the rest."""
    if getattr(config, key) == value:
        return None
    try:
        return replace(config, **{key: value})  # type: ignore[arg-type]
    except ValueError:
        return None


def _differences(before: UvgsConfig, after: UvgsConfig) -> list[str]:
    keys = (*_TRIALS, "hue_deg")
    return [key for key in keys if getattr(before, key) != getattr(after, key)]


def _reduced(bench: _Bench, before: UvgsConfig, config: UvgsConfig, which: Sequence[int]) -> UvgsConfig:
    """Give back each change without which no pose is lost."""
    poses = bench.score(config, which).poses
    for key in _differences(before, config):
        trial = _with(config, key, getattr(before, key))
        if trial is not None and bench.score(trial, which).poses >= poses:
            config = trial
    return config


def _settle(
    bench: _Bench, before: UvgsConfig, config: UvgsConfig, which: Sequence[int], noise: SceneNoise
) -> UvgsConfig:
    """Replace values found by trying with values from what was measured, where that loses no pose."""
    captures = [bench.captures[i] for i in which]
    lights = measure_lights(captures, bench.solve(config, which), config)
    if lights.poses == 0:
        return config
    poses = bench.score(config, which).poses
    for key in _differences(before, config):
        rule = _MEASURED.get(key)
        trial = _with(config, key, rule(noise, lights)) if rule is not None else None
        if trial is not None and bench.score(trial, which).poses >= poses:
            config = trial
    # A limit that LEDs nearly touch loses the next capture.
    tight = {
        "min_circularity": lights.least_circularity < _TIGHT * config.min_circularity,
        "min_area_px2": lights.least_area_px2 < _TIGHT * config.min_area_px2,
        "max_area_px2": _TIGHT * lights.greatest_area_px2 > config.max_area_px2,
    }
    for key in (key for key, is_tight in tight.items() if is_tight):
        trial = _with(config, key, _MEASURED[key](noise, lights))
        if trial is not None and bench.score(trial, which).poses >= poses:
            config = trial
    return config


def _two_digits(value: float) -> float:
    return float(f"{value:.2g}")


def _hue(_noise: SceneNoise, lights: SceneLights) -> object:
    if not lights.hues_deg:
        return None
    low, high = hue_range_deg(lights.hues_deg, _HUE_MARGIN_DEG)
    return round(low, 0), round(high, 0)


# Half of what the dimmest or smallest LED shows is the threshold: twice as far away it is still seen.
_MEASURED: dict[str, Callable[[SceneNoise, SceneLights], object]] = {
    "threshold_floor": lambda n, s: _two_digits(0.5 * s.least_height_dn / max(n.contrast_dn, 1.0)),
    "min_contrast": lambda n, s: _two_digits(0.5 * s.least_height_dn / n.full_scale_dn),
    "min_area_px2": lambda _n, s: max(1.0, _two_digits(0.5 * s.least_area_px2)),
    "max_area_px2": lambda _n, s: float(ceil(3.0 * s.greatest_area_px2)),
    "min_circularity": lambda _n, s: _two_digits(0.8 * s.least_circularity),
    "hue_deg": _hue,
}


def _verified(bench: _Bench, before: UvgsConfig, proposed: UvgsConfig) -> tuple[UvgsConfig, list[str]]:
    """The proposal when it is better and never worse on all captures, else the given config, with the reason."""
    if proposed == before:
        old = bench.score(before, range(len(bench.captures)))
        if old.poses == old.captures:
            return before, ["the given parameters solve every capture: nothing to change"]
        return before, ["no other parameters solve more of these captures: light, focus or the beacon must change"]
    lost, gained, apart = 0, 0, 0
    for old_outcome, new_outcome in zip(bench.solve(before), bench.solve(proposed), strict=True):
        has_old, has_new = isinstance(old_outcome, PoseEstimate), isinstance(new_outcome, PoseEstimate)
        lost += has_old and not has_new
        gained += has_new and not has_old
        if isinstance(old_outcome, PoseEstimate) and isinstance(new_outcome, PoseEstimate):
            apart += _disagree(old_outcome, new_outcome)
    if lost or apart or not gained:
        why = (
            f"{lost} captures lost" if lost else f"{apart} poses disagree" if apart else "no capture gained"
        )  # fmt: skip
        return before, [f"a proposal was dropped: {why} against the given parameters"]
    return proposed, []


def _disagree(a: PoseEstimate, b: PoseEstimate) -> bool:
    apart_m = float(np.linalg.norm(a.camera_from_beacon.t_m - b.camera_from_beacon.t_m))
    return apart_m > _DISAGREE_M + _DISAGREE_SIGMAS * max(_sigma_m(a), _sigma_m(b))


def _changes(
    bench: _Bench, before: UvgsConfig, proposed: UvgsConfig, noise: SceneNoise, lights: SceneLights
) -> tuple[Change, ...]:
    everything = range(len(bench.captures))
    poses = bench.score(proposed, everything).poses
    changes = []
    for key in _differences(before, proposed):
        old, new = getattr(before, key), getattr(proposed, key)
        without = _with(proposed, key, old)
        worth = 0 if without is None else poses - bench.score(without, everything).poses
        changes.append(Change(key, old, new, _why(key, noise, lights), worth))
    return tuple(sorted(changes, key=lambda change: -change.worth))


def _why(key: str, noise: SceneNoise, lights: SceneLights) -> str:
    """What was measured that speaks for a change of this parameter."""
    dimmest = f"the dimmest LED stands {lights.least_height_dn:.0f} DN above its surroundings"
    lines = {
        "threshold_floor": f"{dimmest}, the brightest light {noise.contrast_dn:.0f}; noise {noise.spatial_dn:.1f} DN",
        "min_contrast": f"{dimmest}, {lights.least_height_dn / noise.full_scale_dn:.1%} of full scale",
        "min_area_px2": f"the smallest LED has {lights.least_area_px2:.0f} px^2; {lights.others:.0f} other lights",
        "max_area_px2": f"the largest LED has {lights.greatest_area_px2:.0f} px^2; {lights.others:.0f} other lights",
        "min_circularity": f"the least round LED has {lights.least_circularity:.2f}",
        "window_px": f"the largest LED is {2.0 * sqrt(max(lights.greatest_area_px2, 0.0) / np.pi):.0f} px wide",
        "max_blobs": f"{lights.others:.0f} other lights are in the picture",
        "hue_deg": f"LED hues lie between {_arc(lights)}; other lights have other hues",
    }
    return lines[key]


def _arc(lights: SceneLights) -> str:
    if not lights.hues_deg:
        return "no measured hues"
    low, high = hue_range_deg(lights.hues_deg, 0.0)
    return f"{low:.0f} and {high:.0f} degrees"


def summary_line(result: TuneResult) -> str:
    """The result in one line."""
    old, new = result.score_before, result.score_proposed
    sigma = "" if np.isnan(new.median_sigma_m) else f", median position sigma {mm_from_m(new.median_sigma_m):.2f} mm"
    return f"{new.poses} of {new.captures} captures solved, {old.poses} before{sigma}"
