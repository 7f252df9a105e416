"""Histograms of the errors against the law the sensor's own covariance predicts."""

from __future__ import annotations

from typing import Any

import numpy as np

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.accuracy.pose_error import ErrorTable
from uvgs_bench.accuracy.statistics import Consistency
from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.cells import Cell, Interval
from uvgs_bench.report.document import Block, Column, Figure, Paragraph, Section, Table
from uvgs_bench.report.figures import legend_above, plain_axes, series, style, svg_of, thinned
from uvgs_bench.report.marks import draw_marks
from uvgs_bench.report.palette import INK, SERIES
from uvgs_bench.report.quantities import SCALES, decimals_of, measured
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.store.run import Run

_DEGREES_OF_FREEDOM = 6
_SHOWN_SIGMAS = 5.0
# 95 % point of chi-squared with 6 degrees of freedom.
_POINT_95 = 12.59


def build(run: Run, judgement: Judgement) -> Section | None:
    """Normalised components against N(0, 1), NEES against chi-squared of 6."""
    table = judgement.table
    if table is None or not table.is_solved.any():
        return None
    table = table.select(table.is_solved)
    gantry_sigma_m = 0.0 if judgement.registration is None else judgement.registration.gantry_sigma_m
    z = normalised(run, table, gantry_sigma_m)
    text = (
        "Each error is divided by the standard deviation predicted for it (sensor, gantry and registration). Taller "
        "tails than the drawn law mean that the sensor is surer of itself than it should be."
    )
    blocks: list[Block] = [Paragraph(text)]
    figures = (
        _components(z[:, 3:], "z-position", ("lateral x", "lateral y", "depth z"), "position"),
        _components(z[:, :3], "z-attitude", ("tilt x", "tilt y", "roll z"), "attitude"),
        _nees(table.nees[np.isfinite(table.nees)]),
        _nees_by_range(table.select(np.isfinite(table.nees))),
    )
    by_range = () if judgement.summary is None else _by_range(judgement.summary.consistency_by_range)
    return Section("distribution", "Errors against the predicted law", (*blocks, *figures, *by_range))


def _by_range(checks: tuple[tuple[str, Consistency], ...]) -> tuple[Table, ...]:
    """Whether the covariance tells the truth near and far alike."""
    if not checks:
        return ()
    one = SCALES["1"]
    decimals = decimals_of([check.mean_nees_over_6 for _, check in checks], 1.0, 2)
    rows: list[tuple[Cell, ...]] = [
        (
            words,
            measured(check.mean_nees_over_6, one, decimals),
            Interval(check.band_low, check.band_high, 2),
            check.verdict,
            check.reason,
        )
        for words, check in checks
    ]
    columns = (
        Column("Range"),
        Column("Mean NEES / 6", is_numeric=True),
        Column("Expected", is_numeric=True),
        Column("Stated covariance is"),
        Column("Because"),
    )
    return (Table("The stated covariance by range; 1 is honest, more is too sure of itself.", columns, tuple(rows)),)


def normalised(run: Run, table: ErrorTable, gantry_sigma_m: float) -> FloatArray:
    """Errors over their predicted standard deviations.

    Args:
        run: The run; its samples hold the sensor's covariances.
        table: N captures with a pose.
        gantry_sigma_m: Standard deviation per axis of the carriage position, m.

    Returns:
        Shape (N, 6): rotation about camera x, y, z, then translation; NaN where a covariance is missing.
    """
    covariances = {
        (sample.station, sample.t_ns): sample.outcome.covariance
        for sample in run.samples
        if isinstance(sample.outcome, PoseEstimate)
    }
    unknown = np.full((6, 6), np.nan)
    z = np.full((table.count, 6), np.nan)
    for i in range(table.count):
        C = covariances.get((int(table.station[i]), int(table.t_ns[i])), unknown)
        # The covariance is of the left tangent; the translation error itself is v + omega x t.
        x, y, depth = table.predicted_t_m[i]
        J = np.eye(6)
        J[3:, :3] = np.array([[0.0, depth, -y], [-depth, 0.0, x], [y, -x, 0.0]])
        F = table.registration_factor[i]
        variance = np.diag(J @ C @ J.T + F @ F.T) + np.repeat([0.0, gantry_sigma_m**2], 3)
        error = np.concatenate([table.rotation_error_rad[i], table.translation_error_m[i]])
        z[i] = np.where(variance > 0.0, error / np.sqrt(np.where(variance > 0.0, variance, 1.0)), np.nan)
    return z


def _components(z: FloatArray, key: str, names: tuple[str, ...], what: str) -> Figure:
    z = z[np.isfinite(z).all(axis=1)]
    spread = z.std(axis=0) if len(z) else np.full(3, np.nan)
    beyond = int((np.abs(z) > _SHOWN_SIGMAS).sum())
    alt = (
        f"Normalised {what} errors of {len(z)} captures against the standard normal law. "
        + "; ".join(f"{n}: standard deviation {spread[k]:.2f} (1 expected)" for k, n in enumerate(names))
        + f". {beyond} values lie beyond {_SHOWN_SIGMAS:g} and are counted in the outermost bars."
    )
    with style(key):
        figure, axes = plain_axes()
        edges = np.linspace(-_SHOWN_SIGMAS, _SHOWN_SIGMAS, _bars(len(z)) + 1)
        for k, name in enumerate(names):
            clipped = np.clip(z[:, k], edges[0] + 1e-9, edges[-1] - 1e-9)
            bars: dict[str, Any] = {"bins": edges, "density": True, "histtype": "step", "lw": 1.5}
            axes.hist(clipped, color=SERIES[k], label=name, **bars)
        grid = np.linspace(-_SHOWN_SIGMAS, _SHOWN_SIGMAS, 201)
        axes.plot(grid, np.exp(-0.5 * grid**2) / np.sqrt(2.0 * np.pi), "--", color=INK, lw=1.2, label="N(0, 1)")
        axes.set_xlabel(f"{what} error / predicted standard deviation")
        axes.set_ylabel("density")
        legend_above(axes, 4)
        svg = svg_of(figure, key, alt)
    caption = f"Normalised {what} errors of the held-out captures; dashed: the law they should follow."
    return Figure(key, svg, alt, caption, tuple(series(n, "1", z[:, k]) for k, n in enumerate(names)))


def _nees(nees: FloatArray) -> Figure:
    key = "nees"
    mean = float(nees.mean()) if len(nees) else float("nan")
    above = float((nees > _POINT_95).mean()) if len(nees) else float("nan")
    alt = (
        f"NEES of {len(nees)} captures against the chi-squared law of {_DEGREES_OF_FREEDOM} degrees of freedom: mean "
        f"{mean:.2f} ({_DEGREES_OF_FREEDOM} expected), {100 * above:.1f} % above its 95 % point (5 % expected)."
    )
    with style(key):
        figure, axes = plain_axes()
        reach = 30.0
        edges = np.linspace(0.0, reach, _bars(len(nees)) + 1)
        bars: dict[str, Any] = {"bins": edges, "density": True, "color": SERIES[0], "alpha": 0.65}
        axes.hist(np.clip(nees, 0.0, reach - 1e-9), label="held-out captures", **bars)
        grid = np.linspace(0.0, reach, 301)
        # Source: the chi-squared density of 6 degrees of freedom, x^2 exp(-x/2) / 16.
        axes.plot(grid, grid**2 * np.exp(-0.5 * grid) / 16.0, "--", color=INK, lw=1.2, label="predicted")
        axes.set_xlabel("NEES (last bar: this and more)")
        axes.set_ylabel("density")
        legend_above(axes, 2)
        svg = svg_of(figure, key, alt)
    caption = "Squared error over the whole predicted covariance, which also knows the correlations."
    return Figure(key, svg, alt, caption, (series("nees", "1", nees),))


def _nees_by_range(table: ErrorTable) -> Figure:
    key = "nees-range"
    order = np.argsort(table.range_m, kind="stable")
    near, far = (float(half.mean()) if len(half) else float("nan") for half in np.array_split(table.nees[order], 2))
    alt = (
        f"NEES of {table.count} captures against range: mean {near:.2f} in the nearer half, "
        f"{far:.2f} in the farther half ({_DEGREES_OF_FREEDOM} expected in both)."
    )
    with style(key):
        figure, axes = plain_axes()
        shown = thinned(table.count)
        draw_marks(
            axes, np.stack([table.range_m, table.nees])[:, shown], "o", colour=SERIES[0], alpha=0.75, label="captures"
        )
        axes.axhline(_DEGREES_OF_FREEDOM, ls="--", color=INK, lw=1.2, label="expected mean")
        axes.axhline(_POINT_95, ls=":", color=INK, lw=1.2, label="expected 95 % point")
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel("range to the beacon (m)")
        axes.set_ylabel("NEES")
        legend_above(axes, 3)
        svg = svg_of(figure, key, alt)
    caption = "Honesty of the covariance over range: marks should scatter about the dashed line everywhere."
    return Figure(key, svg, alt, caption, (series("range", "m", table.range_m), series("nees", "1", table.nees)))


def _bars(count: int) -> int:
    """Number of bars for so many values (Rice's rule, within reason)."""
    return int(np.clip(2.0 * np.cbrt(count), 18, 40))
