"""The sensor: one capture in, one pose or one reason out. The stages in order, each timed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.sensor.blobs import Blobs, NoBlobs, find_blobs
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.correspondence import LedMatch, LedTable, NoMatch
from uvgs_bench.sensor.looks import looks_of
from uvgs_bench.sensor.outcome import Miss, Outcome, PoseEstimate
from uvgs_bench.sensor.selection import NEEDED, select_blobs
from uvgs_bench.sensor.solution import Solution, solver
from uvgs_bench.sensor.three_leds import fuse, match_with_prior
from uvgs_bench.sensor.validation import check_solution


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
        self._solve = solver(self.config.solver)

    def solve(self, capture: Capture, prior: PoseEstimate | None = None) -> Outcome:
        """Estimate camera_from_beacon from one capture.

        Args:
            capture: The picture with its instant.
            prior: The last pose, or None. It may decide between two poses that fit alike.

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
        points, px, sigma = self._leds.positions_m[seen], chosen.centroid_px[picked], chosen.sigma_px[picked]
        if match.needs_prior and prior is not None:
            solution = fuse(lens, points, px, sigma, match.start, prior)
        else:
            solution = self._solve(lens, points, px, sigma, match.start, self.config.max_iterations)
        lap("solve")
        refusal = check_solution(solution, points, sigma, self._leds, seen, lens, self.beacon, self.config)
        if refusal is None:
            estimate = self._estimate(capture, chosen, match, solution, seen, stage_s)
            lap("validate")
            return estimate
        lap("validate")
        stage = "solve" if refusal.reason == "not_converged" else "validate"
        return miss(stage, refusal.reason, refusal.detail, len(chosen))

    def warm_up(self) -> None:
        """Compile (or load) every kernel now, so that no live picture waits for it: solves one drawn picture.

        Call it once for each type of picture expected to be mono 8 bit; 16 bit compiles at its first picture.
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

    def _estimate(
        self,
        capture: Capture,
        chosen: Blobs,
        match: LedMatch,
        solution: Solution,
        seen: np.ndarray[tuple[int], np.dtype[np.intp]],
        stage_s: dict[str, float],
    ) -> PoseEstimate:
        n = len(self.beacon.leds)
        led_px = np.full((n, 2), np.nan)
        residual = np.full((n, 2), np.nan)
        led_px[seen] = chosen.centroid_px[match.blob_of_led[seen]]
        residual[seen] = solution.residual_px
        covariance = np.asarray(np.linalg.inv(solution.information), dtype=np.float64)
        if self.beacon.covariance_m2 is not None:
            sigma = chosen.sigma_px[match.blob_of_led[seen]]
            covariance = covariance + self._beacon_part(solution, covariance, seen, sigma)
        return PoseEstimate(
            solution.camera_from_beacon,
            read_only(0.5 * (covariance + covariance.T), (6, 6)),
            capture.t_ns,
            self.beacon.name,
            read_only(led_px),
            read_only(residual),
            float(np.sqrt(np.mean(solution.residual_px**2))),
            match.margin,
            len(chosen),
            match.runner_up,
            stage_s,
            match.flags,
        )

    def _beacon_part(
        self,
        solution: Solution,
        noise_part: FloatArray,
        seen: np.ndarray[tuple[int], np.dtype[np.intp]],
        sigma_px: FloatArray,
    ) -> FloatArray:
        """Covariance from the doubt about the LED positions: the pose moves by -G d_px/d_P dP, G = H^-1 J^T W."""
        pose = solution.camera_from_beacon
        p = pose.apply(self._leds.positions_m[seen])
        _, by_point, _ = self._lens.project_with_jacobians(p)
        cross = np.zeros((len(p), 3, 3))
        cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = p[:, 2], -p[:, 1], p[:, 0]
        cross -= cross.transpose(0, 2, 1).copy()
        J = np.concatenate([by_point @ cross, by_point], axis=2)
        G = noise_part @ np.concatenate(list(J.transpose(0, 2, 1) / sigma_px[:, None, None] ** 2), axis=1)
        n = len(p)
        by_led = np.zeros((2 * n, 3 * n))
        for i in range(n):
            by_led[2 * i : 2 * i + 2, 3 * i : 3 * i + 3] = by_point[i] @ pose.R
        assert self.beacon.covariance_m2 is not None
        rows = (3 * seen[:, None] + np.arange(3)).ravel()
        S = self.beacon.covariance_m2[np.ix_(rows, rows)]
        moved = G @ by_led
        part: FloatArray = moved @ S @ moved.T
        return part
