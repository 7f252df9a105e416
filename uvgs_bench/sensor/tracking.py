"""With a prior: look for the LEDs only where the last pose puts them, and leave every doubt to the whole picture.

Its answer is the answer of the whole picture: the same blobs, centroids, solver and tests; only the search is shorter.
It knows nothing but the prior, so the same picture with the same prior gives the same answer, live or offline.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.correspondence import LedTable
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.sensor.tracking_kernels import FOUND, find_leds
from uvgs_bench.units import rad_from_deg, s_from_ns

# A beacon is not followed across a longer gap: what happened in it cannot be predicted.
_LONGEST_GAP_S = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class TrackedLeds:
    """Where the LEDs were found.

    Args:
        seen: Indices of the LEDs, shape (k,).
        centroid_px: Centroids, shape (k, 2), raw px.
        sigma_px: Their deviations, shape (k,), px.
    """

    seen: NDArray[np.intp]
    centroid_px: FloatArray
    sigma_px: FloatArray


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
        and prior.beacon == beacon
        and 0 <= gap_ns <= _LONGEST_GAP_S * 1e9
        and prior.margin >= config.min_margin
        and not prior.flags
        and prior.tracked_count + 1 < config.track_captures
    )


def find_tracked_leds(
    capture: Capture, prior: PoseEstimate, lens: Lens, leds: LedTable, radii_m: FloatArray, config: UvgsConfig
) -> TrackedLeds | None:
    """Find every LED in its window.

    The windows grow with the covariance of the prior, and with how far the beacon can have moved since.

    Args:
        capture: The picture, mono.
        prior: The last pose.
        lens: The lens.
        leds: The tabulated beacon.
        radii_m: Radius of each LED, shape (n,), m; 0 where unknown.
        config: Parameters.

    Returns:
        The LEDs, or None when the whole picture has to be searched.
    """
    image = capture.image
    full_scale = 255.0
    if image.dtype != np.uint8:
        # Of a deeper picture the brightest pixel tells the number of bits, and finding it takes the whole picture.
        return None
    image = image if image.flags.c_contiguous else image.copy()
    n = len(leds.positions_m)
    gap_s = s_from_ns(capture.t_ns - prior.t_ns)
    centroid, sigma, seen = np.empty((n, 2)), np.empty(n), np.empty(n, dtype=np.int64)
    pose = prior.camera_from_beacon
    # Limits count as three deviations.
    turn_rad = rad_from_deg(config.max_turn_deg_s) * gap_s / 3.0
    shift_m = config.max_speed_mps * gap_s / 3.0
    status, count = find_leds(
        image, lens.model_id, lens.kernel_parameters, leds.positions_m, leds.axes, radii_m, leds.cos_limit,
        pose.R.copy(), pose.t_m.copy(), prior.covariance.copy(), turn_rad, shift_m,
        config.window_px // 2, config.threshold_k, config.threshold_floor, config.min_area_px2, config.max_area_px2,
        config.min_circularity, config.gain_e_per_dn, full_scale, centroid, sigma, seen,
    )  # fmt: skip
    if status != FOUND:
        return None
    return TrackedLeds(seen[:count], centroid[:count], sigma[:count])
