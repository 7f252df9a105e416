"""What a calibration report is made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.fitting import CalibrationResult


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationEvidence:
    """A calibration and what is known about how it came to be.

    Args:
        calibration: The lens with its doubt.
        result: The views, residuals and cross-checks; None when only the camera file is left.
        beacon: A beacon whose pose the lens will give, or None.
        pictures: Pictures of the board by view name, mono (H, W) or BGR (H, W, 3); only those at hand.
    """

    calibration: Calibration
    result: CalibrationResult | None = None
    beacon: Beacon | None = None
    pictures: Mapping[str, NDArray[np.generic]] = field(default_factory=dict)

    @property
    def too_small(self) -> float | None:
        """How many times the deviations are too small by the evidence of two halves, at least 1; None when unknown."""
        return None if self.calibration.halves_ratio is None else self.calibration.doubt_factor


def worst_views(result: CalibrationResult, count: int) -> tuple[int, ...]:
    """Numbers of the views with the largest RMS, worst first; equal ones in their order."""
    order = np.argsort(-result.view_rms_px, kind="stable")[:count]
    return tuple(int(i) for i in order)


def kept_masks(result: CalibrationResult) -> tuple[NDArray[np.bool_], ...]:
    """Which corners of each view were kept, one (N,) per view."""
    number = {name: i for i, name in enumerate(result.view_names)}
    masks = tuple(np.ones(len(view.px), dtype=np.bool_) for view in result.views)
    for corner in result.rejected:
        masks[number[corner.view]][corner.index] = False
    return masks
