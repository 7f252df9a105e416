"""Pose: what it refuses and what it promises."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.errors import FrameMismatch
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_exp


def test_unknown_frame_is_refused():
    with pytest.raises(FrameMismatch, match="unknown frame 'robot'"):
        Pose.identity("camera", "robot")


@pytest.mark.parametrize("R", [np.eye(3) * 1.01, np.diag([1.0, 1.0, -1.0]), np.full((3, 3), np.nan), np.eye(2)])
def test_what_is_no_rotation_is_refused(R):
    with pytest.raises(ValueError, match=r"rotation|finite"):
        Pose(R, np.zeros(3), "camera", "beacon")


def test_values_cannot_be_written():
    pose = Pose.identity("camera", "beacon")
    with pytest.raises(ValueError, match="read-only"):
        pose.t_m[0] = 1.0


def test_apply_takes_one_point_or_many():
    pose = Pose(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([0.0, 0.0, 2.0]), "camera", "beacon")
    np.testing.assert_allclose(pose.apply([1.0, 0.0, 0.0]), [0.0, 1.0, 2.0], atol=1e-15)
    np.testing.assert_allclose(pose.apply([[1.0, 0.0, 0.0]] * 2), [[0.0, 1.0, 2.0]] * 2, atol=1e-15)


def test_left_update_is_in_the_target_frame():
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 2.0]), "camera", "beacon")
    turned = pose.perturbed([0.0, 0.1, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(turned.t_m, [2.0 * np.sin(0.1), 0.0, 2.0 * np.cos(0.1)], atol=1e-15)


def test_is_close_keeps_rotation_and_translation_apart():
    pose = Pose.identity("camera", "beacon")
    moved = pose.perturbed([0.0, 0.0, 0.02, 0.001, 0.0, 0.0])
    assert moved.is_close(pose, rotation_rad=0.021, translation_m=0.0011)
    assert not moved.is_close(pose, rotation_rad=0.019, translation_m=0.0011)
    assert not moved.is_close(pose, rotation_rad=0.021, translation_m=0.0009)
    assert not moved.is_close(Pose.identity("camera", "board"), rotation_rad=1.0, translation_m=1.0)
