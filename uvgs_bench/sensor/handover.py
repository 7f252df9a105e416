"""Several beacons in one picture, and which of them is believed now.

``solve_all`` gives one outcome per beacon and lets no light belong to two of them. ``hand_over`` keeps one beacon
active and answers with its fresh pose, or with its last one as a ``Held`` value, never mistaken for a fresh one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import inf
from typing import Literal

import numpy as np

from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor.capture import Capture, ImageArray
from uvgs_bench.sensor.outcome import Miss, Outcome, PoseEstimate
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.units import ns_from_s

# Two centroids nearer than this are one light.
_SAME_LIGHT_PX = 2.0
# Misses that other beacons' lights in the picture may have caused.
_CROWDED = frozenset({"too_many_blobs", "ambiguous", "no_labeling", "chance_fit", "residual_too_large"})


def solve_all(
    capture: Capture, sensors: Mapping[str, Uvgs], priors: Mapping[str, PoseEstimate] | None = None
) -> dict[str, Outcome]:
    """Solve one capture for every beacon.

    A beacon that is missed for reasons other lights can cause is tried again with the lights of solved beacons painted
    over. Two poses that claim the same light cannot both be right and nothing here says which is: both become a
    ``Miss`` with reason ``shared_light``.

    Args:
        capture: The picture.
        sensors: One sensor per beacon, by name of your choice.
        priors: Last poses by the same names.

    Returns:
        One outcome per sensor, in the order of ``sensors``.

    Raises:
        CalibrationError: The picture has another size than a calibration.
    """
    known = {} if priors is None else priors
    outcomes = {name: sensor.solve(capture, known.get(name)) for name, sensor in sensors.items()}
    outcomes = _refuse_shared(outcomes)
    taken = [o.led_px for o in outcomes.values() if isinstance(o, PoseEstimate)]
    if taken:
        crowded = [n for n, o in outcomes.items() if isinstance(o, Miss) and o.reason in _CROWDED]
        if crowded:
            px = np.concatenate(taken)
            emptier = replace(capture, image=paint_over(capture.image, px[np.isfinite(px).all(axis=1)]))
            again = {name: sensors[name].solve(emptier, known.get(name)) for name in crowded}
            outcomes |= {name: o for name, o in again.items() if isinstance(o, PoseEstimate)}
            outcomes = _refuse_shared(outcomes)
    return outcomes


def paint_over(image: ImageArray, px: FloatArray) -> ImageArray:
    """The picture without the lights at these places.

    Each is filled with the middle of its surroundings, out to where the light has fallen off.

    Args:
        image: Mono (H, W) or BGR (H, W, 3).
        px: Centres, shape (n, 2), px.

    Returns:
        A changed copy.
    """
    out = image.copy()
    height, width = image.shape[:2]
    for u, v in px:
        column, row = round(float(u)), round(float(v))
        # Where no radius ends in the dark the light sits in a glow, and only its own disc is filled.
        for radius in (6, 12, 24, 48, 12):
            y0, y1, x0, x1 = row - radius, row + radius + 1, column - radius, column + radius + 1
            part = out[max(0, y0) : min(height, y1), max(0, x0) : min(width, x1)]
            bright = part if part.ndim == 2 else part.max(axis=2)
            rim = np.concatenate([bright[0], bright[-1], bright[:, 0], bright[:, -1]])
            peak, base = float(bright.max()), float(np.median(rim))
            # The rim's upper quarter must be dark: then the light ends inside.
            if float(np.percentile(rim, 75)) <= base + 0.05 * (peak - base) + 2.0:
                break
        border = np.concatenate([part[0], part[-1], part[:, 0], part[:, -1]])
        fill = np.median(border, axis=0)
        # Another light at the box's corner stays: only a disc is filled.
        ys, xs = np.ogrid[max(0, y0) : min(height, y1), max(0, x0) : min(width, x1)]
        part[(ys - row) ** 2 + (xs - column) ** 2 <= radius**2] = fill
    return out


def _refuse_shared(outcomes: Mapping[str, Outcome]) -> dict[str, Outcome]:
    poses = [(name, o) for name, o in outcomes.items() if isinstance(o, PoseEstimate)]
    others: dict[str, list[str]] = {}
    for i, (name, one) in enumerate(poses):
        for other_name, other in poses[i + 1 :]:
            apart = np.linalg.norm(one.led_px[:, None] - other.led_px[None], axis=2)
            if float(np.min(apart, initial=inf, where=np.isfinite(apart))) < _SAME_LIGHT_PX:
                others.setdefault(name, []).append(other_name)
                others.setdefault(other_name, []).append(name)
    result = dict(outcomes)
    for name, pose in poses:
        if name in others:
            detail = f"the pose claims a light that also belongs to the pose of {', '.join(others[name])}"
            result[name] = Miss(
                "validate", "shared_light", detail, pose.t_ns, pose.beacon, pose.blob_count, pose.stage_s
            )
    return result


@dataclass(frozen=True, slots=True)
class HandoverPolicy:
    """When another beacon takes over.

    Args:
        mode: ``command`` (only when told), ``position`` (the nearest, or the one whose zone the range is in) or
            ``quality`` (the least position deviation).
        zones_m: By beacon name, (nearest, farthest) range at which it is to be used, m; empty: the nearest is.
        advantage: A challenger must be better by this share; a zone is wider by this share for the one that is active.
        patience: Captures in a row in which it must be better.
        hold_s: How long the last pose is repeated when the active beacon is missed, s.

    Raises:
        ValueError: A value outside its meaning.
    """

    mode: Literal["command", "position", "quality"] = "quality"
    zones_m: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    advantage: float = 0.2
    patience: int = 3
    hold_s: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 <= self.advantage < 1.0:
            raise ValueError(f"advantage must be in [0, 1), got {self.advantage}")
        if self.patience < 1:
            raise ValueError(f"patience must be positive, got {self.patience}")
        if not self.hold_s >= 0.0:
            raise ValueError(f"hold_s must not be negative, got {self.hold_s}")
        for name, (near_m, far_m) in self.zones_m.items():
            if not 0.0 <= near_m < far_m:
                raise ValueError(f"the zone of {name} must be (near, far) in m, got ({near_m}, {far_m})")


@dataclass(frozen=True, slots=True, eq=False)
class HandoverState:
    """What is remembered between captures.

    Args:
        active: Name of the active beacon, or None before the first pose.
        last: Its last valid pose, or None.
        challenger: Who was better in the last captures, or None.
        streak: In how many captures in a row.
    """

    active: str | None = None
    last: PoseEstimate | None = None
    challenger: str | None = None
    streak: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """The last valid pose, repeated because there is no fresh one.

    Args:
        last: The pose as it was; its ``t_ns`` is its own instant, not now.
        age_ns: How old it is, ns.
        miss: Why there is no fresh one.
    """

    last: PoseEstimate
    age_ns: int
    miss: Miss


@dataclass(frozen=True, slots=True, eq=False)
class Handover:
    """The answer for one capture.

    Args:
        active: Name of the active beacon; None while none was ever seen.
        answer: Its fresh pose, its held one, or why there is neither.
        state: Hand this to the next call.
        switched: Why another beacon became active in this capture; empty when none did.
    """

    active: str | None
    answer: PoseEstimate | Held | Miss
    state: HandoverState
    switched: str = ""


def hand_over(
    outcomes: Mapping[str, Outcome],
    state: HandoverState,
    policy: HandoverPolicy,
    t_ns: int,
    command: str | None = None,
) -> Handover:
    """Decide which beacon is active and what its pose is.

    Args:
        outcomes: One per beacon, from ``solve_all``.
        state: From the last call; ``HandoverState()`` at first.
        policy: The rules.
        t_ns: Instant of this capture, ns.
        command: Name of the beacon to use from now on; obeyed in every mode, at once.

    Returns:
        The answer with the state for the next call.

    Raises:
        ConfigError: There is no outcome at all, or the command or the active beacon names none of them.
    """
    for name in (command, state.active):
        if name is not None and name not in outcomes:
            raise ConfigError(f"unknown beacon '{name}', expected one of: {', '.join(outcomes)}", key="beacon")
    if not outcomes:
        raise ConfigError("expected at least one beacon", key="beacon")
    if command is not None:
        switched = "" if command == state.active else "commanded"
        return _answer(outcomes, command, state, policy, t_ns, switched, None, 0)
    poses = {name: o for name, o in outcomes.items() if isinstance(o, PoseEstimate)}
    best = _best(poses, state.active, policy)
    if state.active is None:
        if best is None or policy.mode == "command":
            return Handover(None, _no_active(outcomes, t_ns), state)
        return _answer(outcomes, best, state, policy, t_ns, "first seen", None, 0)
    if policy.mode == "command" or best is None or best == state.active:
        return _answer(outcomes, state.active, state, policy, t_ns, "", None, 0)
    if state.active not in poses:
        # A beacon that may still be held is not given up for one missed capture.
        held_ns = inf if state.last is None else t_ns - state.last.t_ns
        if held_ns > ns_from_s(policy.hold_s):
            return _answer(outcomes, best, state, policy, t_ns, "the active beacon is lost", None, 0)
        return _answer(outcomes, state.active, state, policy, t_ns, "", None, 0)
    streak = state.streak + 1 if best == state.challenger else 1
    if streak >= policy.patience:
        return _answer(outcomes, best, state, policy, t_ns, f"better {policy.mode}", None, 0)
    return _answer(outcomes, state.active, state, policy, t_ns, "", best, streak)


def _best(poses: Mapping[str, PoseEstimate], active: str | None, policy: HandoverPolicy) -> str | None:
    """The beacon that should be active by this capture alone, the active one favoured; None when none qualifies."""
    if policy.mode == "position" and policy.zones_m:
        inside = {}
        for name, pose in poses.items():
            near_m, far_m = policy.zones_m.get(name, (0.0, inf))
            slack = policy.advantage if name == active else 0.0
            range_m = _range_m(pose)
            if near_m * (1.0 - slack) <= range_m <= far_m * (1.0 + slack):
                inside[name] = range_m
        if active in inside:
            return active
        return min(inside, key=lambda name: inside[name], default=None)
    badness = {name: _range_m(p) if policy.mode == "position" else _spread_m(p) for name, p in poses.items()}
    if active is not None and active in badness:
        badness[active] *= 1.0 - policy.advantage
    return min(badness, key=lambda name: badness[name], default=None)


def _answer(
    outcomes: Mapping[str, Outcome],
    active: str,
    state: HandoverState,
    policy: HandoverPolicy,
    t_ns: int,
    switched: str,
    challenger: str | None,
    streak: int,
) -> Handover:
    outcome = outcomes[active]
    # A pose of another beacon is another frame: it is forgotten with its beacon.
    last = state.last if active == state.active else None
    if isinstance(outcome, PoseEstimate):
        return Handover(active, outcome, HandoverState(active, outcome, challenger, streak), switched)
    kept = HandoverState(active, last, challenger, streak)
    if last is not None and 0 <= t_ns - last.t_ns <= ns_from_s(policy.hold_s):
        return Handover(active, Held(last, t_ns - last.t_ns, outcome), kept, switched)
    return Handover(active, outcome, kept, switched)


def _no_active(outcomes: Mapping[str, Outcome], t_ns: int) -> Miss:
    missed = {name: o.reason for name, o in outcomes.items() if isinstance(o, Miss)}
    said = ", ".join(f"{name}: {reason}" for name, reason in missed.items()) or "waiting for a command"
    return Miss("validate", "no_active_beacon", said, t_ns, "")


def _range_m(pose: PoseEstimate) -> float:
    return float(np.linalg.norm(pose.camera_from_beacon.t_m))


def _spread_m(pose: PoseEstimate) -> float:
    return float(np.sqrt(np.trace(pose.position_covariance_m2)))
