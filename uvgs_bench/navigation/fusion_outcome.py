"""A fusion with all that is beside it: other choices of sources and methods, the sensor alone, what does not fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray
from uvgs_bench.navigation.delays import Misfit
from uvgs_bench.navigation.fusion_data import FusionInput, FusionResult
from uvgs_bench.navigation.fusion_score import FusionScore, RawScore
from uvgs_bench.units import deg_from_rad, mm_from_m, ms_from_s

_DEVIATIONS = 3.0
# What is smaller than this does no harm to speak of: s, rad, m.
_HARMLESS_S, _HARMLESS_RAD, _HARMLESS_M = 0.005, 0.005, 0.01
# Innovations squared: 1 per number is expected; twice that is no longer chance in hundreds of poses.
_SURPRISED = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class FusedRun:
    """One way of fusing.

    Args:
        name: Short name for tables and legends.
        result: What it said.
        score: What that amounts to.
    """

    name: str
    result: FusionResult
    score: FusionScore


@dataclass(frozen=True, slots=True, eq=False)
class FusionOutcome:
    """A fusion with what is beside it.

    Args:
        source: What was fused.
        runs: The fusion asked for, first; then those it is compared with.
        raw: The sensor alone.
        misfit: What of the set-up does not fit the data; None when it could not be looked for.
        false_ns: Instants of poses known to be false.
        problems: What makes the result doubtful, a line each.
        remarks: What else a reader must know, a line each.
    """

    source: FusionInput
    runs: tuple[FusedRun, ...]
    raw: RawScore
    misfit: Misfit | None
    false_ns: frozenset[int]
    problems: tuple[str, ...]
    remarks: tuple[str, ...]

    @property
    def main(self) -> FusedRun:
        """The fusion asked for."""
        return self.runs[0]


def misfit_lines(misfit: Misfit) -> tuple[str, ...]:
    """What of the set-up certainly does not fit, a line each, with what would put it right."""
    out = []
    sigma_s = float(misfit.sigma[0])
    if misfit.is_known[0] and abs(misfit.offset_s) > max(_HARMLESS_S, _DEVIATIONS * sigma_s):
        way = "late" if misfit.offset_s > 0.0 else "early"
        out.append(
            f"clocks: the sensor's stamps are {ms_from_s(abs(misfit.offset_s)):.0f} ± {ms_from_s(sigma_s):.1f} ms too "
            f"{way} against the inertial unit's; sensor_offset_s = {misfit.offset_s:.3f} would put that right"
        )
    turn, turn_sigma = misfit.rotation_rad, misfit.sigma[1:4]
    known = np.array(misfit.is_known[1:4])
    if (known & (np.abs(turn) > np.maximum(_HARMLESS_RAD, _DEVIATIONS * turn_sigma))).any():
        said = _vector(deg_from_rad(turn), deg_from_rad(turn_sigma), known)
        out.append(f"mounting: the camera seems turned by {said} deg about its x, y, z against what is stated")
    shift, shift_sigma = misfit.shift_m, misfit.sigma[4:]
    known = np.array(misfit.is_known[4:])
    if (known & (np.abs(shift) > np.maximum(_HARMLESS_M, _DEVIATIONS * shift_sigma))).any():
        said = _vector(mm_from_m(shift), mm_from_m(shift_sigma), known)
        out.append(f"mounting: the camera seems moved by {said} mm along its x, y, z against what is stated")
    if misfit.surprise_after > _SURPRISED:
        out.append(
            f"innovations are {np.sqrt(misfit.surprise_after):.1f} times as large as stated, however clocks and "
            "mounting are put: poses or readings are noisier than they say, or the beacon moves"
        )
    return tuple(out)


def untold(misfit: Misfit) -> str:
    """What of the set-up this motion cannot tell, or nothing."""
    names = ("clock offset", *(f"turn about {a}" for a in "xyz"), *(f"shift along {a}" for a in "xyz"))
    missing = [name for name, known in zip(names, misfit.is_known, strict=True) if not known]
    return f"this motion does not tell of the camera's mounting: {', '.join(missing)}" if missing else ""


def _vector(values: FloatArray, sigma: FloatArray, known: NDArray[np.bool_]) -> str:
    cells = [f"{v:.2f} ± {s:.2f}" if k else "unknown" for v, s, k in zip(values, sigma, known, strict=True)]
    return f"({', '.join(cells)})"
