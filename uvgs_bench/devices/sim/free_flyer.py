"""A simulated free-flyer: a rigid body pushed by thrusters, weightless or on a granite table.

Body axes are those of its camera: x right, y down, z forward; world axes the same at the start. The body is its own
centre of mass. Momentum is what is integrated, so that without thrust it is kept exactly.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from typing import Literal

import numpy as np

from uvgs_bench.devices.follow_link import BodyState
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.navigation.follower import FollowCommand, FollowerConfig, rest_command
from uvgs_bench.units import ns_from_s, s_from_ns

Environment = Literal["microgravity", "granite"]
Vector = tuple[float, float, float]

_GRAVITY_MPS2 = 9.80665
_STEP_S = 0.01
_NONE = np.zeros(3)
# Fixed-point steps of the implicit midpoint of the attitude; each gains three digits at these rates.
_MIDPOINT_STEPS = 3
# On the table: pushes along x and z, turns about y; y is the vertical.
_FREE_PUSH = np.array([1.0, 0.0, 1.0])
_FREE_TURN = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, slots=True)
class FlyerConfig:
    """The body and its thrusters; the defaults are those of a cube of 0.3 m and 10 kg.

    Args:
        mass_kg: Mass, kg.
        inertia_kg_m2: Principal moments about body x, y, z, kg m^2.
        force_n: Largest force along each body axis, N.
        torque_n_m: Largest torque about each body axis, N m.
        impulse_n_s: Smallest impulse along an axis, N s; smaller wishes wait until they have gathered.
        angular_impulse_n_m_s: The same for turns, N m s.
        response_s: Time in which the body's own velocity control takes up a difference, s.
        velocity_error_mps: Standard deviation of the constant error of the own velocity it controls by, m/s.
        rate_error_radps: The same for its angular rate, rad/s.
        camera_mm: Where the camera sits on the body, body axes, mm; it looks forward.
        friction: Coefficient of friction of the air bearing on the granite.

    Raises:
        ValueError: A value outside its meaning, or moments no body can have.
    """

    mass_kg: float = 10.0
    inertia_kg_m2: Vector = (0.16, 0.15, 0.17)
    force_n: Vector = (0.8, 0.8, 0.8)
    torque_n_m: Vector = (0.08, 0.08, 0.08)
    impulse_n_s: float = 2e-3
    angular_impulse_n_m_s: float = 1e-4
    response_s: float = 0.2
    velocity_error_mps: float = 1e-3
    rate_error_radps: float = 5e-4
    camera_mm: Vector = (0.0, 0.0, 150.0)
    friction: float = 2e-4

    def __post_init__(self) -> None:
        a, b, c = sorted(self.inertia_kg_m2)
        if not (a > 0.0 and a + b >= c):
            raise ValueError(f"inertia_kg_m2: no body has principal moments {self.inertia_kg_m2}")
        positive = (self.mass_kg, self.response_s, *self.force_n, *self.torque_n_m)
        if not all(0.0 < value < np.inf for value in positive):
            raise ValueError("mass, response, forces and torques must be positive")
        others = (self.impulse_n_s, self.angular_impulse_n_m_s, self.velocity_error_mps, self.rate_error_radps)
        if not all(0.0 <= value < np.inf for value in (*others, self.friction)):
            raise ValueError("impulses, errors and friction must not be negative")


class FreeFlyer:
    """A body that obeys the commands of a follower law, and remembers where it was.

    Args:
        config: The body.
        start: Where it begins.
        environment: Weightless, or on the table.
        rng: Draws the errors of its own velocities.

    Raises:
        ValueError: On the table the body must start upright.
    """

    def __init__(
        self,
        config: FlyerConfig,
        start: BodyState,
        environment: Environment = "microgravity",
        rng: np.random.Generator | None = None,
    ) -> None:
        self.config = config
        self.environment = environment
        draw = np.random.default_rng(0) if rng is None else rng
        self._velocity_error_mps = config.velocity_error_mps * draw.standard_normal(3)
        self._rate_error_radps = config.rate_error_radps * draw.standard_normal(3)
        self._inertia = np.array(config.inertia_kg_m2)
        if environment == "granite" and abs(start.world_from_body.R[1, 1] - 1.0) > 1e-9:
            raise ValueError("on the table the body must start upright")
        self._command = rest_command(start.t_ns, FollowerConfig())
        self._states = [start]
        self._times_ns = [start.t_ns]
        self._owed_push = np.zeros(3)
        self._owed_turn = np.zeros(3)

    @property
    def has_own_time(self) -> bool:
        """It lives when it is asked."""
        return False

    def send(self, command: FollowCommand) -> None:
        """Obey this from ``command.t_ns`` on, until the next."""
        self.obey(self._command, command.t_ns)
        self._command = command

    def close(self) -> None:
        """Nothing to let go of."""

    @property
    def state(self) -> BodyState:
        """The newest state."""
        return self._states[-1]

    def state_at(self, t_ns: int) -> BodyState:
        """Where it is or was: it lives on under the last command until then; between two steps it drifts.

        Args:
            t_ns: Any instant, ns; before the first it stands at its start.

        Returns:
            The state.
        """
        self.obey(self._command, t_ns)
        i = bisect_right(self._times_ns, t_ns) - 1
        if i < 0:
            return self._states[0]
        known = self._states[i]
        dt_s = s_from_ns(t_ns - known.t_ns)
        if dt_s == 0.0:
            return known
        pose = known.world_from_body
        R = pose.R @ so3_exp(known.rate_radps * dt_s)
        return BodyState(
            t_ns, Pose(R, pose.t_m + dt_s * known.velocity_mps, "world", "body"), known.velocity_mps, known.rate_radps
        )

    def obey(self, command: FollowCommand, until_ns: int) -> None:
        """Push towards a commanded motion until an instant.

        Args:
            command: The command; it holds from the newest state on.
            until_ns: When to end, ns.
        """
        body, inertia = self.config, self._inertia
        while self.state.t_ns < until_ns:
            now = self.state
            velocity, rate = command.twist_at(now.t_ns)
            is_pushed = s_from_ns(now.t_ns - command.t_ns) < command.valid_s
            push, turn = (command.acceleration_mps2, command.angular_acceleration_radps2) if is_pushed else (_NONE,) * 2
            missing = velocity - now.world_from_body.R.T @ now.velocity_mps - self._velocity_error_mps
            missing_rate = rate - now.rate_radps - self._rate_error_radps
            force = body.mass_kg * (push + missing / body.response_s)
            # The gyroscopic torque is known, so it is met.
            gyroscopic = np.cross(now.rate_radps, inertia * now.rate_radps)
            torque = inertia * (turn + missing_rate / body.response_s) + gyroscopic
            self.push(force, torque, min(until_ns - now.t_ns, ns_from_s(_STEP_S)))

    def push(self, force_n: FloatArray, torque_n_m: FloatArray, duration_ns: int) -> None:
        """Let thrusters fire as far as they can, for one step.

        Args:
            force_n: Wanted force, body axes, shape (3,), N.
            torque_n_m: Wanted torque, body axes, shape (3,), N m.
            duration_ns: Length of the step, ns, > 0.
        """
        body, dt_s = self.config, s_from_ns(duration_ns)
        reach_push, reach_turn = np.array(body.force_n), np.array(body.torque_n_m)
        impulse, self._owed_push = _pulse(
            self._owed_push, np.clip(force_n, -reach_push, reach_push) * dt_s, body.impulse_n_s
        )
        turn, self._owed_turn = _pulse(
            self._owed_turn, np.clip(torque_n_m, -reach_turn, reach_turn) * dt_s, body.angular_impulse_n_m_s
        )
        now = self.state
        R, velocity = now.world_from_body.R, now.velocity_mps
        change = R @ impulse / body.mass_kg
        if self.environment == "granite":
            change, turn = change * _FREE_PUSH, turn * _FREE_TURN
            change = change - _friction(velocity + change, body.friction * _GRAVITY_MPS2 * dt_s)
        later_velocity = velocity + change
        momentum = R @ (self._inertia * now.rate_radps + turn)
        later_R, later_rate = _turned(R, now.rate_radps, momentum, self._inertia, dt_s)
        place = now.world_from_body.t_m + 0.5 * dt_s * (velocity + later_velocity)
        later = BodyState(
            now.t_ns + duration_ns, Pose(later_R, place, "world", "body"), read_only(later_velocity),
            read_only(later_rate),
        )  # fmt: skip
        self._states.append(later)
        self._times_ns.append(later.t_ns)


def _pulse(owed: FloatArray, wish: FloatArray, least: float) -> tuple[FloatArray, FloatArray]:
    """What fires now, and what is still owed: an impulse below the least waits."""
    gathered = owed + wish
    fires = np.abs(gathered) >= least
    return np.where(fires, gathered, 0.0), np.where(fires, 0.0, gathered)


def _friction(velocity: FloatArray, most: float) -> FloatArray:
    """Loss of speed by dry friction; it stops a body and never turns it back."""
    speed = float(np.linalg.norm(velocity))
    return velocity if speed <= most else velocity * (most / speed)


def _turned(
    R: FloatArray, rate: FloatArray, momentum: FloatArray, inertia: FloatArray, dt_s: float
) -> tuple[FloatArray, FloatArray]:
    """Attitude and body rate a step later, for an angular momentum in space; the momentum is kept exactly."""
    later = rate
    later_R = R
    for _ in range(_MIDPOINT_STEPS):
        later_R = R @ so3_exp(0.5 * dt_s * (rate + later))
        later = (later_R.T @ momentum) / inertia
    return later_R, later
