"""Stage 6: whether a solved pose is believed: converged, in front, facing, and explaining its centroids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor import judging_kernels as jk
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.merging import Overlap


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a pose is not published.

    Args:
        reason: Stable word.
        detail: One line with the numbers.
    """

    reason: str
    detail: str


def limits_of(lens: Lens, config: UvgsConfig) -> FloatArray:
    """What ``judge_fit`` measures by.

    The fit is judged against centroid noise, what lens and beacon files may be wrong by (``model_error_px``), and the
    beacon's own covariance, so that a good fit to the wrong model is refused and a fair fit to a fair model is not.

    Args:
        lens: The lens.
        config: Limits.

    Returns:
        Shape (LIMIT_COUNT,).
    """
    limits = np.empty(jk.LIMIT_COUNT)
    limits[jk.FOCAL_PX] = lens.fx_px
    limits[jk.SEES_BEHIND] = lens.model == "equidistant"
    limits[jk.MIN_RANGE_M] = config.min_range_m
    limits[jk.MAX_RANGE_M] = config.max_range_m
    limits[jk.MODEL_ERROR_PX] = config.model_error_px
    limits[jk.MAX_RMS_PX] = config.max_rms_px
    limits[jk.MAX_CHI2_PER_DOF] = config.max_chi2_per_dof
    return limits


def refusal_of(
    verdict: int,
    one: float,
    two: float,
    iterations: int,
    seen: NDArray[np.int64],
    beacon: Beacon,
    config: UvgsConfig,
) -> Refusal | None:
    """A verdict in words.

    Args:
        verdict: What ``judge_fit`` says.
        one: Its first number.
        two: Its second number.
        iterations: Steps of the solver.
        seen: Indices of the LEDs used, shape (k,).
        beacon: The beacon.
        config: Limits.

    Returns:
        None when believed, else the first test it fails.
    """
    if verdict == jk.BELIEVED:
        return None
    if verdict == jk.NOT_CONVERGED:
        return Refusal("not_converged", f"no minimum after {iterations} steps of {config.solver}")
    if verdict == jk.BEHIND_CAMERA:
        return Refusal("behind_camera", f"an LED would lie {-one:.3f} m behind the camera")
    if verdict == jk.NOT_FACING:
        return Refusal("not_facing", f"LED {beacon.leds[int(seen[int(one)])].name} would shine away from the camera")
    if verdict == jk.OUT_OF_RANGE:
        return Refusal("out_of_range", f"{one:.3f} m is outside {config.min_range_m:.3f} to {config.max_range_m:.3f} m")
    if verdict == jk.RMS_TOO_LARGE:
        return Refusal("residual_too_large", f"residual {one:.2f} px rms, at most {config.max_rms_px:.2f} px")
    if verdict == jk.CHI2_TOO_LARGE:
        dof = 2 * len(seen) - 6
        return Refusal(
            "residual_too_large",
            f"chi-square {one:.1f} for {dof} degrees of freedom ({two:.2f} px rms), "
            f"at most {config.max_chi2_per_dof * dof:.1f}",
        )
    return Refusal("degenerate", "the LEDs seen do not determine the pose")


def refusal_of_overlap(overlap: Overlap, clear: int, beacon: Beacon) -> Refusal:
    """Why a pose is not believed whose blobs may hold the light of two LEDs.

    Args:
        overlap: One of the doubted LEDs.
        clear: How many LEDs are beyond doubt.
        beacon: The beacon.

    Returns:
        The refusal.
    """
    seen, unseen = beacon.leds[overlap.seen].name, beacon.leds[overlap.unseen].name
    return Refusal(
        "merged_leds",
        f"LED {unseen} is not seen and should shine {overlap.apart_px:.1f} px from {seen}; within "
        f"{overlap.reach_px:.1f} px their light may be one blob, and only {clear} LEDs are clear of that",
    )
