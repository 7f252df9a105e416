"""The sensor: one capture in, one pose or one reason out. The stages in order, each timed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.sensor.blobs import NoBlobs, find_blobs
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.correspondence import LedTable, NoMatch
from uvgs_bench.sensor.doubt_kernels import disc_shift, fit_leds, pose_covariances
from uvgs_bench.sensor.looks import looks_of
from uvgs_bench.sensor.outcome import Miss, Outcome, PoseEstimate
from uvgs_bench.sensor.selection import NEEDED, select_blobs
from uvgs_bench.sensor.solution import Solution, solver
from uvgs_bench.sensor.three_leds import fuse, match_with_prior
from uvgs_bench.sensor.tracking import find_tracked_leds, is_trackable
from uvgs_bench.sensor.validation import Refusal, check_solution

Indices = NDArray[np.intp]
_NONE = np.empty((0, 0))
# Per axis, of the correction for the perspective of a disc: how an LED's light falls off to the side is not known.
_DISC_DOUBT = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A solution with what it was fitted to: LEDs, their centres freed of perspective, deviations."""

    seen: Indices
    points_m: FloatArray
    centroid_px: FloatArray
    sigma_px: FloatArray
    solution: Solution


def _no_clock() -> float:
    return 0.0


class Uvgs:
    """A uVGS-2 sensor for one camera and one beacon.

    It remembers nothing between captures; what it may know about the last one is the argument ``prior``.

    Args:
        calibration: The camera.
        beacon: The beacon.
        config: Parameters.
        clock: Seconds from a monotonic clock, for stage times; without it they are 0.

    Raises:
        ConfigError: The solver is unknown.
    """

    def __init__(
        self,
        calibration: Calibration,
        beacon: Beacon,
        config: UvgsConfig | None = None,
        clock: Callable[[], float] | None = None,
    ) -> None:
        self.calibration = calibration
        self.beacon = beacon
        self.config = UvgsConfig() if config is None else config
        self._clock = _no_clock if clock is None else clock
        self._lens = calibration.lens
        self._leds = LedTable.of(beacon, self.config)
        self._radii_m = np.array(
            [0.0 if led.axis is None or led.diameter_m is None else 0.5 * led.diameter_m for led in beacon.leds]
        )
        self._solve = solver(self.config.solver)

    def solve(self, capture: Capture, prior: PoseEstimate | None = None) -> Outcome:
        """Estimate camera_from_beacon from one capture.

        Args:
            capture: The picture with its instant.
            prior: The last pose, or None. The LEDs are then looked for where it puts them, and in the whole picture
                when that leaves any doubt. It may also decide between two poses that fit alike.

        Returns:
            The pose with its doubt, or a ``Miss`` with stage and reason.

        Raises:
            CalibrationError: The picture has another size than the calibration.
        """
        lens = self._lens
        self.calibration.check_size(capture.width_px, capture.height_px, capture.source or "the picture")
        stage_s: dict[str, float] = {}
        start = self._clock()

        def lap(stage: str) -> None:
            nonlocal start
            now = self._clock()
            stage_s[stage] = now - start
            start = now

        def miss(stage: str, reason: str, detail: str, blob_count: int) -> Miss:
            return Miss(stage, reason, detail, capture.t_ns, self.beacon.name, blob_count, stage_s)

        if prior is not None and is_trackable(capture, prior, self.beacon.name, self.config):
            tracked = find_tracked_leds(capture, prior, lens, self._leds, self._radii_m, self.config)
            lap("track")
            if tracked is not None:
                fit = self._fit(tracked.seen, tracked.centroid_px, tracked.sigma_px, prior.camera_from_beacon)
                lap("solve")
                if self._refusal(fit) is None:
                    margin, count = prior.margin, prior.tracked_count + 1
                    estimate = self._estimate(capture, fit, margin, prior.runner_up, len(fit.seen), count, stage_s)
                    lap("validate")
                    return estimate
                lap("validate")
        blobs = find_blobs(capture, self.config)
        lap("blobs")
        if isinstance(blobs, NoBlobs):
            return miss(blobs.stage, blobs.reason, blobs.detail, 0)
        needed = NEEDED if prior is None else NEEDED - 1
        chosen = select_blobs(blobs, self.beacon, lens.fx_px, self.config, needed)
        lap("selection")
        if isinstance(chosen, NoBlobs):
            return miss(chosen.stage, chosen.reason, chosen.detail, len(blobs))
        judged = np.hypot(chosen.sigma_px, self.config.model_error_px)
        looks = looks_of(capture.image, chosen)
        match = match_with_prior(chosen.centroid_px, judged, lens, self._leds, self.config, prior, looks)
        lap("correspondence")
        if isinstance(match, NoMatch):
            return miss("correspondence", match.reason, match.detail, len(chosen))
        seen = np.flatnonzero(match.blob_of_led >= 0)
        picked = match.blob_of_led[seen]
        fit = self._fit(
            seen, chosen.centroid_px[picked], chosen.sigma_px[picked], match.start, prior if match.needs_prior else None
        )
        lap("solve")
        refusal = self._refusal(fit)
        if refusal is None:
            estimate = self._estimate(capture, fit, match.margin, match.runner_up, len(chosen), 0, stage_s, match.flags)
            lap("validate")
            return estimate
        lap("validate")
        stage = "solve" if refusal.reason == "not_converged" else "validate"
        return miss(stage, refusal.reason, refusal.detail, len(chosen))

    def warm_up(self) -> None:
        """Compile (or load) every kernel now, so that no live picture waits for it.

        Solves drawn pictures of every kind (8 bit, 16 bit, colour), with and without a prior.
        """
        lens = self._lens
        distance = 12.0 * self._leds.longest_m
        points = self._leds.positions_m - self._leds.positions_m.mean(axis=0) + np.array([0.0, 0.0, distance])
        image = np.full((lens.height_px, lens.width_px), 10, dtype=np.uint8)
        for u, v in lens.project(points):
            if np.isfinite(u) and lens.contains(np.array([[u, v]]), 3.0)[0]:
                y, x = round(v), round(u)
                image[y - 1 : y + 2, x - 1 : x + 2] = 120
                image[y, x] = 200
        self.solve(Capture(image, 0))
        self.solve(Capture(image.astype(np.uint16) * 16, 0))
        self.solve(Capture(np.repeat(image[:, :, None], 3, axis=2), 0))
        nearby = Pose(np.eye(3), points.mean(axis=0) - self._leds.positions_m.mean(axis=0), "camera", "beacon")
        nothing = np.zeros((len(self.beacon.leds), 2))
        seen = np.arange(len(self.beacon.leds))
        prior = PoseEstimate(nearby, np.eye(6) * 1e-8, 0, self.beacon.name, nothing, nothing, 0.0, np.inf, len(seen))
        self.solve(Capture(image, 0), prior)
        fit = self._fit(seen, lens.project(nearby.apply(self._leds.positions_m)), np.ones(len(seen)), nearby)
        self._estimate(Capture(image, 0), fit, np.inf, None, len(seen), 0, {})

    def _fit(
        self,
        seen: Indices,
        centroid_px: FloatArray,
        sigma_px: FloatArray,
        start: Pose,
        prior: PoseEstimate | None = None,
    ) -> _Fit:
        """Solve, free the centroids of the perspective of the LEDs' discs as seen from that pose, and solve again.

        With a prior both solutions are fused with it.
        """
        lens, steps = self._lens, self.config.max_iterations
        points, axes, radii = self._leds.positions_m[seen], self._leds.axes[seen], self._radii_m[seen]
        px, sigma = centroid_px.copy(), sigma_px.copy()
        if self.config.solver == "uvgs_lm" and prior is None:
            R, t, H, residual = start.R.copy(), start.t_m.copy(), np.empty((6, 6)), np.full((len(seen), 2), np.nan)
            chi2, taken, converged = fit_leds(
                lens.model_id, lens.kernel_parameters, points, axes, radii, px, sigma, R, t, steps, _DISC_DOUBT, H,
                residual,
            )  # fmt: skip
            pose = Pose(R, t, "camera", "beacon")
            return _Fit(seen, points, px, sigma, Solution(pose, H, residual, chi2, taken, converged))

        def solved(near: Pose) -> Solution:
            if prior is not None:
                return fuse(lens, points, px, sigma, near, prior)
            return self._solve(lens, points, px, sigma, near, steps)

        solution = solved(start)
        if solution.converged and radii.any():
            shift = np.empty((len(points), 2))
            pose = solution.camera_from_beacon
            R, t = pose.R.copy(), pose.t_m.copy()
            disc_shift(lens.model_id, lens.kernel_parameters, points, axes, radii, R, t, shift)
            px -= shift
            sigma[:] = np.sqrt(sigma**2 + _DISC_DOUBT**2 * (shift * shift).sum(axis=1))
            solution = solved(pose)
        return _Fit(seen, points, px, sigma, solution)

    def _refusal(self, fit: _Fit) -> Refusal | None:
        return check_solution(
            fit.solution, fit.points_m, fit.sigma_px, self._leds, fit.seen, self._lens, self.beacon, self.config
        )

    def _estimate(
        self,
        capture: Capture,
        fit: _Fit,
        margin: float,
        runner_up: Pose | None,
        blob_count: int,
        tracked_count: int,
        stage_s: dict[str, float],
        flags: tuple[str, ...] = (),
    ) -> PoseEstimate:
        n = len(self.beacon.leds)
        led_px = np.full((n, 2), np.nan)
        residual = np.full((n, 2), np.nan)
        led_px[fit.seen] = fit.centroid_px
        residual[fit.seen] = fit.solution.residual_px
        pose = fit.solution.camera_from_beacon
        beacon_m2 = self.beacon.covariance_m2
        if beacon_m2 is None:
            rows_m2 = _NONE
        else:
            rows = (3 * fit.seen[:, None] + np.arange(3)).ravel()
            rows_m2 = np.ascontiguousarray(beacon_m2[np.ix_(rows, rows)])
        lens_covariance = _NONE if self.calibration.covariance is None else self.calibration.covariance.copy()
        noise, by_beacon, by_lens = np.empty((3, 6, 6))
        pose_covariances(
            self._lens.model_id, self._lens.kernel_parameters, fit.points_m, fit.sigma_px, pose.R.copy(),
            pose.t_m.copy(), fit.solution.information, rows_m2, lens_covariance, noise, by_beacon, by_lens,
        )  # fmt: skip
        for values in (led_px, residual, noise, by_beacon, by_lens):
            values.flags.writeable = False
        return PoseEstimate(
            pose,
            noise if beacon_m2 is None else read_only(noise + by_beacon),
            capture.t_ns,
            self.beacon.name,
            led_px,
            residual,
            sqrt(float((fit.solution.residual_px**2).mean())),
            margin,
            blob_count,
            runner_up,
            stage_s,
            flags,
            None if beacon_m2 is None else by_beacon,
            None if self.calibration.covariance is None else by_lens,
            tracked_count,
        )
