"""What is known of a gantry on disk: ``calib/gantries/<name>.toml``, written by ``uvgs gantry characterise``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from uvgs_bench.accuracy.axis_calibration import axis_pairs, true_directions
from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.devices.gantry.gantry import StampedPosition
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.store.documents import SCHEMA_KEY, read_document, write_atomically
from uvgs_bench.store.toml_text import toml_text
from uvgs_bench.units import deg_from_rad, mm_from_m, rad_from_mrad

_PPM = 1e-6
# Step of a derivative of directions, 1 and rad.
_SMALL = 1e-6


@dataclass(frozen=True, slots=True)
class AxisRecord:
    """What is known of one linear axis; a figure that was not measured is left out. Every ``sigma`` is 1 s.

    Args:
        name: The controller's letter.
        direction: Direction as the bench file declared it then.
        scale_ppm: Excess of travel, parts per million.
        scale_sigma_ppm: Its doubt.
        repeatability_mm: ISO 230-2 R, bidirectional, mm.
        repeatability_up_mm: R of approaches from below, mm.
        repeatability_down_mm: R of approaches from above, mm.
        reversal_mm: ISO 230-2 B, up minus down, mm.
        systematic_mm: ISO 230-2 E, mm.
        accuracy_mm: ISO 230-2 A, mm.
        pose_repeatability_mm: After ISO 9283, from below, mm.
        backlash_mm: Width of the dead band, mm.
        backlash_low_mm: Lower end of its 95 % interval, mm.
        backlash_high_mm: Upper end, mm.
        drift_mm_per_h: Wander of a place that is visited again and again, mm/h.
        drift_sigma_mm_per_h: Its doubt, mm/h.
        homing_mm: Scatter of a place after homing anew, standard deviation, mm.
        homing_low_mm: Lower end of its 95 % interval, mm.
        homing_high_mm: Upper end, mm.
        bend_mm: Largest deviation from a constant scale, mm; only where it is more than chance. Nothing corrects it.
        instrument_mm: Scatter of the instrument with the carriage at rest, mm, 1 s; it is in all of these.
    """

    name: str
    direction: tuple[float, float, float]
    scale_ppm: float | None = None
    scale_sigma_ppm: float | None = None
    repeatability_mm: float | None = None
    repeatability_up_mm: float | None = None
    repeatability_down_mm: float | None = None
    reversal_mm: float | None = None
    systematic_mm: float | None = None
    accuracy_mm: float | None = None
    pose_repeatability_mm: float | None = None
    backlash_mm: float | None = None
    backlash_low_mm: float | None = None
    backlash_high_mm: float | None = None
    drift_mm_per_h: float | None = None
    drift_sigma_mm_per_h: float | None = None
    homing_mm: float | None = None
    homing_low_mm: float | None = None
    homing_high_mm: float | None = None
    bend_mm: float | None = None
    instrument_mm: float | None = None


@dataclass(frozen=True, slots=True)
class PairRecord:
    """How two axes lean together.

    Args:
        axes: Their letters.
        squareness_mrad: Less than a right angle by this, mrad.
        squareness_sigma_mrad: Its doubt, standard deviation, mrad.
    """

    axes: tuple[str, str]
    squareness_mrad: float
    squareness_sigma_mrad: float


@dataclass(frozen=True, slots=True)
class GantryRecord:
    """What a characterisation found.

    Args:
        name: Name of the bench.
        created_utc: When, ISO 8601, UTC.
        judged_by: Who was the judge, in one line, as the report says it.
        axes: The linear axes.
        pairs: Pairs of them, in the order 1-2, 1-3, 2-3.
        covariance: Of the scales, then the squarenesses, 1 and rad; empty when they were not measured.
        remarks: What to know before using it.
    """

    name: str
    created_utc: str
    judged_by: str
    axes: tuple[AxisRecord, ...]
    pairs: tuple[PairRecord, ...] = ()
    covariance: tuple[tuple[float, ...], ...] = ()
    remarks: tuple[str, ...] = ()


def read_gantry_record(path: Path) -> GantryRecord:
    """Read what is known of a gantry. Raises ConfigError as ``read_document``."""
    return read_document(path, GantryRecord)


def write_gantry_record(path: Path, record: GantryRecord, *, force: bool = False) -> None:
    """Write what is known of a gantry.

    Args:
        path: The file.
        record: What is known.
        force: Whether an existing file may be replaced.

    Raises:
        ConfigError: The file exists and may not be replaced.
        UvgsError: It cannot be written.
    """
    write_atomically(path, toml_text({SCHEMA_KEY: 1} | record_tables(record)), force=force)


def record_tables(record: GantryRecord) -> dict[str, object]:
    """A record as plain tables, without what was not measured."""
    tables = asdict(record)
    tables["axes"] = [{key: value for key, value in axis.items() if value is not None} for axis in tables["axes"]]
    return {key: list(value) if isinstance(value, tuple) else value for key, value in tables.items() if value != ()}


def measured_axes(record: GantryRecord, axes: Sequence[Axis], path: str) -> tuple[Axis, ...]:
    """The axes with the scale and direction that were measured.

    Args:
        record: What is known.
        axes: The axes as declared.
        path: Where the record came from, for messages.

    Returns:
        The axes; as declared where scale and squareness were not measured.

    Raises:
        ConfigError: The record is of other axes, or axes were declared otherwise since.
    """
    linear = [i for i, axis in enumerate(axes) if axis.kind == "linear"]
    names, known = [axes[i].name for i in linear], [axis.name for axis in record.axes]
    if names != known:
        raise ConfigError(f"is of the axes {' '.join(known)}, the bench has {' '.join(names)}", path, "axes")
    for i, axis in zip(linear, record.axes, strict=True):
        if not np.allclose(np.asarray(axis.direction), axes[i].direction, atol=1e-9):
            raise ConfigError(f"axis {axis.name} was declared with another direction then", path, "axes.direction")
    if not record.pairs and all(axis.scale_ppm is None for axis in record.axes):
        return tuple(axes)
    wanted = [(names[i], names[j]) for i, j in axis_pairs(len(names))]
    if [pair.axes for pair in record.pairs] != wanted or any(axis.scale_ppm is None for axis in record.axes):
        raise ConfigError("needs a scale of every axis and the squareness of every pair, or none", path, "pairs")
    true = true_directions(
        np.array([axes[i].direction for i in linear]),
        _PPM * np.array([axis.scale_ppm or 0.0 for axis in record.axes]),
        rad_from_mrad(np.array([pair.squareness_mrad for pair in record.pairs])),
    )
    out = list(axes)
    for i, vector in zip(linear, true, strict=True):
        out[i] = replace(axes[i], direction=vector, scale=float(np.linalg.norm(vector)))
    return tuple(out)


def axis_term_covariance(record: GantryRecord) -> FloatArray | None:
    """The record's doubt of scales and squarenesses, as doubt of the axis terms of a registration.

    Axes may stand in any order and direction: what they do to the carriage is told in the axes of the gantry frame. A
    turn of all of them together is left out, since a registration cannot miss it.

    Args:
        record: What is known.

    Returns:
        Covariance of scales x, y, z and shears xy, xz, yz of ``accuracy.bench_terms``, shape (6, 6), 1 and rad; None
        when scale and squareness were not measured.
    """
    L = len(record.axes)
    count = L + len(axis_pairs(L))
    covariance = np.array(record.covariance)
    if covariance.shape != (count, count):
        return None
    directions = np.array([axis.direction for axis in record.axes])
    across = np.linalg.pinv(directions.T)
    by_error = np.zeros((6, count))
    for k in range(count):
        errors = np.zeros(count)
        errors[k] = _SMALL
        A = (true_directions(directions, errors[:L], errors[L:]) - directions).T @ across / _SMALL
        by_error[:, k] = [A[0, 0], A[1, 1], A[2, 2], A[0, 1] + A[1, 0], A[0, 2] + A[2, 0], A[1, 2] + A[2, 1]]
    return read_only(by_error @ covariance @ by_error.T)


def write_positions(path: Path, axes: Sequence[Axis], positions: Sequence[StampedPosition], *, force: bool) -> None:
    """Write positions on the way of a move as CSV: ``t_ns,doubt_ns`` and one column per axis, mm or deg.

    Args:
        path: The file.
        axes: The axes, in the order of the positions.
        positions: The positions, in the order of time.
        force: Whether an existing file may be replaced.

    Raises:
        ConfigError: The file exists and may not be replaced.
        UvgsError: The disk is full or the folder cannot be written.
    """
    names = [f"{axis.name}_{'mm' if axis.kind == 'linear' else 'deg'}" for axis in axes]
    shown = [mm_from_m if axis.kind == "linear" else deg_from_rad for axis in axes]
    lines = [",".join(["t_ns", "doubt_ns", *names])]
    for place in positions:
        values = (f"{unit(float(value)):.6f}" for unit, value in zip(shown, place.position, strict=True))
        lines.append(",".join([str(place.t_ns), str(place.doubt_ns), *values]))
    write_atomically(path, "\n".join(lines) + "\n", force=force)
