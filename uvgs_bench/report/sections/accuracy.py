"""The tables of errors: held out, next to in-sample, and what repeating tells apart."""

from __future__ import annotations

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.accuracy.statistics import AccuracySummary, ComponentStatistics, Estimate
from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Block, Column, Paragraph, Section, Table
from uvgs_bench.report.quantities import (
    COMPONENT_WORDS,
    SCALES,
    Scale,
    decimals_of,
    measured,
)
from uvgs_bench.store.run import Run

_POSITION = ("lateral_x", "lateral_y", "depth", "lateral", "position")
_MAGNITUDES = ("lateral", "depth", "position", "attitude")
_ATTITUDE = ("tilt_x", "tilt_y", "roll", "attitude")
_STATISTICS = {
    "Bias": "bias",
    "Spread": "spread",
    "RMS": "rms",
    "Median": "median",
    "95th perc.": "p95",
    "Largest": "max",
}


def build(run: Run, judgement: Judgement) -> Section | None:
    """Statistics of the errors with their intervals."""
    del run
    title = "Accuracy"
    summary = judgement.summary
    if summary is None:
        text = "There are no judged errors in this run; the alerts above say why."
        return Section("accuracy", title, (Paragraph(text),))
    blocks: list[Block] = [Paragraph(_introduction(summary))]
    for names, what in ((_POSITION, "Position"), (_ATTITUDE, "Attitude")):
        blocks.append(
            _statistics_table(
                summary,
                names,
                f"{what} error, held-out stations, 95 % interval below each figure; the largest seen has none.",
            )
        )
    blocks.append(_repeatability_table(summary))
    if judgement.in_sample_summary is not None:
        blocks.append(_comparison_table(judgement.in_sample_summary, summary))
    blocks.append(_context_table(summary, judgement))
    open_rows = tuple((COMPONENT_WORDS[c.name], notes) for c in _chosen(summary, _MAGNITUDES) if (notes := _notes(c)))
    if open_rows:
        columns = (Column("Component"), Column("Because"))
        blocks.append(Table("Why some intervals are open or missing; single axes likewise.", columns, open_rows))
    return Section("accuracy", title, tuple(blocks))


def _notes(statistics: ComponentStatistics) -> str:
    """Each reason once, after the names of the figures it holds for."""
    names: dict[str, list[str]] = {}
    for label, field in {**_STATISTICS, "Within": "within_station", "Between": "between_stations"}.items():
        estimate: Estimate = getattr(statistics, field)
        if estimate.note:
            names.setdefault(estimate.note, []).append(label)
    return "; ".join(f"{', '.join(labels)}: {note}" for note, labels in names.items())


def _introduction(summary: AccuracySummary) -> str:
    moving = ""
    if summary.moving_count:
        worth = summary.components["position"].rms.effective_count
        moving = (
            f" {summary.moving_count} captures were taken in motion: those that follow one another share errors, so "
            f"they count by {summary.block_count} blocks of time that are independent, not as stations. All captures "
            f"together are worth {worth:.0f} independent ones."
        )
    return (
        f"{summary.capture_count} captures at {summary.extent} that took no part in the registration, "
        f"{summary.range_min_m:.3f} m to {summary.range_max_m:.3f} m from the camera. Errors are observed minus "
        "expected, in camera axes. Intervals come from resampling whole stations: captures of one station are not "
        f"independent.{moving}"
    )


def _chosen(summary: AccuracySummary, names: tuple[str, ...]) -> list[ComponentStatistics]:
    return [summary.components[name] for name in names if name in summary.components]


def _statistics_table(summary: AccuracySummary, names: tuple[str, ...], caption: str) -> Table:
    chosen = _chosen(summary, names)
    scale = SCALES[chosen[0].unit]
    decimals = decimals_of([c.rms for c in chosen], scale.factor)
    columns = (Column("Component"), *(Column(label, scale.unit, True) for label in _STATISTICS))
    rows: list[tuple[Cell, ...]] = []
    for c in chosen:
        figures = [measured(getattr(c, field), scale, decimals) for field in _STATISTICS.values() if field != "max"]
        rows.append((COMPONENT_WORDS[c.name], *figures, Number(c.max.value * scale.factor, decimals, scale.unit)))
    return Table(caption, columns, tuple(rows))


def _repeatability_table(summary: AccuracySummary) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name in _MAGNITUDES:
        for c in _chosen(summary, (name,)):
            scale = SCALES[c.unit]
            decimals = decimals_of([c.within_station, c.between_stations], scale.factor)
            pair = (measured(e, scale, decimals) for e in (c.within_station, c.between_stations))
            rows.append((COMPONENT_WORDS[name], *pair))
    caption = "Repeatability: what repeating a capture averages away, and what it does not."
    columns = (
        Column("Component"),
        Column("Within a station", is_numeric=True),
        Column("Between stations", is_numeric=True),
    )
    return Table(caption, columns, tuple(rows))


def _comparison_table(in_sample: AccuracySummary, held_out: AccuracySummary) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name in _MAGNITUDES:
        if name not in in_sample.components or name not in held_out.components:
            continue
        fitted, judged = in_sample.components[name].rms, held_out.components[name].rms
        scale = SCALES[held_out.components[name].unit]
        decimals = decimals_of([judged, fitted], scale.factor)
        pair = (measured(e, scale, decimals) for e in (fitted, judged))
        rows.append((f"{COMPONENT_WORDS[name]}, RMS", *pair))
    caption = (
        f"Why stations are held out: the same errors on the {in_sample.station_count} stations the registration was "
        f"fitted on (optimistic, never judged) and on the {held_out.station_count} others."
    )
    columns = (Column("Component"), Column("In sample", is_numeric=True), Column("Held out", is_numeric=True))
    return Table(caption, columns, tuple(rows))


def _context_table(summary: AccuracySummary, judgement: Judgement) -> Table:
    availability, percent = judgement.availability, SCALES["percent"]
    mm, deg = SCALES["m"], SCALES["rad"]
    nees = summary.consistency
    rows: tuple[tuple[Cell, ...], ...] = (
        ("Captures with a pose", _share(judgement, percent), f"{availability.solved} of {availability.attempted}"),
        (
            "Registration's own share of the position error",
            Number(summary.registration_share_m * mm.factor, 4, mm.unit),
            "root mean square; contained in the held-out errors",
        ),
        (
            "Registration's own share of the attitude error",
            Number(summary.registration_share_rad * deg.factor, 4, deg.unit),
            "root mean square; contained in the held-out errors",
        ),
        (
            "Further off than five times the usual distance",
            Number(summary.outlier_count, 0),
            "captures; counted, and included in every figure",
        ),
        (
            "Mean NEES / 6",
            measured(nees.mean_nees_over_6, SCALES["1"], decimals_of([nees.mean_nees_over_6], 1.0, 2)),
            f"expected {nees.band_low:.2f} … {nees.band_high:.2f}: {nees.verdict}, {nees.reason}",
        ),
    )
    columns = (Column("Also"), Column("Value", is_numeric=True), Column("Meaning"))
    return Table("Availability, the registration's share, outliers, and honesty of the covariance.", columns, rows)


def _share(judgement: Judgement, percent: Scale) -> Cell:
    fraction = judgement.availability.fraction
    return measured(fraction, percent, decimals_of([fraction], percent.factor, 1))
