"""The robust adjustment behind a measurement: outliers set aside, pixel deviations from the residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.beacon.network import Doubt, Network, State, adjust, doubt, residuals_px, with_sigma
from uvgs_bench.errors import CalibrationError
from uvgs_bench.geometry import FloatArray

_REJECT_SIGMA = 4.0
_MAX_REJECTED = 0.1
# Below this redundancy the scatter of residuals says less about the noise than the declared deviations do.
_MIN_REDUNDANCY = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A minimum, its doubt, which sightings are kept, and the deviation of LED centroids found, px."""

    network: Network
    state: State
    doubt: Doubt
    weight: FloatArray
    residual_px: FloatArray
    sigma_px: float
    warnings: tuple[str, ...]


def robust_fit(network: Network, state: State) -> Fit:
    """Adjust with Huber weights first, then reject hard at four deviations.

    Args:
        network: The network; its pixel deviations are starts.
        state: A start near the minimum.

    Returns:
        The minimum, with pixel deviations of LEDs and board as the residuals show them.

    Raises:
        CalibrationError: The start does not see its points, a direction stays open, or a view loses its points.
    """
    s = network.sightings
    is_led = s.led >= 0
    groups = [group for group in (is_led, ~is_led) if group.any()]
    weight = np.ones(len(s.px))
    for _ in range(6):
        state, _ = adjust(network, state, weight)
        size = np.linalg.norm(residuals_px(network, state), axis=1) / s.sigma_px
        for group in groups:
            # The median length of a plane Gaussian is 1.1774 deviations.
            scale = max(float(np.median(size[group])) / 1.1774, 1e-6)
            weight[group] = 1.0 / np.maximum(size[group] / (2.0 * scale), 1.0)
    weight = np.ones(len(s.px))
    declared = s.sigma_px
    for _ in range(30):
        state, _ = adjust(network, state, weight)
        e, found = residuals_px(network, state), doubt(network, state, weight)
        sigma = network.sightings.sigma_px.copy()
        kept = weight > 0.0
        change = 0.0
        for group in groups:
            chosen = group & kept
            redundancy = float((1.0 - found.leverage[chosen]).sum())
            if redundancy >= _MIN_REDUNDANCY:
                factor = np.sqrt(float(((e[chosen] / sigma[chosen, None]) ** 2).sum()) / redundancy)
                factor = max(factor, 1e-3 / float(sigma[group].max()))
                sigma[group] *= factor
                change = max(change, abs(float(np.log(factor))))
        free = np.maximum(1.0 - found.leverage, 0.05)
        size = np.where(kept, np.max(np.abs(e) / sigma[:, None] / np.sqrt(free), axis=1), 0.0)
        network = with_sigma(network, sigma)
        worst = float(size.max())
        if worst > _REJECT_SIGMA and 1.0 - kept.mean() < _MAX_REJECTED:
            weight = np.where(size >= max(_REJECT_SIGMA, 0.7 * worst), 0.0, weight)
            _check_left(network, weight)
        elif change < 0.01:
            break
    state, _ = adjust(network, state, weight)
    e, found = residuals_px(network, state), doubt(network, state, weight)
    lines = []
    if worst > _REJECT_SIGMA:
        lines.append(
            f"more than {_MAX_REJECTED:.0%} of the sightings fit badly (worst {worst:.1f} deviations): labels, lens or "
            "rigidity are in doubt"
        )
    ratio = float(np.median(network.sightings.sigma_px[is_led] / declared[is_led]))
    if ratio > 3.0:
        lines.append(f"residuals are {ratio:.1f} times what the centroids promise; deviations are scaled up")
    used = is_led & (weight > 0.0)
    sigma_px = float(np.sqrt(np.mean(network.sightings.sigma_px[used] ** 2)))
    return Fit(network, state, found, weight, e, sigma_px, tuple(lines))


def _check_left(network: Network, weight: FloatArray) -> None:
    left = np.bincount(network.sightings.view[weight > 0.0], minlength=network.sightings.view_count)
    if network.gantry is None and (left < 3).any():
        raise CalibrationError(
            f"view {int(np.argmin(left)) + 1} keeps only {int(left.min())} points after outliers are set aside: "
            "leave that picture out"
        )
