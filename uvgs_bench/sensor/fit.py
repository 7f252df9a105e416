"""Stages 5 and 6: named centroids to a pose with its doubt, judged; by the compiled solver or by any of the table."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.doubt_kernels import disc_shift
from uvgs_bench.sensor.judging_kernels import fit_and_judge, gather_leds, judge_fit
from uvgs_bench.sensor.led_table import LedTable
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.sensor.solution import Solution, solver
from uvgs_bench.sensor.three_leds import fuse
from uvgs_bench.sensor.validation import Refusal, limits_of, refusal_of

# Per axis, of the correction for the perspective of a disc: how an LED's light falls off to the side is not known.
DISC_DOUBT = 0.25
_COMPILED = "uvgs_lm"


@dataclass(frozen=True, slots=True, eq=False)
class FitTables:
    """What every fit of one camera and one beacon needs, as the kernels want it; made once.

    Args:
        lens: The lens.
        beacon: The beacon.
        config: Parameters.
        leds: The tabulated beacon.
        radii_m: Radius of each LED, shape (n,), m; 0 where unknown.
        reach_m: Distance of the farthest LED from the beacon's origin, m.
        beacon_m2: Covariance of the LEDs, shape (3n, 3n), m^2; (0, 0) when the beacon states none.
        calibration: Covariance of the lens parameters, shape (P, P); (0, 0) when the calibration states none.
        limits: What solutions are judged by.
    """

    lens: Lens
    beacon: Beacon
    config: UvgsConfig
    leds: LedTable
    radii_m: FloatArray
    reach_m: float
    beacon_m2: FloatArray
    calibration: FloatArray
    limits: FloatArray

    @classmethod
    def of(cls, calibration: Calibration, beacon: Beacon, config: UvgsConfig) -> FitTables:
        """Tabulate a camera and a beacon."""
        radii_m = [0.0 if led.axis is None or led.diameter_m is None else 0.5 * led.diameter_m for led in beacon.leds]
        none = np.empty((0, 0))
        return cls(
            calibration.lens,
            beacon,
            config,
            LedTable.of(beacon, config),
            np.array(radii_m),
            float(np.linalg.norm(beacon.positions_m, axis=1).max()),
            none if beacon.covariance_m2 is None else beacon.covariance_m2.copy(),
            none if calibration.covariance is None else calibration.covariance.copy(),
            limits_of(calibration.lens, config),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A solution of named LEDs, with its doubt and what the tests say.

    Args:
        seen: Number of LEDs it rests on.
        camera_from_beacon: The pose.
        led_px: Centres freed of the perspective of the discs, in the order of the LEDs, NaN if unseen, shape
            (n, 2), px.
        residual_px: Observed minus projected, likewise.
        rms_px: Root mean square of the residual components, px.
        noise: Covariance from centroid noise, shape (6, 6).
        by_beacon: Covariance from the LED positions, shape (6, 6); 0 when they are not doubted.
        by_calibration: Covariance from the lens, shape (6, 6); 0 when it is not doubted.
        refusal: Why it is not believed, or None.
    """

    seen: int
    camera_from_beacon: Pose
    led_px: FloatArray
    residual_px: FloatArray
    rms_px: float
    noise: FloatArray
    by_beacon: FloatArray
    by_calibration: FloatArray
    refusal: Refusal | None


def fit_named(
    tables: FitTables,
    seen: NDArray[np.int64],
    centroid_px: FloatArray,
    sigma_px: FloatArray,
    start: Pose,
    prior: PoseEstimate | None = None,
) -> Fit:
    """Solve, free the centroids of the perspective of the LEDs' discs as seen from that pose, solve again, and judge.

    Args:
        tables: Camera, beacon and parameters.
        seen: Indices of the LEDs, shape (k,).
        centroid_px: Their centroids, shape (k, 2), raw px.
        sigma_px: Their deviations, shape (k,), px.
        start: A pose near the optimum.
        prior: The last pose, to be fused with both solutions, or None.

    Returns:
        The fit, believed or not.
    """
    lens, leds, config = tables.lens, tables.leds, tables.config
    px, sigma = centroid_px.copy(), sigma_px.copy()
    noise, by_beacon, by_calibration = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    if config.solver == _COMPILED and prior is None:
        R, t = start.R.copy(), start.t_m.copy()
        led_px, residual = np.empty_like(leds.positions_m[:, :2]), np.empty_like(leds.positions_m[:, :2])
        verdict, steps, one, two, rms_px = fit_and_judge(
            lens.model_id, lens.kernel_parameters, leds.positions_m, leds.axes, tables.radii_m, leds.cos_limit,
            tables.beacon_m2, tables.calibration, tables.limits, seen, config.max_iterations, DISC_DOUBT, px, sigma,
            R, t, led_px, residual, noise, by_beacon, by_calibration,
        )  # fmt: skip
        pose = Pose(R, t, "camera", "beacon")
    else:
        solution = _solve(tables, seen, px, sigma, start, prior)
        pose, steps = solution.camera_from_beacon, solution.iterations
        points, axes, cones, spread = gather_leds(seen, leds.positions_m, leds.axes, leds.cos_limit, tables.beacon_m2)
        verdict, one, two = judge_fit(
            lens.model_id, lens.kernel_parameters, points, axes, cones, spread, tables.calibration, tables.limits,
            sigma, pose.R.copy(), pose.t_m.copy(), solution.information, solution.residual_px, solution.converged,
            noise, by_beacon, by_calibration,
        )  # fmt: skip
        led_px, residual = np.full((len(leds.positions_m), 2), np.nan), np.full((len(leds.positions_m), 2), np.nan)
        led_px[seen], residual[seen] = px, solution.residual_px
        rms_px = sqrt(float((solution.residual_px**2).mean()))
    refusal = refusal_of(verdict, one, two, steps, seen, tables.beacon, config)
    return Fit(len(seen), pose, led_px, residual, rms_px, noise, by_beacon, by_calibration, refusal)


def _solve(
    tables: FitTables,
    seen: NDArray[np.int64],
    px: FloatArray,
    sigma: FloatArray,
    start: Pose,
    prior: PoseEstimate | None,
) -> Solution:
    """Two solutions by a solver of the table or by fusion; px and sigma are changed as by ``fit_leds``."""
    lens, config = tables.lens, tables.config
    points, axes, radii = tables.leds.positions_m[seen], tables.leds.axes[seen], tables.radii_m[seen]
    solve = solver(config.solver)

    def solved(near: Pose) -> Solution:
        if prior is not None:
            return fuse(lens, points, px, sigma, near, prior)
        return solve(lens, points, px, sigma, near, config.max_iterations)

    solution = solved(start)
    if solution.converged and radii.any():
        shift = np.empty((len(points), 2))
        pose = solution.camera_from_beacon
        R, t = pose.R.copy(), pose.t_m.copy()
        disc_shift(lens.model_id, lens.kernel_parameters, points, axes, radii, R, t, shift)
        px -= shift
        sigma[:] = np.sqrt(sigma**2 + DISC_DOUBT**2 * (shift * shift).sum(axis=1))
        solution = solved(pose)
    return solution


def estimate_of(
    fit: Fit,
    tables: FitTables,
    t_ns: int,
    margin: float,
    runner_up: Pose | None,
    blob_count: int,
    tracked_count: int,
    stage_s: dict[str, float],
    flags: tuple[str, ...] = (),
) -> PoseEstimate:
    """A believed fit as it is published.

    Args:
        fit: The fit; its arrays become read-only.
        tables: Camera, beacon and parameters.
        t_ns: Instant of the capture, ns.
        margin: As in ``PoseEstimate``.
        runner_up: As in ``PoseEstimate``.
        blob_count: As in ``PoseEstimate``.
        tracked_count: As in ``PoseEstimate``.
        stage_s: As in ``PoseEstimate``.
        flags: As in ``PoseEstimate``.

    Returns:
        The estimate.
    """
    doubts_leds, doubts_lens = len(tables.beacon_m2) > 0, len(tables.calibration) > 0
    covariance = fit.noise + fit.by_beacon if doubts_leds else fit.noise
    for values in (fit.led_px, fit.residual_px, covariance, fit.by_beacon, fit.by_calibration):
        values.setflags(write=False)
    return PoseEstimate(
        fit.camera_from_beacon,
        covariance,
        t_ns,
        tables.beacon.name,
        fit.led_px,
        fit.residual_px,
        fit.rms_px,
        margin,
        blob_count,
        runner_up,
        stage_s,
        flags,
        fit.by_beacon if doubts_leds else None,
        fit.by_calibration if doubts_lens else None,
        tracked_count,
    )
