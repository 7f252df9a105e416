"""The model of a bench: what the camera should see of the beacon, for given constant poses and carriage positions."""

from __future__ import annotations

import numpy as np

from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.tangent import adjoints, left_jacobian_inverses, pose_logs
from uvgs_bench.geometry import FloatArray, Pose


def carriage_motion(obs: Observations) -> tuple[FloatArray, FloatArray]:
    """``G`` of every capture: gantry_from_carriage, or its inverse when the camera rides.

    Args:
        obs: Captures.

    Returns:
        Rotations (N, 3, 3) and translations (N, 3), m.
    """
    if obs.mount == "beacon_on_carriage":
        return obs.R_gs, obs.t_gs_m
    R = obs.R_gs.transpose(0, 2, 1)
    return R, -np.einsum("nij,nj->ni", R, obs.t_gs_m)


def gantry_covariance(gantry_sigma_m: float) -> FloatArray:
    """Covariance of a capture's left tangent from an isotropic doubt of the carriage position, shape (6, 6)."""
    return np.diag([0.0, 0.0, 0.0, gantry_sigma_m**2, gantry_sigma_m**2, gantry_sigma_m**2])


def predicted(left: Pose, right: Pose, R_g: FloatArray, t_g_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``left @ G @ right`` for every capture.

    Args:
        left: The left pose.
        right: The right pose.
        R_g: Rotations of G, shape (N, 3, 3).
        t_g_m: Translations of G, shape (N, 3), m.

    Returns:
        Rotations (N, 3, 3) and translations (N, 3), m, of camera_from_beacon.
    """
    R = left.R @ R_g
    return R @ right.R, left.t_m + t_g_m @ left.R.T + R @ right.t_m


def prediction_jacobian(left: Pose, R_g: FloatArray, t_g_m: FloatArray) -> FloatArray:
    """Derivative of the left tangent of each prediction by the left tangents of both poses.

    Args:
        left: The left pose.
        R_g: Rotations of G, shape (N, 3, 3).
        t_g_m: Translations of G, shape (N, 3), m.

    Returns:
        Derivatives, shape (N, 6, 12), order left omega, v, right omega, v.
    """
    through = adjoints(left.R @ R_g, left.t_m + t_g_m @ left.R.T)
    return np.concatenate([np.broadcast_to(np.eye(6), through.shape), through], axis=2)


def pose_residuals(obs: Observations, R_predicted: FloatArray, t_predicted_m: FloatArray) -> FloatArray:
    """Left tangent that carries each prediction to its observation, in camera axes.

    Args:
        obs: Captures, all with a pose.
        R_predicted: Predicted rotations, shape (N, 3, 3).
        t_predicted_m: Predicted translations, shape (N, 3), m.

    Returns:
        ``log(B_observed B_predicted^-1)``, shape (N, 6), rad and m.
    """
    R = obs.R_cb @ R_predicted.transpose(0, 2, 1)
    return pose_logs(R, obs.t_cb_m - np.einsum("nij,nj->ni", R, t_predicted_m))


def residual_jacobian(residuals: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Derivative of ``pose_residuals`` by the parameters of the prediction.

    Args:
        residuals: Residuals, shape (N, 6), rad and m.
        jacobian: ``prediction_jacobian`` of the same captures, shape (N, 6, P).

    Returns:
        Derivatives, shape (N, 6, P).
    """
    return -left_jacobian_inverses(-residuals) @ jacobian
