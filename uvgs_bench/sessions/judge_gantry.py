"""From the readings of a self-test to what is known of the gantry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from uvgs_bench.accuracy.axis_calibration import AxisErrors, axis_pairs, board_places, fit_axis_errors
from uvgs_bench.accuracy.axis_tests import Positioning, fit_dead_band, fit_drift, judge_positioning, scatter_of
from uvgs_bench.accuracy.observations import Mount
from uvgs_bench.camera.boards import BoardView
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.errors import RegistrationError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.sessions.characterise import Options, Reading, Test
from uvgs_bench.store.gantry_records import AxisRecord, GantryRecord, PairRecord
from uvgs_bench.units import mm_from_m, mrad_from_rad

_PPM = 1e6
_S_PER_H = 3600.0
# A dead band that fills more of the way to and fro than this may be wider still.
_WIDEST_SHARE = 0.6
# Intervals of a dead band wider than this share of it, +-10 %, are said.
_VAGUE_SHARE = 0.2
# Of the repeatability, from which on the instrument hides the axis.
_OWN_SHARE = 0.5
# Below this, a deviation from a constant scale is no chance.
_BEND_CHANCE = 1e-3
_Fitted = TypeVar("_Fitted")


@dataclass(frozen=True, slots=True)
class Judge:
    """Who judged and under which assumptions.

    Args:
        name: The instrument.
        calibration: The camera, or None for a gauge.
        mount: Which part rides the carriage.
        board_sigma: Relative doubt of the board's printed size, or None when nobody measured it.
    """

    name: str
    calibration: Calibration | None = None
    mount: Mount = "beacon_on_carriage"
    board_sigma: float | None = None


def judge_gantry(
    readings: Sequence[Reading], axes: Sequence[Axis], judge: Judge, options: Options, name: str, created_utc: str
) -> GantryRecord:
    """What the readings say of every axis; what they cannot say is left out and said in a remark.

    Args:
        readings: As taken.
        axes: The axes as declared, in the controller's order.
        judge: Who read.
        options: What was tested.
        name: Name of the bench.
        created_utc: When, ISO 8601, UTC.

    Returns:
        The record.

    Raises:
        RegistrationError: Nothing at all could be said.
    """
    linear = [i for i, axis in enumerate(axes) if axis.kind == "linear"]
    remarks: list[str] = []
    along = _along_axes(readings, linear, judge, remarks)
    records = [AxisRecord(axes[i].name, _triple(axes[i].direction)) for i in linear]
    for column, i in enumerate(linear):
        records[column] = _judged_axis(records[column], i, column, readings, along, options, remarks)
    errors = None
    if "squareness" in options.tests and judge.calibration is not None:
        errors = _attempt("squareness", lambda: _errors(readings, axes, linear, judge), remarks)
    pairs: tuple[PairRecord, ...] = ()
    covariance: tuple[tuple[float, ...], ...] = ()
    if errors is not None:
        records, pairs = _with_errors(records, errors, remarks)
        covariance = tuple(tuple(float(value) for value in row) for row in errors.covariance)
        if judge.board_sigma is None:
            remarks.append(
                "the scales hold as far as the printed board does: its size was taken as exact, measure it and "
                "say how well you know it"
            )
    if all(record == AxisRecord(record.name, record.direction) for record in records):
        raise RegistrationError("nothing can be said of the gantry: " + ("; ".join(remarks) or "no readings"))
    return GantryRecord(
        name, created_utc, f"{judge.name}, {created_utc[:10]}", tuple(records), pairs, covariance, tuple(remarks)
    )


def _along_axes(readings: Sequence[Reading], linear: list[int], judge: Judge, remarks: list[str]) -> FloatArray:
    """Readings along each linear axis, shape (N, L), m; NaN where the instrument does not tell."""
    out = np.full((len(readings), len(linear)), np.nan)
    seen = [k for k, reading in enumerate(readings) if reading.view is not None]
    if seen and judge.calibration is not None:
        views = [view for k in seen if (view := readings[k].view) is not None]
        _, t_m = board_places(views, judge.calibration.lens)
        q = np.array([readings[k].position[linear] for k in seen])
        moved = np.ptp(q, axis=0) > 1e-6
        A = np.column_stack([q[:, moved] - q[:, moved].mean(axis=0), np.ones(len(seen))])
        towards = np.linalg.lstsq(A, t_m, rcond=None)[0][:-1]
        for column, row in zip(np.flatnonzero(moved), towards, strict=True):
            out[seen, column] = t_m @ (row / np.linalg.norm(row))
    for k, reading in enumerate(readings):
        if reading.along_m is not None and reading.visit.axis in linear:
            out[k, linear.index(reading.visit.axis)] = reading.along_m
    return out


def _judged_axis(
    record: AxisRecord,
    axis: int,
    column: int,
    readings: Sequence[Reading],
    along: FloatArray,
    options: Options,
    remarks: list[str],
) -> AxisRecord:
    def of(test: Test, any_axis: bool) -> list[int]:
        return [
            k
            for k, reading in enumerate(readings)
            if reading.visit.test == test and (any_axis or reading.visit.axis == axis) and np.isfinite(along[k, column])
        ]

    values = along[:, column]
    still = [k for k in of("still", True) if readings[k].visit.target == 0]
    if len(still) > 1:
        record = replace(record, instrument_mm=mm_from_m(scatter_of(values[still]).sigma_m))
    at = of("positioning", False)
    if at:
        p = _attempt(
            f"positioning of {record.name}", lambda: _positioning(readings, at, values, axis, options), remarks
        )
        if p is not None:
            record = replace(
                record,
                repeatability_mm=mm_from_m(p.repeatability_m),
                repeatability_up_mm=mm_from_m(p.repeatability_up_m),
                repeatability_down_mm=mm_from_m(p.repeatability_down_m),
                reversal_mm=mm_from_m(p.reversal_m),
                systematic_mm=mm_from_m(p.systematic_m),
                accuracy_mm=mm_from_m(p.accuracy_m),
                pose_repeatability_mm=mm_from_m(p.pose_repeatability_m),
            )
            own_mm = 4.0 * (record.instrument_mm or 0.0)
            if own_mm > _OWN_SHARE * mm_from_m(p.repeatability_up_m):
                remarks.append(
                    f"repeatability of {record.name}: mostly the instrument's own scatter ({own_mm:.3f} mm as R); the "
                    "axis is better than these figures"
                )
    at = of("reversal", False)
    if at:
        commands = np.array([readings[k].visit.position[axis] for k in at])
        band = _attempt(f"dead band of {record.name}", lambda: fit_dead_band(commands, values[at]), remarks)
        if band is not None and band.high_m > _WIDEST_SHARE * options.reversal_span_m:
            remarks.append(
                f"dead band of {record.name}: too wide for steps on so short a way, repeat it on a longer one"
            )
        elif band is not None:
            record = replace(
                record,
                backlash_mm=mm_from_m(band.width_m),
                backlash_low_mm=mm_from_m(band.low_m),
                backlash_high_mm=mm_from_m(band.high_m),
            )
            if band.high_m - band.low_m > _VAGUE_SHARE * band.width_m:
                half_mm = mm_from_m(0.5 * (band.high_m - band.low_m))
                remarks.append(
                    f"dead band of {record.name}: known to +-{half_mm:.3f} mm only (95 %), for the readings scatter; "
                    "along the view of a camera use a dial gauge"
                )
    at = of("drift", True)
    if len(at) > 2:
        drift = fit_drift(np.array([readings[k].t_s for k in at]), values[at])
        record = replace(
            record,
            drift_mm_per_h=mm_from_m(drift.rate_mps) * _S_PER_H,
            drift_sigma_mm_per_h=mm_from_m(drift.sigma_mps) * _S_PER_H,
        )
    at = of("homing", True)
    if len(at) > 1:
        homing = scatter_of(values[at])
        record = replace(
            record,
            homing_mm=mm_from_m(homing.sigma_m),
            homing_low_mm=mm_from_m(homing.low_m),
            homing_high_mm=mm_from_m(homing.high_m),
        )
    return record


def _positioning(
    readings: Sequence[Reading], at: list[int], values: FloatArray, axis: int, options: Options
) -> Positioning:
    table = np.full((2, options.targets, options.runs), np.nan)
    targets = np.full(options.targets, np.nan)
    for k in at:
        visit = readings[k].visit
        table[int(visit.is_from_above), visit.target, visit.run] = values[k]
        targets[visit.target] = visit.position[axis]
    if np.isnan(table).any():
        raise RegistrationError(f"{int(np.isnan(table).sum())} of {table.size} readings are missing")
    return judge_positioning(targets, table[0], table[1])


def _errors(readings: Sequence[Reading], axes: Sequence[Axis], linear: list[int], judge: Judge) -> AxisErrors:
    assert judge.calibration is not None
    used = [r for r in readings if r.visit.test == "squareness" and r.view is not None]
    views: list[BoardView] = [r.view for r in used if r.view is not None]
    return fit_axis_errors(
        views,
        np.array([r.position[linear] for r in used]).reshape(len(used), len(linear)),
        np.array([axes[i].direction for i in linear]),
        judge.calibration,
        mount=judge.mount,
        board_sigma=judge.board_sigma or 0.0,
    )


def _with_errors(
    records: list[AxisRecord], errors: AxisErrors, remarks: list[str]
) -> tuple[list[AxisRecord], tuple[PairRecord, ...]]:
    L = len(records)
    scaled = [
        replace(record, scale_ppm=_PPM * float(scale), scale_sigma_ppm=_PPM * float(sigma))
        for record, scale, sigma in zip(records, errors.scale, errors.sigmas[:L], strict=True)
    ]
    for i, (bend_m, chance) in enumerate(zip(errors.bend_m, errors.bend_chance, strict=True)):
        if chance < _BEND_CHANCE:
            bend_mm = mm_from_m(float(bend_m))
            scaled[i] = replace(scaled[i], bend_mm=bend_mm)
            remarks.append(
                f"axis {records[i].name} has no constant scale: it deviates by up to {bend_mm:.3f} mm, more than "
                "chance explains; nothing corrects that, so position_sigma_mm of the bench file must hold it"
            )
    pairs = tuple(
        PairRecord((records[i].name, records[j].name), mrad_from_rad(float(angle)), mrad_from_rad(float(sigma)))
        for (i, j), angle, sigma in zip(axis_pairs(L), errors.shear_rad, errors.sigmas[L:], strict=True)
    )
    return scaled, pairs


def _attempt(what: str, action: Callable[[], _Fitted], remarks: list[str]) -> _Fitted | None:
    try:
        return action()
    except RegistrationError as error:
        remarks.append(f"{what}: {error}")
        return None


def _triple(direction: FloatArray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in direction)
    return x, y, z
