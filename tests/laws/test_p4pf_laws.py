"""Laws of the solver with unknown focal lengths."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uvgs_bench.accuracy.solver_problems import draw_problems, standard_protocol
from uvgs_bench.camera.lens import Lens
from uvgs_bench.sensor.quadrics import intersect_quadrics, real_roots
from uvgs_bench.sensor.solvers.p4pf import find_focal_poses

POINTS_M = np.array([[0.005, 0.077, -0.002], [-0.05, -0.068, -0.016], [0.054, -0.009, -0.013], [0.033, -0.048, -0.062]])
NOMINAL = Lens("plumb_bob", 1280, 960, np.array([608.0, 608.0, 639.5, 479.5, 0.0, 0.0, 0.0, 0.0, 0.0]))


def exact(seed: int):
    """One pose with exact centroids: R, t, px."""
    drawn = draw_problems(standard_protocol("paper", POINTS_M), 1, np.random.default_rng(seed))
    R, t = drawn.R_cb[0], drawn.t_cb_m[0]
    return R, t, NOMINAL.project(POINTS_M @ R.T + t)


def error_of(found, R, t):
    return float(
        np.abs(found.camera_from_beacon.R - R).max()
        + np.abs(found.camera_from_beacon.t_m - t).max() / np.linalg.norm(t)
    )


@given(seed=st.integers(0, 10**6), fx=st.floats(0.7, 1.4), fy=st.floats(0.7, 1.4))
def test_true_pose_and_focal_lengths_are_among_the_solutions(seed, fx, fy):
    R, t, _ = exact(seed)
    true = NOMINAL.with_parameters([608.0 * fx, 608.0 * fy, 639.5, 479.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    px = true.project(POINTS_M @ R.T + t)
    found = find_focal_poses(NOMINAL, POINTS_M, px)
    assert 1 <= len(found) <= 8
    best = min(found, key=lambda f: error_of(f, R, t))
    # 1e-6 px: weak perspective magnifies rounding by some 1e5.
    assert best.fx_px == pytest.approx(true.fx_px, abs=1e-6)
    assert best.fy_px == pytest.approx(true.fy_px, abs=1e-6)
    assert error_of(best, R, t) < 1e-8


@given(seed=st.integers(0, 10**6))
def test_every_solution_puts_the_points_on_their_pixels(seed):
    rng = np.random.default_rng(seed)
    _, _, px = exact(seed)
    px = px + rng.normal(size=px.shape) * 0.2
    for found in find_focal_poses(NOMINAL, POINTS_M, px):
        lens = NOMINAL.with_parameters([found.fx_px, found.fy_px, 639.5, 479.5, 0.0, 0.0, 0.0, 0.0, 0.0])
        again = lens.project(found.camera_from_beacon.apply(POINTS_M))
        # Eight numbers, eight unknowns: the fit is exact, here to 1e-6 px.
        np.testing.assert_allclose(again, px, atol=1e-6)


@given(seed=st.integers(0, 10**6), scale=st.floats(0.01, 100.0))
def test_a_larger_beacon_is_the_same_picture_farther_away(seed, scale):
    _, _, px = exact(seed)
    one = find_focal_poses(NOMINAL, POINTS_M, px)
    other = find_focal_poses(NOMINAL, POINTS_M * scale, px)
    assert len(one) == len(other)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(
            b.camera_from_beacon.t_m, a.camera_from_beacon.t_m * scale, rtol=1e-6, atol=1e-7 * scale
        )


@given(seed=st.integers(0, 10**6), order=st.permutations(range(4)))
def test_the_order_of_the_points_does_not_matter(seed, order):
    R, t, px = exact(seed)
    found = find_focal_poses(NOMINAL, POINTS_M[order], px[order])
    assert min(error_of(f, R, t) for f in found) < 1e-8


def test_coplanar_points_have_no_answer():
    flat = POINTS_M * np.array([1.0, 1.0, 0.0])
    R, t, _ = exact(4)
    assert find_focal_poses(NOMINAL, flat, NOMINAL.project(flat @ R.T + t)) == ()


def test_one_focal_length_agrees_with_poselib():
    poselib = pytest.importorskip("poselib")
    for seed in range(20):
        R, t, px = exact(seed)
        # poselib wants pixels from the principal point and one focal length.
        poses, focals = poselib.p4pf(list(px - [639.5, 479.5]), list(POINTS_M), False)[:2]
        assert len(poses) > 0
        mine = min(find_focal_poses(NOMINAL, POINTS_M, px), key=lambda f: error_of(f, R, t))
        # 1e-4 of the focal length: poselib's elimination is not polished.
        assert min(abs(float(np.ravel(f)[0]) - mine.fx_px) for f in focals) < 1e-4 * 608.0


@given(roots=st.lists(st.floats(-3.0, 3.0, allow_subnormal=False), min_size=2, max_size=8))
def test_separate_real_roots_are_all_found(roots):
    roots = np.sort(roots)
    if np.diff(roots).min() < 0.05:
        return
    polynomial = np.polynomial.polynomial.polyfromroots(roots)
    out = np.empty(len(roots))
    assert real_roots(polynomial, -3.5, 3.5, out) == len(roots)
    # 1e-6: eight roots 0.05 apart are conditioned worse than 1e8.
    np.testing.assert_allclose(out, roots, atol=1e-6)


def test_three_planes_as_quadrics_meet_in_eight_points():
    # w_i^2 = c_i: the eight sign choices.
    c = np.array([0.25, 1.0, 2.25])
    # A turn keeps the unknowns from being separated already.
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    Q = np.zeros((3, 4, 4))
    for k in range(3):
        Q[k, :3, :3] = np.outer(turn[k], turn[k])
        Q[k, 3, 3] = -c[k]
    points = np.empty((8, 3))
    assert intersect_quadrics(Q, 3.5, points) == 8
    np.testing.assert_allclose((points @ turn.T) ** 2, np.tile(c, (8, 1)), atol=1e-12)
