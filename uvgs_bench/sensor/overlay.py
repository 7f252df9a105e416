"""What is drawn over a picture, as data: every sink renders it by its own means and none computes it anew."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.sensor.blobs import Blobs, NoBlobs
from uvgs_bench.sensor.selection import gates, select_blobs
from uvgs_bench.sensor.uvgs import Uvgs

_ARROW_PX = 45.0


@dataclass(frozen=True, slots=True, eq=False)
class BlobNote:
    """One blob as drawn.

    Args:
        index: Its number in the picture.
        blob: Its row in ``Blobs``.
        dropped: Why it was dropped; empty when it is a candidate.
    """

    index: int
    blob: int
    dropped: str


@dataclass(frozen=True, slots=True, eq=False)
class PoseMarks:
    """A pose in the picture.

    Args:
        axes_px: Origin and ends of the x, y and z axes of the beacon, shape (4, 2), px; NaN where not seen.
        projected_px: Where the LEDs should be, shape (n, 2), px.
        runner_up_px: Where they would be in the second best pose, shape (n, 2), px; None without one.
    """

    axes_px: FloatArray
    projected_px: FloatArray
    runner_up_px: FloatArray | None


def pose_marks(camera_from_beacon: Pose, runner_up: Pose | None, uvgs: Uvgs) -> PoseMarks:
    """Project what is drawn of a pose; the axes are half as long as the beacon is wide.

    Args:
        camera_from_beacon: The pose.
        runner_up: The second best pose, or None.
        uvgs: The sensor that found it.

    Returns:
        The marks.
    """
    lens, points_m = uvgs.calibration.lens, uvgs.beacon.positions_m
    reach_m = 0.5 * float(np.linalg.norm(np.ptp(points_m, axis=0)))
    ends_m = np.vstack([np.zeros(3), np.eye(3) * reach_m])
    return PoseMarks(
        lens.project(camera_from_beacon.apply(ends_m)),
        lens.project(camera_from_beacon.apply(points_m)),
        None if runner_up is None else lens.project(runner_up.apply(points_m)),
    )


def blob_notes(blobs: Blobs, uvgs: Uvgs) -> tuple[BlobNote, ...]:
    """Which blobs the selection keeps, and why it drops the others.

    Args:
        blobs: All blobs of the picture.
        uvgs: The sensor.

    Returns:
        One note per blob.
    """
    config = uvgs.config
    chosen = select_blobs(blobs, uvgs.beacon, uvgs.calibration.lens.fx_px, config)
    kept = None if isinstance(chosen, NoBlobs) else {tuple(px) for px in chosen.centroid_px.tolist()}
    passed = gates(blobs, uvgs.beacon, uvgs.calibration.lens.fx_px, config)
    notes = []
    for i in range(len(blobs)):
        reason = next((_failing(name, blobs, i) for name, gate in passed.items() if not gate[i]), "")
        if not reason and kept is not None and tuple(blobs.centroid_px[i].tolist()) not in kept:
            reason = "distance"
        notes.append(BlobNote(i, i, reason))
    return tuple(notes)


def _failing(gate: str, blobs: Blobs, i: int) -> str:
    """A gate a blob failed, with the value where the drawing does not show it."""
    value = {"shape": blobs.circularity[i], "hue": blobs.hue_deg[i]}.get(gate)
    return gate if value is None or np.isnan(value) else f"{gate} {value:.{2 if gate == 'shape' else 0}f}"


def arrow_gain(residual_px: FloatArray) -> int:
    """How many times too long residual arrows are drawn: 1, 2, 5, 10 ... 500, so that the longest is well seen."""
    longest = float(np.nanmax(np.linalg.norm(residual_px, axis=1), initial=0.0))
    wanted = _ARROW_PX / max(longest, 1e-4)
    steps = [m * 10**k for k in range(3) for m in (1, 2, 5)]
    return max((s for s in steps if s <= wanted), default=1)
