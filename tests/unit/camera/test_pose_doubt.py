"""The pose error a calibration causes, against poses fitted with drawn calibrations."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.camera import BoardView, Calibration, Lens
from uvgs_bench.camera.bundle import Bundle, Corners, refine_poses
from uvgs_bench.camera.pose_doubt import pose_doubt
from uvgs_bench.errors import CalibrationError
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import se3_exp, so3_exp, so3_log

LENS = Lens("plumb_bob", 1280, 960, np.array([1000.0, 1003.0, 645.0, 470.0, -0.2, 0.08, 8e-4, -5e-4, 0.01]))
POINTS_M = np.array([[0.12, 0.0, 0.0], [-0.06, 0.1, 0.0], [-0.06, -0.1, 0.0], [0.0, 0.0, -0.09]])
POSE = Pose(so3_exp(np.array([0.2, -0.3, 0.1])), np.array([0.3, -0.2, 1.5]), "camera", "beacon")


def joint() -> np.ndarray:
    """Small, so that first order is exact to a percent, and correlated."""
    rng = np.random.default_rng(1)
    scale = np.array([0.1, 0.1, 0.1, 0.1, 1e-4, 1e-4, 1e-5, 1e-5, 1e-4, *[2e-5] * 3, *[2e-5] * 3])
    root = scale[:, None] * rng.normal(size=(15, 15)) / np.sqrt(15.0)
    return root @ root.T


def fitted(lens: Lens, px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    corners = Corners.of([BoardView("v", px, POINTS_M, 1280, 960)])
    bundle = refine_poses(Bundle(lens, POSE.R[None], POSE.t_m[None]), corners)
    return bundle.R_cb[0], bundle.t_cb[0]


def errors(moves: np.ndarray, noise_px: float, rng: np.random.Generator) -> np.ndarray:
    found = []
    exact = LENS.project(POSE.apply(POINTS_M))
    for move in moves:
        # What is really seen: the true lens with points where the mean twist of the boards would put them back.
        dR, dt = se3_exp(np.ascontiguousarray(-move[9:]))
        lens = LENS.with_parameters(LENS.parameters + move[:9])
        R, t = fitted(lens, exact + rng.normal(0.0, noise_px, exact.shape))
        R, t = dR @ R, dR @ t + dt
        found.append(np.concatenate([so3_log(R @ POSE.R.T), t - POSE.t_m]))
    return np.array(found)


def test_both_parts_match_fitted_poses():
    rng = np.random.default_rng(2)
    C = joint()
    doubt = pose_doubt(Calibration(LENS, joint_covariance=C), POINTS_M, POSE, 0.05)
    none = np.zeros((400, 15))
    by_calibration = errors(rng.multivariate_normal(none[0], C, 400), 0.0, rng)
    by_noise = errors(none, 0.05, rng)
    # A deviation from 400 draws is good to 3.5 %; four of those.
    np.testing.assert_allclose(by_calibration.std(axis=0), doubt.calibration_sigmas, rtol=0.14)
    np.testing.assert_allclose(by_noise.std(axis=0), doubt.noise_sigmas, rtol=0.14)


def test_a_calibration_without_joint_and_points_behind_are_refused():
    with pytest.raises(CalibrationError, match="calibrate again"):
        pose_doubt(Calibration(LENS), POINTS_M, POSE, 0.05)
    behind = Pose(np.eye(3), np.array([0.0, 0.0, -1.0]), "camera", "beacon")
    with pytest.raises(CalibrationError, match="does not see"):
        pose_doubt(Calibration(LENS, joint_covariance=joint()), POINTS_M, behind, 0.05)
