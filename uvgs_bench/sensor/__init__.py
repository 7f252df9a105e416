"""uVGS-2: one image in, one pose (or a reason) out; one file per stage.

Here: ``Uvgs`` and its stages: preprocess, blobs, selection, correspondence, solvers, validation.
In: ``Capture``, a calibration, a beacon. Out: ``PoseEstimate`` or ``Miss``. Plug point: ``solution.SOLVERS``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.outcome import Miss, Outcome, PoseEstimate

if TYPE_CHECKING:
    from uvgs_bench.sensor.uvgs import Uvgs

__all__ = ["Capture", "Miss", "Outcome", "PoseEstimate", "Uvgs", "UvgsConfig"]


def __getattr__(name: str) -> object:
    """Load the solver only when asked for: types alone must not load compiled code."""
    if name == "Uvgs":
        from uvgs_bench.sensor.uvgs import Uvgs

        return Uvgs
    raise AttributeError(name)
