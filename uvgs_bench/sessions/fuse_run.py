"""A recorded run as a source of fusion: the camera seen from the beacon, as if the beacon stood still in the world.

The truth is where the registered gantry was; between two samples it is joined by the smoothest path that has the
reported velocities. The inertial unit is simulated along it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from uvgs_bench.accuracy import fit_registration
from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.devices.sim.imu import TrueImu, simulate_imu
from uvgs_bench.errors import RunError
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.geometry.se3 import so3_exp, so3_left_jacobian, so3_log
from uvgs_bench.navigation.fusion_data import FusionInput
from uvgs_bench.navigation.imu import STANDARD_GRAVITY_MPS2
from uvgs_bench.navigation.rigid import RigidState
from uvgs_bench.navigation.states import SensedPose
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.store.observations import observations_from_run
from uvgs_bench.store.run import read_run
from uvgs_bench.units import ns_from_s, s_from_ns

# Differences of the path over this, s, make its rates.
_STEP_S = 1e-4
_REST_S = 3.0


def read_run_input(path: Path, seed: int) -> FusionInput:
    """Read a run with a simulated inertial unit.

    Args:
        path: The run folder.
        seed: Seed of the unit.

    Returns:
        The input; its truth is the registered gantry.

    Raises:
        RunError: The run cannot be read, or has fewer than 4 samples.
        RegistrationError: Its frames cannot be registered.
    """
    run = read_run(path)
    if len(run.samples) < 4:
        raise RunError(f"fusion needs at least 4 samples, it has {len(run.samples)}", str(path))
    obs = observations_from_run(run)
    registration = fit_registration(obs, gantry_sigma_m=run.manifest.gantry_sigma_m, nominal=run.manifest.mounted)
    R_cb, t_cb = registration.predict(obs)
    motion = _Path(obs, R_cb, t_cb)
    # Gravity along the picture's columns, for want of anything that tells.
    gravity = read_only(STANDARD_GRAVITY_MPS2 * motion.at(_REST_S).pose.R[:, 1])
    unit = simulate_imu(motion.at, motion.duration_s + 0.1, TrueImu(), gravity, np.random.default_rng((seed, 12)))
    begin_ns = motion.begin_ns
    sensed = []
    for sample in run.samples:
        if isinstance(sample.outcome, PoseEstimate):
            pose = SensedPose.of(sample.outcome)
            sensed.append(SensedPose(sample.t_ns - begin_ns, pose.camera_from_beacon, pose.covariance, 0, pose.led_px,
                                     pose.noise_covariance))  # fmt: skip
    unique = {pose.t_ns: pose for pose in sensed}
    steps_s = np.diff(sorted(unique)) / 1e9
    longest_s = float(steps_s.max()) if len(steps_s) else float("inf")
    return FusionInput(
        name=run.manifest.id,
        words=f"run {run.manifest.id}: the camera seen from the beacon, inertial unit simulated",
        imu=unit.samples,
        sensed=tuple(unique[t_ns] for t_ns in sorted(unique)),
        native=(),
        world_from_beacon=Pose.identity("world", "beacon"),
        body_from_camera=Pose.identity("body", "camera"),
        leds_m=run.beacon.positions_m,
        focal_px=run.calibration.lens.fx_px,
        lens=run.calibration.lens,
        gravity_mps2=gravity,
        rest_s=_REST_S,
        misses_ns=tuple((s.t_ns - begin_ns, s.reason) for s in run.samples if not s.is_solved),
        truth=lambda t_ns: motion.at(s_from_ns(t_ns)),
        is_simulated=True,
        remarks=(
            "The inertial unit is simulated along the registered gantry's path; between samples that path is the "
            f"smoothest one, and up to {longest_s:.1f} s pass from pose to pose.",
            "Errors are against the gantry as registered by this run's own poses.",
        ),
    )


class _Path:
    """Camera in the beacon's frame through the samples, by cubic pieces with the reported velocities."""

    def __init__(self, obs: Observations, R_cb: FloatArray, t_cb: FloatArray) -> None:
        from scipy.interpolate import CubicHermiteSpline

        order = np.unique(obs.t_ns, return_index=True)[1]
        # It stands still before the first sample, so that biases can be measured.
        self.begin_ns = int(obs.t_ns[order][0]) - ns_from_s(_REST_S)
        t_s = (obs.t_ns[order] - self.begin_ns) / 1e9
        self.duration_s = float(t_s[-1])
        poses = [Pose(R, t, "body", "beacon").inverse() for R, t in zip(R_cb[order], t_cb[order], strict=True)]
        self._R_first = poses[0].R
        knots = np.array([np.concatenate((p.t_m, so3_log(np.ascontiguousarray(self._R_first.T @ p.R)))) for p in poses])
        # Rates where the carriage moved; at rest none, so that it starts and stops smoothly.
        is_moving = np.linalg.norm(obs.velocity_gs_mps[order], axis=1) > 0.0
        rates = np.gradient(knots, t_s, axis=0) * is_moving[:, None]
        self._spline = CubicHermiteSpline(t_s, knots, rates)

    def at(self, t_s: float) -> RigidState:
        """The camera as a body at a time since the first sample, s."""
        t_s = min(max(t_s, _REST_S), self.duration_s)
        x, v, a = (np.asarray(self._spline(t_s, k), dtype=np.float64) for k in range(3))
        before, after = (self._rate(t_s + s * _STEP_S) for s in (-1.0, 1.0))
        R = self._R_first @ so3_exp(np.ascontiguousarray(x[3:]))
        change = read_only((after - before) / (2.0 * _STEP_S))
        return RigidState(Pose(R, x[:3], "world", "body"), read_only(v[:3]), read_only(a[:3]), self._rate(t_s), change)

    def _rate(self, t_s: float) -> FloatArray:
        w, w_dot = (np.asarray(self._spline(t_s, k), dtype=np.float64)[3:] for k in range(2))
        return read_only(so3_left_jacobian(np.ascontiguousarray(-w)) @ w_dot)
