"""Captures grouped by what may matter: range, view angle, place in the picture, exposure."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.pose_error import ErrorTable
from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import deg_from_rad, ms_from_s

_RANGES = 4
_STEPS_M = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
_VIEW_STEP_DEG = 15
_ZONES = ("centre", "right", "below", "left", "above")
# Of the largest field angle.
_CENTRE = 0.5


def groups(table: ErrorTable, exposure_s: FloatArray) -> Iterator[tuple[str, str, NDArray[np.bool_]]]:
    """Groups of captures, misses included: they are where the beacon should have been seen.

    A grouping with fewer than two groups says nothing and is left out.

    Args:
        table: Errors.
        exposure_s: Exposure of each capture, shape (n,), s; NaN where it is not known.

    Yields:
        Grouping (``range view_angle zone exposure``), group in words, mask of its captures.
    """
    for name, words, index in (
        ("range", *_by_range(table.range_m)),
        ("view_angle", *_by_view(table.view_angle_rad)),
        ("zone", *_by_zone(table.predicted_t_m, table.field_angle_rad)),
        ("exposure", *_by_exposure(exposure_s)),
    ):
        present = [k for k in range(len(words)) if (index == k).any()]
        if len(present) > 1:
            for k in present:
                yield name, words[k], index == k


def _by_range(range_m: FloatArray) -> tuple[list[str], NDArray[np.int64]]:
    """Equal steps of a round width, about four."""
    if len(range_m) == 0:
        return [], np.empty(0, dtype=np.int64)
    low, high = float(range_m.min()), float(range_m.max())
    step = next((s for s in _STEPS_M if s * _RANGES >= high - low), _STEPS_M[-1])
    first = int(np.floor(low / step))
    index = np.floor(range_m / step).astype(np.int64) - first
    words = [f"{(first + k) * step:.2f} to {(first + k + 1) * step:.2f} m" for k in range(int(index.max()) + 1)]
    return words, index


def _by_view(view_rad: FloatArray) -> tuple[list[str], NDArray[np.int64]]:
    """Steps of 15 degrees of the angle between the beacon's axis and the line of sight, whichever way it points."""
    angle = deg_from_rad(np.minimum(view_rad, np.pi - view_rad))
    index = np.minimum(angle // _VIEW_STEP_DEG, 90 // _VIEW_STEP_DEG - 1).astype(np.int64)
    words = [f"{k * _VIEW_STEP_DEG} to {(k + 1) * _VIEW_STEP_DEG} deg" for k in range(90 // _VIEW_STEP_DEG)]
    return words, index


def _by_zone(t_m: FloatArray, field_angle_rad: FloatArray) -> tuple[list[str], NDArray[np.int64]]:
    """The middle of the part of the picture that was used, and its four sides."""
    if len(t_m) == 0:
        return [], np.empty(0, dtype=np.int64)
    side = 1 + (np.round(np.arctan2(t_m[:, 1], t_m[:, 0]) / (0.5 * np.pi)).astype(np.int64) % 4)
    return list(_ZONES), np.where(field_angle_rad < _CENTRE * field_angle_rad.max(), 0, side)


def _by_exposure(exposure_s: FloatArray) -> tuple[list[str], NDArray[np.int64]]:
    """Octaves of exposure; captures without one belong to none."""
    known = np.isfinite(exposure_s) & (exposure_s > 0.0)
    index = np.full(len(exposure_s), -1, dtype=np.int64)
    if not known.any():
        return [], index
    octave = np.round(np.log2(exposure_s[known])).astype(np.int64)
    first = int(octave.min())
    index[known] = octave - first
    words = [
        f"{ms_from_s(2.0 ** (first + k - 0.5)):.3g} to {ms_from_s(2.0 ** (first + k + 0.5)):.3g} ms"
        for k in range(int(octave.max()) - first + 1)
    ]
    return words, index
