"""The latency a follower bears, found by trying: law, filter and body as they are, poses without noise or pictures."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from uvgs_bench.devices.follow_link import BodyState
from uvgs_bench.devices.sim.free_flyer import Environment, FlyerConfig, FreeFlyer
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.navigation.follower import FollowerConfig, follow_step, rest_command
from uvgs_bench.navigation.pose_filter import PoseFilterConfig, PoseMemory, RelativePose, smoothed, take_pose
from uvgs_bench.units import ns_from_s

# What the sensor states where it does not matter: 1 mm and 1 mrad.
_COVARIANCE = np.diag(np.full(6, 1e-6))
_START_M = np.array([0.02, 0.0, 0.0])
_LASTING_S = 24.0
_STEPS = 6


def simulated_largest_latency(
    law: FollowerConfig,
    filtering: PoseFilterConfig,
    flyer: FlyerConfig,
    period_s: float,
    longest_s: float,
    environment: Environment = "microgravity",
) -> float:
    """The largest latency at which an error of 20 mm dies away instead of growing.

    Args:
        law: The law; its dead bands and its patience with old poses are left out.
        filtering: The filter.
        flyer: The body, with its thrusters' limits but without the errors of its own velocity.
        period_s: Time between captures, s.
        longest_s: Where to look: it is bisected down to a 64th of this, s.
        environment: Where the body lives.

    Returns:
        The latency, s; 0 when none is borne, nearly ``longest_s`` when all are.
    """
    law = replace(law, dead_band_m=0.0, dead_band_rad=0.0, hold_s=_LASTING_S, abort_s=_LASTING_S)
    body = replace(flyer, velocity_error_mps=0.0, rate_error_radps=0.0, friction=0.0)
    low_s, high_s = 0.0, longest_s

    def dies_away(latency_s: float) -> bool:
        errors_m = _errors(law, filtering, body, period_s, latency_s, environment)
        third = len(errors_m) // 3
        first, last = errors_m[third : 2 * third], errors_m[2 * third :]
        # Below what a thruster's least impulse moves it in a second, it only flickers.
        floor_m = 2.0 * body.impulse_n_s / body.mass_kg
        return bool(np.max(last) < max(0.9 * np.max(first), floor_m))

    for _ in range(_STEPS):
        middle_s = 0.5 * (low_s + high_s)
        low_s, high_s = (middle_s, high_s) if dies_away(middle_s) else (low_s, middle_s)
    return low_s


def _errors(
    law: FollowerConfig,
    filtering: PoseFilterConfig,
    body: FlyerConfig,
    period_s: float,
    latency_s: float,
    environment: Environment,
) -> FloatArray:
    """Size of the position error at each capture, m, the leader at rest."""
    station = Pose.identity("beacon", "body")
    leader = Pose.identity("world", "beacon")
    start = BodyState(0, Pose(np.eye(3), _START_M, "world", "body"), np.zeros(3), np.zeros(3))
    flyer = FreeFlyer(body, start, environment)
    memory, command = PoseMemory(), rest_command(0, law)
    latency_ns, errors_m = ns_from_s(latency_s), []
    pending: deque[tuple[int, RelativePose]] = deque()
    for k in range(round(_LASTING_S / period_s)):
        t_ns = ns_from_s(k * period_s)
        while pending and pending[0][0] <= t_ns:
            ready_ns, pose = pending.popleft()
            memory, accepted = take_pose(memory, pose, filtering)
            command = follow_step(command, smoothed(memory, filtering), accepted, ready_ns, station, law)
            flyer.send(command)
        here = leader.inverse() @ flyer.state_at(t_ns).world_from_body
        errors_m.append(float(np.linalg.norm(here.t_m)))
        pending.append((t_ns + latency_ns, RelativePose(t_ns, here, _COVARIANCE)))
    return np.array(errors_m)
