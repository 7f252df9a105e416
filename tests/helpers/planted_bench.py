"""A bench with known truth as plain numbers: what the sensor and the gantry would say, without pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.accuracy.observations import Mount, Observations
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import se3_adjoint, se3_exp, so3_exp


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the sensor in camera axes: of one capture, and of what a place's captures share."""

    capture_m: tuple[float, float, float] = (2e-4, 2e-4, 1e-3)
    capture_rad: tuple[float, float, float] = (4e-3, 4e-3, 1e-3)
    place_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    place_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)


NOISELESS = Noise((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def planted_poses(mount: Mount = "beacon_on_carriage") -> tuple[Pose, Pose]:
    """True left and right pose: the beacon about 1.5 m in front of the camera, with offsets and tilts."""
    if mount == "beacon_on_carriage":
        left = Pose(so3_exp(np.array([0.10, -0.15, 0.05])), np.array([0.05, -0.03, 1.5]), "camera", "gantry")
        right = Pose(so3_exp(np.array([-0.08, 0.12, 0.20])), np.array([0.02, 0.01, -0.04]), "carriage", "beacon")
    else:
        left = Pose(so3_exp(np.array([0.05, 0.02, -0.10])), np.array([0.01, 0.02, 0.03]), "camera", "carriage")
        right = Pose(so3_exp(np.array([0.10, -0.05, 0.30])), np.array([0.05, -0.03, 1.5]), "gantry", "beacon")
    return left, right


def carriage_places(kind: str, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Rotations and translations of gantry_from_carriage: ``3T 2T line 3T1R 2T1R 1R 3T2R``."""
    t = rng.uniform(-0.25, 0.25, (count, 3))
    R = np.tile(np.eye(3), (count, 1, 1))
    if kind == "2T":
        t[:, 2] = 0.0
    elif kind == "line":
        t = t[:, :1] * np.array([[0.6, 0.0, 0.8]])
    elif kind == "1R":
        t[:] = 0.0
    elif kind == "2T1R":
        t[:, 2] = 0.0
    if kind.endswith("1R"):
        axis = np.array([0.0, 1.0, 0.0])
        R = np.array([so3_exp(axis * a) for a in rng.uniform(-0.5, 0.5, count)])
    elif kind.endswith("2R"):
        R = np.array([so3_exp(np.array([a, b, 0.0])) for a, b in rng.uniform(-0.4, 0.4, (count, 2))])
    return R, t


def planted_observations(
    kind: str,
    places: int,
    captures: int,
    rng: np.random.Generator,
    noise: Noise = Noise(),
    *,
    mount: Mount = "beacon_on_carriage",
    register_every: int = 0,
) -> Observations:
    """Captures of a bench with known truth; every ``register_every``-th place registers, or all when 0."""
    left, right = planted_poses(mount)
    R_gs, t_gs = carriage_places(kind, places, rng)
    N = places * captures
    R_cb, t_cb = np.empty((N, 3, 3)), np.empty((N, 3))
    covariance = np.empty((N, 6, 6))
    P_camera = np.diag(
        np.array([*noise.capture_rad, *noise.capture_m]) ** 2 + np.array([*noise.place_rad, *noise.place_m]) ** 2
    )
    for s in range(places):
        carriage = Pose(R_gs[s], t_gs[s], *(("gantry", "carriage")))
        truth = left @ (carriage if mount == "beacon_on_carriage" else carriage.inverse()) @ right
        shared_turn = rng.normal(size=3) * noise.place_rad
        shared_shift = rng.normal(size=3) * noise.place_m
        # (rotation, translation error in camera axes) -> left tangent: v = dt - omega x t.
        K = se3_adjoint(np.eye(3), np.ascontiguousarray(truth.t_m))
        for c in range(captures):
            i = s * captures + c
            R_cb[i] = so3_exp(shared_turn + rng.normal(size=3) * noise.capture_rad) @ truth.R
            t_cb[i] = truth.t_m + shared_shift + rng.normal(size=3) * noise.capture_m
            covariance[i] = K @ P_camera @ K.T + 1e-16 * np.eye(6)
    station = np.repeat(np.arange(places), captures).astype(np.int64)
    role = tuple("register" if register_every == 0 or s % register_every == 0 else "judge" for s in station)
    return Observations(
        station=station,
        role=role,
        t_ns=np.arange(N, dtype=np.int64) * 100_000_000,
        axis_position=np.repeat(t_gs, captures, axis=0),
        R_gs=np.repeat(R_gs, captures, axis=0),
        t_gs_m=np.repeat(t_gs, captures, axis=0),
        R_cb=R_cb,
        t_cb_m=t_cb,
        covariance=covariance,
        is_solved=np.ones(N, dtype=np.bool_),
        reason=("",) * N,
        mount=mount,
    )


def perturbed(R: FloatArray, t_m: FloatArray, xi: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Left update of one pose by a twist."""
    dR, dt = se3_exp(np.ascontiguousarray(xi))
    return dR @ R, dR @ t_m + dt
