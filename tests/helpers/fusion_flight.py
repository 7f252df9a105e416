"""A short flight with a simulated inertial unit and drawn poses: quick enough for many repeats."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from uvgs_bench.devices.sim.imu import SimulatedImu, TrueImu, simulate_imu
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.navigation.error_state_filter import ErrorStateFilter, FilterConfig, start_state
from uvgs_bench.navigation.imu import STANDARD_GRAVITY_MPS2
from uvgs_bench.navigation.rigid import RigidState, rigid_state
from uvgs_bench.navigation.states import PoseMeasurement
from uvgs_bench.navigation.trajectory import MotionLimits, PathPoint, plan_trajectory

GRAVITY = np.array([0.0, 0.0, -STANDARD_GRAVITY_MPS2])
SIGMA_RAD, SIGMA_M = 0.002, 0.002
NOISE = np.diag(np.repeat((SIGMA_RAD**2, SIGMA_M**2), 3))


@lru_cache(maxsize=1)
def path():
    """A 30 cm square with turns about all axes, at rest for 1 s at first."""
    corners = [(0.3, 0.0, 0.1, 0.3, 0.1, -0.1), (0.3, 0.3, 0.0, -0.2, 0.0, 0.1), (0.0, 0.3, 0.05, 0.1, -0.1, 0.0)]
    places = [np.zeros(6), *(np.array(corner) for corner in corners), np.zeros(6)]
    return plan_trajectory(
        [PathPoint(p, 1.0 if k == 0 else 0.1) for k, p in enumerate(places)], MotionLimits.rigid(0.1, 0.1)
    )


def state_at(t_ns: int) -> RigidState:
    return rigid_state(path().state_at(t_ns / 1e9))


@dataclass(frozen=True)
class Flight:
    """Readings with their true biases, and poses."""

    unit: SimulatedImu
    poses: tuple[PoseMeasurement, ...]
    config: FilterConfig
    imu_truth: TrueImu


def fly(seed: int, *, rate_hz: float = 10.0, gravity: np.ndarray = GRAVITY, offset_s: float = 0.0) -> Flight:
    """One flight; poses are stamped ``offset_s`` too late."""
    rng = np.random.default_rng(seed)
    truth = TrueImu(acceleration_bias_sigma_mps2=0.05, rate_bias_sigma_radps=0.005, rate_hz=100.0)
    unit = simulate_imu(lambda t: rigid_state(path().state_at(t)), path().duration_s, truth, gravity, rng)
    poses = []
    for t_s in np.arange(0.0, path().duration_s, 1.0 / rate_hz):
        t_ns = round(t_s * 1e9)
        noise = rng.standard_normal(6) * np.repeat((SIGMA_RAD, SIGMA_M), 3)
        true = state_at(t_ns).pose
        pose = Pose(so3_exp(noise[:3]) @ true.R, true.t_m + noise[3:], "world", "body")
        poses.append(PoseMeasurement(t_ns + round(offset_s * 1e9), pose, NOISE, "uvgs"))
    config = FilterConfig(noise=truth.noise, gravity_mps2=tuple(gravity))
    return Flight(unit, tuple(poses), config, truth)


def begun(flight: Flight, config: FilterConfig | None = None) -> ErrorStateFilter:
    """A filter that has seen the first pose only; its stated doubt is the one biases were drawn with."""
    start = start_state(
        flight.poses[0],
        velocity_sigma_mps=0.01,
        acceleration_bias_sigma_mps2=flight.imu_truth.acceleration_bias_sigma_mps2,
        rate_bias_sigma_radps=flight.imu_truth.rate_bias_sigma_radps,
    )
    return ErrorStateFilter(start, config or flight.config)


def run(flight: Flight, estimator: ErrorStateFilter, poses, delay_ns: int = 0, each=None) -> None:
    """Hand everything over as it becomes known; ``each(k)`` is called after every reading."""
    waiting = sorted(poses, key=lambda m: m.t_ns)
    samples = flight.unit.samples
    for k, t_ns in enumerate(samples.t_ns):
        estimator.add_imu(int(t_ns), samples.acceleration_mps2[k], samples.rate_radps[k])
        while waiting and waiting[0].t_ns + delay_ns <= t_ns:
            estimator.add_pose(waiting.pop(0))
        if each is not None:
            each(k)


def full_error(flight: Flight, estimator: ErrorStateFilter, k: int) -> np.ndarray:
    """Truth minus estimate in all fifteen errors after reading k."""
    said = estimator.state
    true = state_at(said.t_ns)
    return np.concatenate(
        (
            said.error_of(true.pose, true.velocity_mps),
            flight.unit.acceleration_bias_mps2[k] - said.acceleration_bias_mps2,
            flight.unit.rate_bias_radps[k] - said.rate_bias_radps,
        )
    )
