"""With a prior: look for the LEDs only where the last pose puts them, and leave every doubt to the whole picture.

Its answer is the answer of the whole picture: the same blobs, centroids, solver and tests; only the search is shorter.
It knows nothing but the prior, so the same picture with the same prior gives the same answer, live or offline.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from uvgs_bench.geometry import Pose
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.fit import DISC_DOUBT, Fit, FitTables
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.sensor.selection import largest_area_px2
from uvgs_bench.sensor.tracking_kernels import FOUND, solve_tracked
from uvgs_bench.units import rad_from_deg, s_from_ns

# A beacon is not followed across a longer gap: what happened in it cannot be predicted.
_LONGEST_GAP_S = 0.5


def is_trackable(capture: Capture, prior: PoseEstimate, beacon: str, config: UvgsConfig) -> bool:
    """Whether a prior may be followed into a capture: mono, of this beacon, fresh, sure, and not followed too long.

    Args:
        capture: The picture.
        prior: The last pose.
        beacon: Name of the beacon.
        config: Limits.

    Returns:
        Whether to try.
    """
    gap_ns = capture.t_ns - prior.t_ns
    return (
        config.track
        and capture.image.ndim == 2
        and config.detection == "fast"
        and config.centroid == "weighted"
        and config.solver == "uvgs_lm"
        and prior.beacon == beacon
        and 0 <= gap_ns <= _LONGEST_GAP_S * 1e9
        and prior.margin >= config.min_margin
        and not prior.flags
        and prior.tracked_count + 1 < config.track_captures
    )


def follow(capture: Capture, prior: PoseEstimate, tables: FitTables) -> Fit | None:
    """Find every LED in its window, fit and judge.

    The windows grow with the covariance of the prior, and with how far the beacon can have moved since.

    Args:
        capture: The picture, mono.
        prior: The last pose.
        tables: Camera, beacon and parameters.

    Returns:
        A believed fit, or None when the whole picture has to be searched.
    """
    image = capture.image
    full_scale = 255.0 if capture.full_scale_dn is None else capture.full_scale_dn
    if image.dtype != np.uint8:
        # Of a deeper picture the brightest pixel tells the number of bits, and finding it takes the whole picture.
        return None
    image = image if image.flags.c_contiguous else image.copy()
    lens, leds, config = tables.lens, tables.leds, tables.config
    n = len(leds.positions_m)
    gap_s = s_from_ns(capture.t_ns - prior.t_ns)
    last = prior.camera_from_beacon
    R, t = last.R.copy(), last.t_m.copy()
    led_px, residual = np.empty((n, 2)), np.empty((n, 2))
    noise, by_beacon, by_calibration = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    # Limits count as three deviations.
    turn_rad = rad_from_deg(config.max_turn_deg_s) * gap_s / 3.0
    shift_m = config.max_speed_mps * gap_s / 3.0
    # Nearer than this no LED can have come; a blob larger than one can be from there is none.
    near_m = float(np.linalg.norm(t)) - tables.reach_m - 3.0 * shift_m - 3.0 * sqrt(prior.covariance[5, 5])
    largest = largest_area_px2(tables.beacon, lens.fx_px, max(near_m, config.min_range_m), config)
    status, seen, rms_px = solve_tracked(
        image, lens.model_id, lens.kernel_parameters, leds.positions_m, leds.axes, tables.radii_m, leds.cos_limit,
        tables.beacon_m2, tables.calibration, tables.limits, R, t, prior.covariance.copy(), turn_rad, shift_m,
        config.window_px // 2, config.threshold_k, config.threshold_floor, config.min_area_px2, largest,
        config.min_circularity, config.gain_e_per_dn, full_scale, config.max_iterations, DISC_DOUBT,
        led_px, residual, noise, by_beacon, by_calibration,
    )  # fmt: skip
    if status != FOUND:
        return None
    pose = Pose(R, t, "camera", "beacon")
    return Fit(seen, pose, led_px, residual, rms_px, noise, by_beacon, by_calibration, None)
