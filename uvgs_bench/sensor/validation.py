"""Stage 6: whether a solved pose is believed: converged, in front, facing, and explaining its centroids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.led_table import LedTable
from uvgs_bench.sensor.solution import Solution

# Below this the inverse keeps no digit: far beyond any real view of four LEDs.
_LEAST_EIGENVALUE = 1e-13


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a pose is not published.

    Args:
        reason: Stable word.
        detail: One line with the numbers.
    """

    reason: str
    detail: str


def check_solution(
    solution: Solution,
    points_m: FloatArray,
    sigma_px: FloatArray,
    leds: LedTable,
    seen: np.ndarray[tuple[int], np.dtype[np.intp]],
    lens: Lens,
    beacon: Beacon,
    config: UvgsConfig,
) -> Refusal | None:
    """Judge a solution.

    The fit is judged against centroid noise, what lens and beacon files may be wrong by (``model_error_px``), and the
    beacon's own covariance, so that a good fit to the wrong model is refused and a fair fit to a fair model is not.

    Args:
        solution: What the solver answered.
        points_m: The LEDs used, shape (k, 3), m.
        sigma_px: Centroid deviations, shape (k,), px.
        leds: The tabulated beacon.
        seen: Indices of the LEDs used, shape (k,).
        lens: The lens.
        beacon: The beacon.
        config: Limits.

    Returns:
        None when believed, else the first test it fails.
    """
    pose = solution.camera_from_beacon
    if not solution.converged:
        return Refusal("not_converged", f"no minimum after {solution.iterations} steps of {config.solver}")
    p = pose.apply(points_m)
    if lens.model != "equidistant" and float(p[:, 2].min()) <= 0.0:
        return Refusal("behind_camera", f"an LED would lie {-1.0 * float(p[:, 2].min()):.3f} m behind the camera")
    directions = leds.axes[seen] @ pose.R.T
    cosine = -np.einsum("ij,ij->i", directions, p) / np.linalg.norm(p, axis=1)
    hidden = cosine < leds.cos_limit[seen]
    if hidden.any():
        name = beacon.leds[int(seen[int(np.flatnonzero(hidden)[0])])].name
        return Refusal("not_facing", f"LED {name} would shine away from the camera")
    range_m = float(np.linalg.norm(pose.t_m))
    if not config.min_range_m <= range_m <= config.max_range_m:
        return Refusal(
            "out_of_range", f"{range_m:.3f} m is outside {config.min_range_m:.3f} to {config.max_range_m:.3f} m"
        )
    variance = sigma_px**2 + config.model_error_px**2
    if beacon.covariance_m2 is not None:
        spread_m2 = np.diag(beacon.covariance_m2).reshape(-1, 3).mean(axis=1)[seen]
        variance = variance + spread_m2 * (lens.fx_px / np.linalg.norm(p, axis=1)) ** 2
    dof = 2 * len(points_m) - 6
    chi2 = float((solution.residual_px**2 / variance[:, None]).sum())
    rms_px = float(np.sqrt(np.mean(solution.residual_px**2)))
    if rms_px > config.max_rms_px:
        return Refusal("residual_too_large", f"residual {rms_px:.2f} px rms, at most {config.max_rms_px:.2f} px")
    if dof > 0 and chi2 > config.max_chi2_per_dof * dof:
        return Refusal(
            "residual_too_large",
            f"chi-square {chi2:.1f} for {dof} degrees of freedom ({rms_px:.2f} px rms), "
            f"at most {config.max_chi2_per_dof * dof:.1f}",
        )
    # Scaled to a unit diagonal, so that radians and metres do not count.
    scale = np.sqrt(np.diag(solution.information))
    if not float(np.linalg.eigvalsh(solution.information / np.outer(scale, scale))[0]) > _LEAST_EIGENVALUE:
        return Refusal("degenerate", "the LEDs seen do not determine the pose")
    return None
