"""The numeric Jacobian of the baseline against the analytic one, and the minimum both lead to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.accuracy.solver_problems import bounds_of, draw_problems, standard_protocol
from uvgs_bench.geometry import Pose
from uvgs_bench.sensor.pose_kernels import normal_equations
from uvgs_bench.sensor.solution import solver
from uvgs_bench.sensor.solvers.svgs_numeric import numeric_jacobian

POINTS_M = np.array([[0.005, 0.077, -0.002], [-0.05, -0.068, -0.016], [0.054, -0.009, -0.013], [0.033, -0.048, -0.062]])


@pytest.mark.parametrize("seed", range(5))
def test_numeric_and_analytic_jacobian_make_the_same_normal_equations(seed):
    drawn = draw_problems(standard_protocol("ours", POINTS_M), 20, np.random.default_rng(seed))
    lens, sigma = drawn.protocol.lens, np.array([0.1, 0.2, 0.3, 0.4])
    for R, t, px in zip(drawn.R_cb, drawn.t_cb_m, drawn.px, strict=True):
        H, g, e, J = np.zeros((6, 6)), np.zeros(6), np.zeros((4, 2)), np.zeros((8, 6))
        normal_equations(lens.model_id, lens.kernel_parameters, POINTS_M, px, sigma, R, t, t.copy(), H, g, e)
        assert numeric_jacobian(lens.model_id, lens.kernel_parameters, POINTS_M, px, sigma, R, t, J)
        # Derivative of the residual, so minus that of the projection.
        whitened = (e / sigma[:, None]).ravel()
        size = np.sqrt(np.diag(H))
        # 1e-8 of each column: central differences lose 1e-10 to curvature and 1e-9 to rounding.
        np.testing.assert_allclose((J.T @ J) / np.outer(size, size), H / np.outer(size, size), atol=1e-8)
        np.testing.assert_allclose(-J.T @ whitened / size, g / size, atol=1e-7)


@pytest.mark.parametrize("range_m", [(0.5, 1.5), (1.5, 3.0)])
def test_numeric_and_analytic_solver_reach_the_same_minimum(range_m):
    protocol = replace(standard_protocol("ours", POINTS_M), range_m=range_m)
    drawn = draw_problems(protocol, 300, np.random.default_rng(2))
    deviation = np.sqrt(np.einsum("nii->ni", bounds_of(drawn)))
    analytic, numeric = solver("uvgs_lm"), solver("svgs_numeric")
    gaps, whitened = [], []
    for i, px in enumerate(drawn.px):
        start = Pose(drawn.R_cb[i], drawn.t_cb_m[i], "camera", "beacon")
        a = analytic(protocol.lens, POINTS_M, px, drawn.sigma_px, start, 60)
        b = numeric(protocol.lens, POINTS_M, px, drawn.sigma_px, start, 60)
        assert a.converged
        assert b.chi2 == pytest.approx(a.chi2, rel=1e-9, abs=1e-12)
        p, q = a.camera_from_beacon, b.camera_from_beacon
        turn = np.abs(p.R @ q.R.T - np.eye(3)).max()
        shift = np.abs(p.t_m - q.t_m).max()
        gaps.append(max(turn, shift))
        whitened.append(max(turn / deviation[i, :3].max(), shift / deviation[i, 3:].max()))
    # 1e-9 rad and m; where noise itself leaves some 10 mrad open, rounding may leave a millionth of that.
    assert np.percentile(gaps, 99.0) < 1e-9
    assert max(whitened) < 1e-6
