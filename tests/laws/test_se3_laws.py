"""Laws of SO(3) and SE(3), at identity, near identity, near pi and in general."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings

from tests.helpers.strategies import poses, rotation_vectors, twists
from uvgs_bench.errors import FrameMismatch
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import (
    euler_zyx_from_rotation,
    is_near_gimbal_lock,
    mean_rotation,
    quaternion_from_rotation,
    rotation_from_euler_zyx,
    rotation_from_quaternion,
    se3_adjoint,
    se3_exp,
    se3_left_jacobian,
    se3_left_jacobian_inverse,
    se3_log,
    so3_exp,
    so3_log,
)

# A rotation has entries of order 1, a twist here of order pi: a few hundred rounding errors of double precision.
ROUNDING = 1e-13
# The logarithm near pi divides by nothing small (quaternion form), but v passes through a matrix inverse.
LOG_ROUNDING = 1e-11


@given(rotation_vectors())
def test_exp_gives_rotations_and_log_returns(w):
    R = so3_exp(w)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=ROUNDING)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=ROUNDING)
    np.testing.assert_allclose(so3_log(R), w, atol=LOG_ROUNDING)


@given(rotation_vectors())
def test_small_angles_keep_relative_digits(w):
    scaled = w * 1e-9
    np.testing.assert_allclose(so3_log(so3_exp(scaled)), scaled, rtol=1e-12, atol=1e-24)


def test_half_turns_have_a_logarithm_of_length_pi():
    for axis in np.eye(3):
        R = 2.0 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_allclose(np.abs(so3_log(R)), np.pi * axis, atol=LOG_ROUNDING)


@given(twists())
def test_se3_log_inverts_exp(xi):
    R, t = se3_exp(xi)
    np.testing.assert_allclose(se3_log(R, t), xi, atol=1e-9)  # rad and m: v is divided by sin(pi/2 - 5e-10) at worst


@given(twists(), twists())
def test_adjoint_carries_twists_through(xi, eta):
    R, t = se3_exp(xi)
    eta = 0.1 * eta
    T = Pose(R, t, "camera", "camera")
    left = T @ Pose.exp(eta, "camera", "camera") @ T.inverse()
    right = Pose.exp(se3_adjoint(R, t) @ eta, "camera", "camera")
    np.testing.assert_allclose(left.matrix(), right.matrix(), atol=1e-11)  # m: products of lengths up to 10 m


@given(twists(3.0))
def test_left_jacobian_inverse_is_the_inverse(xi):
    np.testing.assert_allclose(se3_left_jacobian(xi) @ se3_left_jacobian_inverse(xi), np.eye(6), atol=1e-11)


@given(rotation_vectors())
def test_quaternion_round_trip(w):
    R = so3_exp(w)
    q = quaternion_from_rotation(R)
    assert q[3] >= 0.0
    np.testing.assert_allclose(rotation_from_quaternion(q), R, atol=ROUNDING)
    np.testing.assert_allclose(rotation_from_quaternion(-3.0 * q), R, atol=ROUNDING)


@given(rotation_vectors())
def test_euler_angles_round_trip(w):
    R = so3_exp(w)
    np.testing.assert_allclose(rotation_from_euler_zyx(*euler_zyx_from_rotation(R)), R, atol=1e-8)  # rad, at the pole


def test_gimbal_lock_is_said_beyond_80_degrees_of_pitch():
    for pitch_deg, is_near in ((0.0, False), (79.0, False), (-79.0, False), (81.0, True), (-81.0, True), (90.0, True)):
        R = rotation_from_euler_zyx(0.3, np.radians(pitch_deg), -2.0)
        assert is_near_gimbal_lock(R) is is_near


def test_euler_angles_at_the_pole_still_give_the_rotation():
    R = rotation_from_euler_zyx(0.3, np.pi / 2, -0.2)
    np.testing.assert_allclose(rotation_from_euler_zyx(*euler_zyx_from_rotation(R)), R, atol=1e-8)


@settings(max_examples=30)
@given(poses("camera", "gantry"), poses("gantry", "carriage"), poses("carriage", "beacon"))
def test_composition_is_associative_and_inverts(a, b, c):
    left, right = (a @ b) @ c, a @ (b @ c)
    np.testing.assert_allclose(left.matrix(), right.matrix(), atol=1e-12)
    identity = left @ left.inverse()
    np.testing.assert_allclose(identity.matrix(), np.eye(4), atol=1e-12)
    assert (identity.target, identity.source) == ("camera", "camera")


@given(poses("camera", "beacon"))
def test_frames_that_do_not_meet_are_refused(pose):
    with pytest.raises(FrameMismatch, match="'beacon' and 'camera' do not meet"):
        pose @ pose


@settings(max_examples=20)
@given(rotation_vectors(), rotation_vectors(0.5))
def test_mean_of_a_rotation_and_its_opposite_step_is_the_middle(w, step):
    R = so3_exp(w)
    pair = np.array([R @ so3_exp(step), R @ so3_exp(-step), R])
    np.testing.assert_allclose(mean_rotation(pair), R, atol=1e-12)
