from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import Pose
from uvgs_bench.sensor.solution import solver
from uvgs_bench.sensor.solvers.lambda_twist import solve_p3p


def test_an_unknown_solver_names_the_known_ones():
    with pytest.raises(ConfigError, match="uvgs_lm"):
        solver("newton")


def test_lm_says_when_a_start_cannot_be_projected():
    points = spots.beacon().positions_m.copy()
    behind = Pose(np.eye(3), np.array([0.0, 0.0, -1.0]), "camera", "beacon")
    solution = solver("uvgs_lm")(spots.lens(), points, np.zeros((4, 2)), np.ones(4), behind, 20)
    assert not solution.converged
    assert solution.chi2 == np.inf


def test_p3p_finds_every_pose_that_puts_points_on_rays():
    rng = np.random.default_rng(3)
    Rs, ts = np.empty((4, 3, 3)), np.empty((4, 3))
    for _ in range(2000):
        pose = spots.random_pose(rng, cone_deg=170.0)
        points = rng.uniform(-0.08, 0.08, (3, 3))
        p = pose.apply(points)
        rays = p / np.linalg.norm(p, axis=1)[:, None]
        count = solve_p3p(rays, points, Rs, ts)
        errors = [np.abs(Rs[i] - pose.R).max() + np.abs(ts[i] - pose.t_m).max() for i in range(count)]
        # Nearly collinear triples lose digits; a wrong root would be off by 0.1 or more.
        assert min(errors) < 1e-5
        for i in range(count):
            seen = points @ Rs[i].T + ts[i]
            np.testing.assert_allclose(seen / np.linalg.norm(seen, axis=1)[:, None], rays, atol=1e-6)


def test_p3p_of_collinear_points_gives_nothing():
    points = np.array([[0.0, 0, 0], [0.05, 0, 0], [0.1, 0, 0]])
    rays = points + np.array([0.0, 0.1, 1.0])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    assert solve_p3p(rays, points, np.empty((4, 3, 3)), np.empty((4, 3))) == 0
