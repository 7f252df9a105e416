"""The follower law: keep a station before a leader from smoothed relative poses alone.

Two cascades of the same form, position in the leader's axes and attitude: the error asks for a closing speed, the
difference to the relative velocity for an acceleration. Near the station that is proportional-derivative control of a
double integrator, so a leader of constant velocity is followed without a lasting error: the velocity found by damping
against the leader is the feed-forward. Far from it the closing speed falls with the root of the distance, so that the
follower can still brake. Nothing is remembered but the last command.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.geometry.se3 import so3_exp, so3_log
from uvgs_bench.navigation.pose_filter import SmoothedPose
from uvgs_bench.units import s_from_ns

Mode = Literal["waiting", "following", "holding", "braking", "aborted"]

# Share of the allowed acceleration a closing speed is planned with; the rest is left for the leader's own motion.
_BRAKING_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class FollowerConfig:
    """The law's gains, limits and patience.

    Args:
        frequency_radps: Natural frequency of the position loop, rad/s.
        damping: Its damping ratio; the attitude loop has the same.
        turning_frequency_radps: Natural frequency of the attitude loop, rad/s.
        closing_mps: Largest speed towards the station, m/s, relative to the leader.
        speed_mps: Largest own speed, m/s.
        acceleration_mps2: Largest acceleration, m/s^2.
        turning_closing_radps: Largest rate towards the wanted attitude, rad/s, relative to the leader.
        rate_radps: Largest own angular rate, rad/s.
        angular_acceleration_radps2: Largest angular acceleration, rad/s^2.
        dead_band_m: Position errors below this are not corrected, m.
        dead_band_rad: Attitude errors below this are not corrected, rad.
        hold_s: How long the own velocity is kept without a fresh pose, s; then it brakes. An older pose is not fresh.
        abort_s: How long without a fresh pose until it gives up for good, s.
        valid_s: How long a command is obeyed when no other comes, s; afterwards the velocity is kept.

    Raises:
        ValueError: A value outside its meaning.
    """

    frequency_radps: float = 1.5
    damping: float = 1.0
    turning_frequency_radps: float = 1.5
    closing_mps: float = 0.1
    speed_mps: float = 0.2
    acceleration_mps2: float = 0.06
    turning_closing_radps: float = 0.25
    rate_radps: float = 0.5
    angular_acceleration_radps2: float = 0.3
    dead_band_m: float = 5e-4
    dead_band_rad: float = 2e-3
    hold_s: float = 0.5
    abort_s: float = 5.0
    valid_s: float = 0.1

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if not 0.0 <= value < np.inf or (value == 0.0 and not name.startswith("dead_band")):
                raise ValueError(f"{name} must be positive, got {value}")
        if self.abort_s < self.hold_s:
            raise ValueError(f"abort_s must not be less than hold_s, got {self.abort_s} < {self.hold_s}")


@dataclass(frozen=True, slots=True, eq=False)
class FollowCommand:
    """What the follower is told, and all the law remembers.

    Args:
        t_ns: From when on it holds, ns.
        velocity_mps: Own velocity at ``t_ns``, body axes, shape (3,), m/s.
        acceleration_mps2: Own acceleration from then on, body axes, shape (3,), m/s^2.
        rate_radps: Own angular velocity at ``t_ns``, body axes, shape (3,), rad/s.
        angular_acceleration_radps2: From then on, body axes, shape (3,), rad/s^2.
        valid_s: How long the accelerations hold, s; afterwards the velocities are kept.
        mode: What the law is doing.
        age_s: Age of the last pose it believed, s; of the start before the first.
        error_m: Position off the station as smoothed, leader's axes, shape (3,), m; NaN without a fresh pose.
        error_rad: Rotation vector off the wanted attitude, body axes, shape (3,), rad; NaN without a fresh pose.

    Raises:
        ValueError: A velocity or acceleration that is not finite.
    """

    t_ns: int
    velocity_mps: FloatArray
    acceleration_mps2: FloatArray
    rate_radps: FloatArray
    angular_acceleration_radps2: FloatArray
    valid_s: float
    mode: Mode
    age_s: float
    error_m: FloatArray
    error_rad: FloatArray

    def __post_init__(self) -> None:
        names = ("velocity_mps", "acceleration_mps2", "rate_radps", "angular_acceleration_radps2")
        for name in (*names, "error_m", "error_rad"):
            object.__setattr__(self, name, read_only(getattr(self, name), (3,)))
        if not all(np.isfinite(getattr(self, name)).all() for name in names):
            raise ValueError("a command needs finite velocities and accelerations")

    def twist_at(self, t_ns: int) -> tuple[FloatArray, FloatArray]:
        """Commanded own velocity and angular velocity, body axes of that instant, at or after ``t_ns``.

        Args:
            t_ns: The instant, ns.

        Returns:
            Velocity, shape (3,), m/s, and angular velocity, shape (3,), rad/s.
        """
        elapsed_s = max(s_from_ns(t_ns - self.t_ns), 0.0)
        pushed_s = min(elapsed_s, self.valid_s)
        rate = self.rate_radps + pushed_s * self.angular_acceleration_radps2
        # The velocity stays in space while the body turns under it.
        turned = so3_exp(-0.5 * elapsed_s * (self.rate_radps + rate))
        return turned @ (self.velocity_mps + pushed_s * self.acceleration_mps2), rate


def rest_command(t_ns: int, config: FollowerConfig) -> FollowCommand:
    """The command before the first: at rest, waiting for a pose."""
    zero, none = np.zeros(3), np.full(3, np.nan)
    return FollowCommand(t_ns, zero, zero, zero, zero, config.valid_s, "waiting", 0.0, none, none)


def follow_step(
    last: FollowCommand, pose: SmoothedPose | None, is_fresh: bool, t_ns: int, station: Pose, config: FollowerConfig
) -> FollowCommand:
    """The next command.

    Args:
        last: The last command; ``rest_command`` at first.
        pose: The smoothed relative pose, or None while there is none.
        is_fresh: Whether it rests on a capture that was not yet used.
        t_ns: Now, ns, not before ``last.t_ns``.
        station: Where to be: wanted ``beacon_from_body``.
        config: Gains and limits.

    Returns:
        The command. Without a fresh pose the velocity is first kept, then braked to rest; after ``abort_s`` it stays
        ``aborted`` whatever comes.
    """
    velocity, rate = last.twist_at(t_ns)
    elapsed_s = s_from_ns(t_ns - last.t_ns)
    age_s = last.age_s + elapsed_s if pose is None else s_from_ns(t_ns - pose.t_ns)
    mode = _mode(last.mode, age_s, is_fresh and pose is not None, config)
    none = np.full(3, np.nan)
    zero = np.zeros(3)
    push, turn, error_m, error_rad = zero, zero, none, none
    if mode == "following" and pose is not None:
        here = pose.leader_from_body
        error_m = here.t_m - station.t_m
        error_rad = so3_log(station.R.T @ here.R)
        push = here.R.T @ _cascade(
            error_m, pose.velocity_mps, config.frequency_radps, config.damping, config.closing_mps,
            config.acceleration_mps2, config.dead_band_m,
        )  # fmt: skip
        turn = _cascade(
            error_rad, pose.rate_radps, config.turning_frequency_radps, config.damping, config.turning_closing_radps,
            config.angular_acceleration_radps2, config.dead_band_rad,
        )  # fmt: skip
    elif mode in ("braking", "aborted"):
        push, turn = -velocity / config.valid_s, -rate / config.valid_s
    return FollowCommand(
        t_ns,
        velocity,
        _within(velocity, push, config.speed_mps, config.acceleration_mps2, config.valid_s),
        rate,
        _within(rate, turn, config.rate_radps, config.angular_acceleration_radps2, config.valid_s),
        config.valid_s,
        mode,
        age_s,
        error_m,
        error_rad,
    )


def _mode(last: Mode, age_s: float, is_fresh: bool, config: FollowerConfig) -> Mode:
    if last == "aborted" or age_s > config.abort_s:
        return "aborted"
    # A pose older than the patience with none at all is no better than none.
    if is_fresh and age_s <= config.hold_s:
        return "following"
    if last == "waiting":
        return "waiting"
    return "holding" if age_s <= config.hold_s else "braking"


def _cascade(
    error: FloatArray,
    velocity: FloatArray,
    frequency_radps: float,
    damping: float,
    closing: float,
    acceleration: float,
    dead_band: float,
) -> FloatArray:
    """Acceleration towards zero error, by way of a closing speed that can still be braked."""
    size = float(np.linalg.norm(error))
    wanted = np.zeros(3)
    if size > dead_band:
        beyond = size - dead_band
        linear = 0.5 * frequency_radps / damping * beyond
        speed = min(linear, float(np.sqrt(2.0 * _BRAKING_SHARE * acceleration * beyond)), closing)
        wanted = -error * (speed / size)
    return 2.0 * damping * frequency_radps * (wanted - velocity)


def _within(velocity: FloatArray, push: FloatArray, speed: float, most: float, valid_s: float) -> FloatArray:
    """The acceleration nearest to what is asked that keeps both limits for as long as it is obeyed."""
    push = _clipped(push, most)
    return _clipped((_clipped(velocity + valid_s * push, speed) - velocity) / valid_s, most)


def _clipped(vector: FloatArray, most: float) -> FloatArray:
    size = float(np.linalg.norm(vector))
    return vector if size <= most else vector * (most / size)
