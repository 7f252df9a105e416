"""From the minimum of an adjustment to the measurement people read: distances, residuals, warnings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.beacon.frames import fit_rigid, fit_rigid_robust, place
from uvgs_bench.beacon.geometry import Beacon, Led
from uvgs_bench.beacon.length_row import LengthRow
from uvgs_bench.beacon.measure_checks import refuse_vague, view_angles
from uvgs_bench.beacon.measure_fit import Fit
from uvgs_bench.beacon.measure_start import LedView
from uvgs_bench.beacon.measure_types import BeaconMeasurement, Distance, LedResiduals, MeasureConfig
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.units import mm_from_m

# Emission centres travel by tenths of a millimetre: a worse deviation says nothing about them.
_VAGUE_SHIFT_M = 5e-4


def build_result(
    views: Sequence[LedView],
    nominal: Beacon,
    config: MeasureConfig,
    fit: Fit,
    name: str,
    scale_source: str,
    margin: float,
    warnings: tuple[str, ...],
    used: tuple[LengthRow, ...],
) -> BeaconMeasurement:
    """Put the measurement together.

    Args:
        views: The views.
        nominal: The beacon as meant.
        config: What was asked for.
        fit: The minimum.
        name: Name of the measured beacon; the nominal's when empty.
        scale_source: For people.
        margin: Of the mirror image.
        warnings: Found so far.
        used: Caliper statements, whether used or not.

    Returns:
        The measurement.

    Raises:
        TooFewViews: A distance is too doubtful.
        ConfigError: The frame cannot be set.
    """
    names, n = nominal.led_names, len(nominal.leds)
    block = fit.doubt.covariance[: 3 * n, : 3 * n]
    leds_m, covariance = place(fit.state.leds_m, block, nominal.positions_m, config.frame, names)
    by_pair = {frozenset((c.first, c.second)): c for c in config.calipers}
    distances = []
    for i in range(n):
        for j in range(i + 1, n):
            edge = leds_m[j] - leds_m[i]
            length = float(np.linalg.norm(edge))
            g = np.zeros(3 * n)
            g[3 * i : 3 * i + 3], g[3 * j : 3 * j + 3] = -edge / length, edge / length
            hand = by_pair.get(frozenset((names[i], names[j])))
            sigma = float(np.sqrt(max(float(g @ covariance @ g), 0.0)))
            meant = float(np.linalg.norm(nominal.positions_m[j] - nominal.positions_m[i]))
            distances.append(
                Distance(names[i], names[j], length, sigma, meant, *((hand.distance_m, hand.sigma_m) if hand else ()))
            )
    refuse_vague(distances, config.worst_sigma_m)
    lines = [*warnings, *_contradictions(distances, config.by == "free")]
    if config.by != "free" or used:
        lines += _off_nominal(distances)
    R, _ = fit_rigid(nominal.positions_m, leds_m)
    leds = tuple(
        Led(led.name, p, None if led.axis is None else R @ led.axis, led.half_angle_rad, led.diameter_m)
        for led, p in zip(nominal.leds, leds_m, strict=True)
    )
    table = _led_table(nominal, leds_m, fit)
    lines += [
        f"LED {row.name} seems to wander {mm_from_m(row.shift_m):+.3f} ± {mm_from_m(row.shift_sigma_m):.3f} mm along "
        "its axis with the view angle"
        for row in table
        if not config.is_shift_free and abs(row.shift_m) > 4.0 * row.shift_sigma_m
    ]
    vague_m = max((row.shift_sigma_m for row in table if row.shift_sigma_m > 0.0), default=0.0)
    if config.is_shift_free and vague_m > _VAGUE_SHIFT_M:
        lines.append(
            f"the views tell the travel of emission centres only to ± {mm_from_m(vague_m):.2f} mm, which widens the "
            "positions: fix a board to the beacon and tilt it more, or leave the travel out"
        )
    s, dropped = fit.network.sightings, np.flatnonzero(fit.weight == 0.0)
    rejected = tuple(
        (
            views[int(s.view[k])].name,
            names[int(s.led[k])] if s.led[k] >= 0 else "board",
            float(np.linalg.norm(fit.residual_px[k])),
        )
        for k in dropped
    )
    redundancy = float((1.0 - fit.doubt.leverage[fit.weight > 0.0]).sum())
    return BeaconMeasurement(
        Beacon(name or nominal.name, leds, nominal.hue, read_only(covariance)),
        tuple(distances), table, config.by, scale_source, config.frame.text, len(views), fit.sigma_px, redundancy,
        fit.doubt.condition, margin, rejected, tuple(lines),
        config.is_shift_free,
    )  # fmt: skip


def _contradictions(distances: Sequence[Distance], is_source: bool) -> list[str]:
    out = []
    for d in distances:
        if d.caliper_m is None or d.caliper_sigma_m is None:
            continue
        # As the source, the caliper is already in the distance: what is left is smaller than its own deviation.
        doubt_m = d.caliper_sigma_m if is_source else float(np.hypot(d.sigma_m, d.caliper_sigma_m))
        off = d.distance_m - d.caliper_m
        if abs(off) > 3.0 * doubt_m:
            out.append(
                f"{d.first}-{d.second}: pictures and caliper differ by {mm_from_m(off):+.3f} mm, "
                f"{abs(off) / doubt_m:.1f} deviations"
            )
    checked = [d for d in distances if d.caliper_m is not None]
    if not is_source and checked:
        ratio = float(np.median([d.distance_m / d.caliper_m - 1.0 for d in checked if d.caliper_m]))
        doubt_of_ratio = float(
            np.median([np.hypot(d.sigma_m, d.caliper_sigma_m or 0.0) / d.distance_m for d in checked])
        )
        if abs(ratio) > 3.0 * doubt_of_ratio:
            out.append(
                f"all distances are {ratio:+.2%} against the calipers: the size of the squares or the steps of the "
                "gantry may be declared wrong"
            )
    return out


def _off_nominal(distances: Sequence[Distance]) -> list[str]:
    ratio = float(np.median([d.distance_m / d.nominal_m - 1.0 for d in distances]))
    spread = float(np.median([abs(d.distance_m / d.nominal_m - 1.0 - ratio) for d in distances]))
    if abs(ratio) > 0.01 and abs(ratio) > 4.0 * spread:
        return [f"the whole beacon is {ratio:+.1%} against its nominal: check the scale source or the drawing"]
    return []


def _led_table(nominal: Beacon, leds_m: FloatArray, fit: Fit) -> tuple[LedResiduals, ...]:
    R, t = fit_rigid_robust(nominal.positions_m, leds_m)
    deviation = np.linalg.norm(leds_m - nominal.positions_m @ R.T - t, axis=1)
    s = fit.network.sightings
    out = []
    for i, led in enumerate(nominal.leds):
        seen: NDArray[np.intp] = np.flatnonzero((s.led == i) & (fit.weight > 0.0))
        e = fit.residual_px[seen]
        widest, shift, shift_sigma = float("nan"), float("nan"), float("nan")
        angle, along = np.empty(0), np.empty(0)
        if led.axis is not None and len(seen) >= 6:
            angle, by_axis = view_angles(fit.network, fit.state, seen, i, nominal)
            widest = float(angle.max())
            # Seen along the axis, its picture is a point and has no direction.
            along = np.einsum("ni,ni->n", e, by_axis) / np.maximum(np.linalg.norm(by_axis, axis=1), 1e-9)
            columns = np.stack([by_axis, by_axis * (1.0 - np.cos(angle))[:, None]], axis=2).reshape(-1, 2)
            normal = columns.T @ columns
            if np.linalg.cond(normal) < 1e8:
                inverse = np.linalg.inv(normal)
                shift = float((inverse @ columns.T @ e.ravel())[1])
                shift_sigma = fit.sigma_px * float(np.sqrt(inverse[1, 1]))
        at = fit.network.columns.get("shifts")
        if at is not None and led.axis is not None:
            shift = float(fit.state.shifts_m[i])
            shift_sigma = float(np.sqrt(fit.doubt.covariance[at.start + i, at.start + i]))
        out.append(
            LedResiduals(
                led.name,
                len(seen),
                int(((s.led == i) & (fit.weight == 0.0)).sum()),
                float(np.sqrt(np.mean(e**2))) if len(seen) else float("nan"),
                widest,
                shift,
                shift_sigma,
                float(deviation[i]),
                read_only(angle),
                read_only(along),
            )
        )
    return tuple(out)
