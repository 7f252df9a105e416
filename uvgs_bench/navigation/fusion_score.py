"""How well a method did: against the truth where known, against its own doubt, and through pauses of the sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.geometry.se3 import so3_log
from uvgs_bench.navigation.fusion_data import FusionInput, FusionResult
from uvgs_bench.navigation.states import NavigationState
from uvgs_bench.units import s_from_ns

# A pause of the sensor is longer than this and than three of its usual steps, s.
_PAUSE_S = 0.5
_ERRORS = 9


@dataclass(frozen=True, slots=True)
class Pause:
    """The sensor was silent.

    Args:
        start_ns: Its last pose before, ns.
        end_ns: Its first pose after, ns.
    """

    start_ns: int
    end_ns: int

    @property
    def length_s(self) -> float:
        """How long, s."""
        return s_from_ns(self.end_ns - self.start_ns)


@dataclass(frozen=True, slots=True)
class PauseScore:
    """What a method said through a pause.

    Args:
        pause: The pause.
        worst_m: Largest error of position in it, m; NaN without truth.
        sigma_m: Largest stated deviation of position along an axis at its end, m.
        nees_end: Squared error of position, velocity and rotation at its end in units of the stated covariance; 9 are
            expected; NaN without truth.
        jump_sigma: Largest step of position along an axis at its end, in deviations stated before; NaN when nothing was
            believed after it.
    """

    pause: Pause
    worst_m: float
    sigma_m: float
    nees_end: float
    jump_sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class FusionScore:
    """What a result amounts to. Errors are truth minus estimate.

    Args:
        t_s: Instants since the start of the data, shape (n,), s.
        error: Errors of position (m), velocity (m/s), rotation (rad), shape (n, 9); empty without truth.
        sigma: Stated deviations of the same, shape (n, 9).
        nees: Squared errors in units of the stated covariance, shape (n,), 9 are expected; empty without truth.
        nis: By source, squared innovations of the believed poses, 6 are expected.
        counts: By source: fused, refused, reopened, too old.
        false_believed: How many poses known to be false were believed.
        pauses: What it said through pauses.
        lost_share: Share of instants at which it had nothing to say.
    """

    t_s: FloatArray
    error: FloatArray
    sigma: FloatArray
    nees: FloatArray
    nis: dict[str, FloatArray]
    counts: dict[str, dict[str, int]]
    false_believed: int
    pauses: tuple[PauseScore, ...]
    lost_share: float

    @property
    def distance_m(self) -> FloatArray:
        """Errors of position, shape (n,), m."""
        out: FloatArray = np.linalg.norm(self.error[:, :3], axis=1)
        return out

    @property
    def angle_rad(self) -> FloatArray:
        """Errors of rotation, shape (n,), rad."""
        out: FloatArray = np.linalg.norm(self.error[:, 6:], axis=1)
        return out

    @property
    def position_rms_m(self) -> float:
        """Root mean square of the errors of position, m; NaN without truth."""
        return rms(self.distance_m)

    @property
    def attitude_rms_rad(self) -> float:
        """Root mean square of the errors of rotation, rad; NaN without truth."""
        return rms(self.angle_rad)

    @property
    def worst_m(self) -> float:
        """Largest error of position, m; NaN without truth."""
        return float(self.distance_m.max()) if len(self.error) else float("nan")


@dataclass(frozen=True, slots=True)
class RawScore:
    """The sensor alone, at the instants of its captures.

    Args:
        position_rms_m: Of its positions of the body, m; NaN without truth.
        worst_m: The largest, m.
        attitude_rms_rad: Of its attitudes, rad.
        poses: How many there are.
        silent_s: The longest time without one, s.
    """

    position_rms_m: float
    worst_m: float
    attitude_rms_rad: float
    poses: int
    silent_s: float


def rms(values: FloatArray) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def find_pauses(source: FusionInput) -> tuple[Pause, ...]:
    """When the sensor was silent for longer than it usually is."""
    t_ns = np.array([pose.t_ns for pose in source.sensed], dtype=np.int64)
    if len(t_ns) < 3:
        return ()
    steps_s = np.diff(t_ns) / 1e9
    longest_s = max(_PAUSE_S, 3.0 * float(np.median(steps_s)))
    return tuple(Pause(int(t_ns[k]), int(t_ns[k + 1])) for k in np.flatnonzero(steps_s > longest_s))


def score_raw(source: FusionInput) -> RawScore:
    """Judge the sensor alone."""
    t_ns = [pose.t_ns for pose in source.sensed]
    silent_s = float(np.diff(t_ns).max() / 1e9) if len(t_ns) > 1 else float("inf")
    distances, angles = [], []
    if source.truth is not None:
        for pose in source.sensed:
            true, measured = source.truth(pose.t_ns).pose, source.measured(pose).world_from_body
            distances.append(float(np.linalg.norm(true.t_m - measured.t_m)))
            angles.append(float(np.linalg.norm(so3_log(np.ascontiguousarray(true.R @ measured.R.T)))))
    worst_m = max(distances, default=float("nan"))
    return RawScore(rms(np.array(distances)), worst_m, rms(np.array(angles)), len(t_ns), silent_s)


def score(source: FusionInput, result: FusionResult, false_ns: frozenset[int] = frozenset()) -> FusionScore:
    """Judge a result.

    Args:
        source: What was fused; its truth is used when there is one.
        result: What the method said.
        false_ns: Instants of poses known to be false.

    Returns:
        The score.
    """
    states = result.states
    t_ns = np.array([state.t_ns for state in states], dtype=np.int64)
    sigma = np.array([np.sqrt(np.maximum(np.diag(state.covariance)[:_ERRORS], 0.0)) for state in states])
    error, nees = np.empty((0, _ERRORS)), np.empty(0)
    if source.truth is not None and states:
        judged = [_judge(source, state) for state in states]
        error, nees = np.array([e for e, _ in judged]), np.array([n for _, n in judged])
    nis: dict[str, FloatArray] = {}
    counts: dict[str, dict[str, int]] = {}
    false_believed = 0
    for update in result.updates:
        of_source = counts.setdefault(update.source, {})
        of_source[update.status] = of_source.get(update.status, 0) + 1
        if update.source == "uvgs" and update.t_ns in false_ns and update.status in ("fused", "reopened"):
            false_believed += 1
    for name in counts:
        nis[name] = read_only([u.nis for u in result.updates if u.source == name and u.status == "fused"])
    asked = len(states) + len(result.lost_ns)
    first_ns = int(source.imu.t_ns[0]) if len(source.imu) else int(t_ns[0]) if len(t_ns) else 0
    distance_m = np.linalg.norm(error[:, :3], axis=1)
    pauses = tuple(_through(pause, result, t_ns, distance_m, nees) for pause in find_pauses(source))
    return FusionScore(
        read_only((t_ns - first_ns) / 1e9),
        read_only(error),
        read_only(sigma.reshape(-1, _ERRORS)),
        read_only(nees),
        nis,
        counts,
        false_believed,
        pauses,
        len(result.lost_ns) / asked if asked else 1.0,
    )


def nees_band(count: int, level: float = 0.05) -> tuple[float, float]:
    """Between which ends the mean of so many independent NEES of nine errors lies, but for ``level`` of cases."""
    from scipy.special import gammaincinv

    # Half a chi-squared draw follows the gamma law.
    low, high = (2.0 * float(gammaincinv(0.5 * _ERRORS * count, p)) / count for p in (0.5 * level, 1.0 - 0.5 * level))
    return low, high


def _judge(source: FusionInput, state: NavigationState) -> tuple[FloatArray, float]:
    assert source.truth is not None
    true = source.truth(state.t_ns)
    e = state.error_of(true.pose, true.velocity_mps)
    P = state.covariance[:_ERRORS, :_ERRORS]
    is_whole = bool((np.diag(P) > 0.0).all())
    return e, float(e @ np.linalg.solve(P, e)) if is_whole else float("nan")


def _through(
    pause: Pause, result: FusionResult, t_ns: NDArray[np.int64], distance_m: FloatArray, nees: FloatArray
) -> PauseScore:
    nan = float("nan")
    later = [u for u in result.updates if u.source == "uvgs" and u.t_ns >= pause.end_ns and u.status != "refused"]
    # The pose after the pause was known only later; until then the method went on without.
    until_ns = pause.end_ns if not later else later[0].t_ns
    inside = np.flatnonzero((t_ns > pause.start_ns) & (t_ns < until_ns))
    if not len(inside):
        return PauseScore(pause, nan, nan, nan, nan)
    last = result.states[int(inside[-1])]
    sigma_m = last.position_sigma_m
    has_truth = len(distance_m) == len(t_ns)
    jump = float((np.abs(later[0].innovation[3:]) / sigma_m).max()) if later else nan
    return PauseScore(
        pause,
        float(distance_m[inside].max()) if has_truth else nan,
        float(sigma_m.max()),
        float(nees[inside[-1]]) if has_truth else nan,
        jump,
    )
