"""The sensor: one capture in, one pose or one reason out. The stages in order, each timed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.sensor.blobs import Blobs, NoBlobs, find_blobs
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.correspondence import LedMatch, NoMatch
from uvgs_bench.sensor.drawn_view import draw_view, facing_pose
from uvgs_bench.sensor.fit import Fit, FitTables, estimate_of, fit_named
from uvgs_bench.sensor.looks import looks_of
from uvgs_bench.sensor.merging import find_overlaps
from uvgs_bench.sensor.outcome import Miss, Outcome, PoseEstimate
from uvgs_bench.sensor.selection import NEEDED, select_blobs
from uvgs_bench.sensor.solution import solver
from uvgs_bench.sensor.three_leds import match_with_prior
from uvgs_bench.sensor.tracking import follow, is_trackable
from uvgs_bench.sensor.validation import refusal_of_overlap


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
        self._tables = FitTables.of(calibration, beacon, self.config)
        solver(self.config.solver)

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
            followed = follow(capture, prior, self._tables)
            lap("track")
            if followed is not None:
                margin, count = prior.margin, prior.tracked_count + 1
                estimate = estimate_of(
                    followed, self._tables, capture.t_ns, margin, prior.runner_up, followed.seen, count, stage_s
                )
                lap("validate")
                return estimate
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
        match = match_with_prior(chosen.centroid_px, judged, lens, self._tables.leds, self.config, prior, looks)
        lap("correspondence")
        if isinstance(match, NoMatch):
            return miss("correspondence", match.reason, match.detail, len(chosen))
        fit = self._fit(chosen, match, prior)
        lap("solve")
        refusal = fit.refusal
        if refusal is None:
            estimate = estimate_of(
                fit, self._tables, capture.t_ns, match.margin, match.runner_up, len(chosen), 0, stage_s, match.flags
            )
            lap("validate")
            return estimate
        lap("validate")
        stage = "solve" if refusal.reason == "not_converged" else "validate"
        return replace(miss(stage, refusal.reason, refusal.detail, len(chosen)), led_px=fit.led_px)

    def _fit(self, chosen: Blobs, match: LedMatch, prior: PoseEstimate | None) -> Fit:
        """Fit the named LEDs without those an unseen one may shine into; refused when too few are left."""
        tables = self._tables
        seen = np.flatnonzero(match.blob_of_led >= 0)
        start = match.start
        while True:
            picked = match.blob_of_led[seen]
            fit = fit_named(
                tables,
                seen,
                chosen.centroid_px[picked],
                chosen.sigma_px[picked],
                start,
                prior if match.needs_prior else None,
            )
            if fit.refusal is not None:
                return fit
            start = fit.camera_from_beacon
            overlaps = find_overlaps(start, fit.noise, self._lens, tables.leds, seen, chosen.width_px[picked])
            if not overlaps:
                return fit
            clear = np.setdiff1d(seen, [overlap.seen for overlap in overlaps])
            if len(clear) < NEEDED:
                return replace(fit, refusal=refusal_of_overlap(overlaps[0], len(clear), self.beacon))
            seen = clear

    def warm_up(self, colour: bool = False) -> None:
        """Compile (or load) every kernel now, so that no live picture waits for it.

        Solves drawn pictures of 8 and 16 bit, with and without a prior, and with three LEDs left.

        Args:
            colour: Whether the camera gives colour; of a beacon with a hue this is taken for granted.
        """
        lens, leds = self._lens, self._tables.leds
        pose = facing_pose(leds)
        places_px = lens.project(pose.apply(leds.positions_m))
        image, seen = draw_view(lens, places_px), np.arange(len(leds.positions_m))
        prior = PoseEstimate(
            pose, np.eye(6) * 1e-8, 0, self.beacon.name, places_px, np.zeros_like(places_px), 0.0, np.inf, len(seen)
        )
        self.solve(Capture(image, 0))
        self.solve(Capture(image.astype(np.uint16) * 16, 0))
        if colour or self.beacon.hue != "any" or self.config.hue_deg is not None:
            self.solve(Capture(np.repeat(image[:, :, None], 3, axis=2), 0))
        self.solve(Capture(image, 0), prior)
        self.solve(Capture(draw_view(lens, places_px, hidden=len(seen) - 3), 0), prior)
        # Whatever became of the drawn pictures, both ways to a pose have then been gone.
        for count, fused in ((len(seen), None), (3, prior)):
            fit_named(self._tables, seen[:count], places_px[:count], np.ones(count), pose, fused)
