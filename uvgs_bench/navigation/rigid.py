"""A rigid body on a trajectory of six coordinates: x, y, z, yaw, pitch, roll."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.navigation.trajectory import TrajectoryState

_X, _Y, _Z = np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class RigidState:
    """A body at one instant.

    Args:
        pose: ``world_from_body``, or between the frames asked for.
        velocity_mps: Velocity of the body's origin, shape (3,), m/s, axes of the target frame.
        acceleration_mps2: Its acceleration, shape (3,), m/s^2, axes of the target frame.
        rate_radps: Angular velocity, shape (3,), rad/s, axes of the body, as a gyroscope measures it.
        angular_acceleration_radps2: Its derivative, shape (3,), rad/s^2, axes of the body.
    """

    pose: Pose
    velocity_mps: FloatArray
    acceleration_mps2: FloatArray
    rate_radps: FloatArray
    angular_acceleration_radps2: FloatArray


def rigid_state(state: TrajectoryState, target: str = "world", source: str = "body") -> RigidState:
    """The body for six coordinates; the angles are intrinsic Z-Y-X.

    Args:
        state: Coordinates x, y, z (m), yaw, pitch, roll (rad) with their rates.
        target: Target frame.
        source: Source frame.

    Returns:
        The body.

    Raises:
        ValueError: Not six coordinates.
    """
    if state.position.shape != (6,):
        raise ValueError(f"a rigid body has six coordinates, got {state.position.shape}")
    yaw, pitch, roll = state.position[3:]
    roll_back, pitch_back = so3_exp(-roll * _X), so3_exp(-pitch * _Y)
    R = so3_exp(yaw * _Z) @ so3_exp(pitch * _Y) @ so3_exp(roll * _X)
    # Columns: what a rate of yaw, pitch and roll is worth in axes of the body.
    E = np.stack((roll_back @ pitch_back @ _Z, roll_back @ _Y, _X), axis=1)
    rates, changes = state.velocity[3:], state.acceleration[3:]
    # Each column turns back with the angles inside it.
    turn = np.cross(-(rates[2] * _X), E[:, 1])
    inner = -(rates[2] * _X + rates[1] * (roll_back @ _Y))
    E_dot = np.stack((np.cross(inner, E[:, 0]), turn, np.zeros(3)), axis=1)
    return RigidState(
        pose=Pose(R, state.position[:3], target, source),
        velocity_mps=state.velocity[:3],
        acceleration_mps2=state.acceleration[:3],
        rate_radps=E @ rates,
        angular_acceleration_radps2=E @ changes + E_dot @ rates,
    )
