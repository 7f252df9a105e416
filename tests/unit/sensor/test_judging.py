"""The compiled tests of a pose against the same tests written with numpy, and their words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.geometry import Pose
from uvgs_bench.sensor import UvgsConfig
from uvgs_bench.sensor import judging_kernels as jk
from uvgs_bench.sensor.fit import FitTables
from uvgs_bench.sensor.solution import Solution
from uvgs_bench.sensor.validation import refusal_of

LENS, SIGMA_PX = spots.lens(), np.array([0.05, 0.1, 0.02, 0.07])
SPREAD_M2 = np.diag(np.repeat([1e-8, 4e-8, 2e-8, 1e-8], 3))


def plainly(pose: Pose, solution: Solution, tables: FitTables) -> tuple[int, float, float]:
    """What the kernel must say, test by test."""
    config, leds, beacon = tables.config, tables.leds, tables.beacon
    if not solution.converged:
        return jk.NOT_CONVERGED, 0.0, 0.0
    p = pose.apply(leds.positions_m)
    if p[:, 2].min() <= 0.0:
        return jk.BEHIND_CAMERA, p[:, 2].min(), 0.0
    cosine = -((leds.axes @ pose.R.T) * p).sum(axis=1) / np.linalg.norm(p, axis=1)
    if (cosine < leds.cos_limit).any():
        return jk.NOT_FACING, float(np.flatnonzero(cosine < leds.cos_limit)[0]), 0.0
    range_m = float(np.linalg.norm(pose.t_m))
    if not config.min_range_m <= range_m <= config.max_range_m:
        return jk.OUT_OF_RANGE, range_m, 0.0
    variance = SIGMA_PX**2 + config.model_error_px**2
    if beacon.covariance_m2 is not None:
        spread_m2 = np.diag(beacon.covariance_m2).reshape(-1, 3).mean(axis=1)
        variance = variance + spread_m2 * (LENS.fx_px / np.linalg.norm(p, axis=1)) ** 2
    chi2 = float((solution.residual_px**2 / variance[:, None]).sum())
    rms_px = float(np.sqrt((solution.residual_px**2).mean()))
    if rms_px > config.max_rms_px:
        return jk.RMS_TOO_LARGE, rms_px, 0.0
    if chi2 > config.max_chi2_per_dof * 2:
        return jk.CHI2_TOO_LARGE, chi2, rms_px
    return jk.BELIEVED, 0.0, 0.0


def judged(pose: Pose, solution: Solution, tables: FitTables) -> tuple[tuple[int, float, float], np.ndarray]:
    noise, by_beacon, by_lens = np.empty((3, 6, 6))
    leds = tables.leds
    verdict = jk.judge_fit(
        LENS.model_id, LENS.kernel_parameters, leds.positions_m, leds.axes, leds.cos_limit, tables.beacon_m2,
        tables.calibration, tables.limits, SIGMA_PX, pose.R.copy(), pose.t_m.copy(), solution.information,
        solution.residual_px, solution.converged, noise, by_beacon, by_lens,
    )  # fmt: skip
    return verdict, noise


def views(count: int) -> list[tuple[Pose, Solution]]:
    """Poses all around the camera, with residuals of about what is allowed."""
    rng = np.random.default_rng(5)
    out = []
    while len(out) < count:
        pose = spots.random_pose(rng, cone_deg=85.0, near_m=0.3, far_m=2.0)
        true = LENS.project(pose.apply(spots.beacon().positions_m))
        if np.isfinite(true).all():
            px = true + rng.normal(0.0, rng.choice([0.01, 0.3, 1.5]), true.shape)
            out.append((pose, Solution.at(LENS, spots.beacon().positions_m, px, SIGMA_PX, pose, 5, rng.random() < 0.9)))
    return out


@pytest.mark.parametrize("covariance_m2", [None, SPREAD_M2])
def test_the_kernel_judges_as_the_plain_formulas_do(covariance_m2):
    config = UvgsConfig(min_range_m=0.4, max_range_m=1.8, max_rms_px=1.5, emission_slack_deg=0.0)
    tables = FitTables.of(spots.calibration(), spots.beacon(covariance_m2), config)
    seen = set()
    for pose, solution in views(400):
        want, (got, noise) = plainly(pose, solution, tables), judged(pose, solution, tables)
        assert got[0] == want[0]
        # Sums of a dozen numbers: rounding.
        np.testing.assert_allclose(got[1:], want[1:], rtol=1e-12)
        H = solution.information
        # The inverse keeps what the condition leaves of 1e-16.
        inverse = np.linalg.inv(H)
        scale = np.sqrt(np.outer(np.diag(inverse), np.diag(inverse)))
        assert (np.abs(noise - inverse) < 1e-7 * scale).all()
        seen.add(got[0])
    kinds = {jk.BELIEVED, jk.NOT_CONVERGED, jk.NOT_FACING, jk.OUT_OF_RANGE, jk.RMS_TOO_LARGE, jk.CHI2_TOO_LARGE}
    assert seen == kinds


def test_what_does_not_determine_a_pose_is_degenerate_and_what_does_is_not():
    config = UvgsConfig(emission_slack_deg=180.0)
    tables = FitTables.of(spots.calibration(), spots.beacon(), config)
    pose, solution = next((p, s) for p, s in views(50) if judged(p, s, tables)[0][0] == jk.BELIEVED)
    values, vectors = np.linalg.eigh(solution.information / np.outer(*[np.sqrt(np.diag(solution.information))] * 2))
    for least, verdict in ((1e-6, jk.BELIEVED), (1e-15, jk.DEGENERATE)):
        flat = (vectors * np.r_[least, values[1:]]) @ vectors.T
        weak = replace(solution, information=np.ascontiguousarray(flat))
        assert judged(pose, weak, tables)[0][0] == verdict


def test_behind_the_camera_and_every_refusal_in_words():
    config = UvgsConfig()
    tables = FitTables.of(spots.calibration(), spots.beacon(), config)
    pose, solution = views(1)[0]
    behind = Pose(pose.R, -pose.t_m, "camera", "beacon")
    (verdict, depth_m, _), _ = judged(behind, replace(solution, converged=True), tables)
    assert verdict == jk.BEHIND_CAMERA
    assert depth_m == pytest.approx(behind.apply(tables.leds.positions_m)[:, 2].min(), rel=1e-12)
    seen = np.arange(4)
    words = {
        jk.NOT_CONVERGED: ("not_converged", "no minimum after 7 steps of uvgs_lm"),
        jk.BEHIND_CAMERA: ("behind_camera", "an LED would lie 1.000 m behind the camera"),
        jk.NOT_FACING: ("not_facing", "LED led1 would shine away from the camera"),
        jk.OUT_OF_RANGE: ("out_of_range", "1.000 m is outside 0.100 to 20.000 m"),
        jk.RMS_TOO_LARGE: ("residual_too_large", "residual 1.00 px rms, at most 2.00 px"),
        jk.CHI2_TOO_LARGE: (
            "residual_too_large", "chi-square 1.0 for 2 degrees of freedom (0.25 px rms), at most 14.0",
        ),
        jk.DEGENERATE: ("degenerate", "the LEDs seen do not determine the pose"),
    }  # fmt: skip
    for verdict, (reason, detail) in words.items():
        one = -1.0 if verdict == jk.BEHIND_CAMERA else 1.0
        refusal = refusal_of(verdict, one, 0.25, 7, seen, tables.beacon, config)
        assert refusal is not None
        assert (refusal.reason, refusal.detail) == (reason, detail)
    assert refusal_of(jk.BELIEVED, 0.0, 0.0, 7, seen, tables.beacon, config) is None
