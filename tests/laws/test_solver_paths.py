"""Two paths, one minimum: Levenberg-Marquardt and dogleg."""

from __future__ import annotations

import numpy as np

from tests.helpers import spots
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.sensor.solution import solver


def test_dogleg_finds_the_minimum_of_levenberg_marquardt_from_poor_starts():
    rng = np.random.default_rng(21)
    lens, points = spots.lens(), spots.beacon().positions_m.copy()
    lm, dogleg = solver("uvgs_lm"), solver("uvgs_dogleg")
    gaps, steps = [], []
    for _ in range(200):
        pose = spots.random_pose(rng)
        px = lens.project(pose.apply(points)) + rng.normal(0.0, 0.2, (4, 2))
        start = Pose(so3_exp(rng.normal(size=3) * 0.15) @ pose.R, pose.t_m * rng.uniform(0.8, 1.25), "camera", "beacon")
        a, b = (solve(lens, points, px, np.full(4, 0.2), start, 100) for solve in (lm, dogleg))
        assert a.converged
        assert b.converged
        if abs(a.chi2 - b.chi2) > 1e-6 * (1.0 + a.chi2):
            gaps.append(np.inf)  # a start between two minima may fall to either
            continue
        gaps.append(np.abs((a.camera_from_beacon @ b.camera_from_beacon.inverse()).log()).max())
        steps.append(b.iterations)
    # 1e-8 rad and m: both stop within 1e-11 of the minimum, magnified where noise leaves a pose nearly open.
    assert np.mean(np.array(gaps) < 1e-8) > 0.97
    assert np.median(steps) <= 8
