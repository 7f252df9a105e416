"""Captures without a pose: how many, why, and what they looked like."""

from __future__ import annotations

import numpy as np

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Block, Column, Gallery, Paragraph, Picture, Section, Table
from uvgs_bench.report.pictures import overlay_png, read_picture
from uvgs_bench.sensor.outcome import Miss
from uvgs_bench.store.run import Run, Sample

_LISTED = 20
_PICTURED = 12


def build(run: Run, judgement: Judgement) -> Section | None:
    """Misses by reason, the first ones in detail, and pictures where they were kept."""
    availability = judgement.availability
    title = "Misses"
    misses = [(s, s.outcome) for s in run.samples if isinstance(s.outcome, Miss)]
    if not misses:
        text = f"None: each of the {availability.attempted} captures gave a pose."
        return Section("misses", title, (Paragraph(text),))
    reasons = tuple(
        (*_split(reason), Number(count, 0), Number(100.0 * count / max(availability.attempted, 1), 1, "%"))
        for reason, count in availability.reasons.items()
    )
    counted = (
        Column("Stage"),
        Column("Reason"),
        Column("Captures", is_numeric=True),
        Column("Of all captures", is_numeric=True),
    )
    blocks: list[Block] = [Table("Misses by reason, over all captures of the run.", counted, reasons)]
    listed = (Column("Sample"), Column("Station"), Column("Carriage"), Column("Reason"), Column("Detail"))
    rows = tuple(_row(run, sample, miss) for sample, miss in misses[:_LISTED])
    more = f"; {len(misses) - _LISTED} more are in the run's journal" if len(misses) > _LISTED else ""
    blocks.append(Table(f"The first {len(rows)} misses{more}.", listed, rows))
    pictures = tuple(p for sample, miss in misses if (p := _picture(run, sample, miss)) is not None)[:_PICTURED]
    if pictures:
        blocks.append(Gallery(pictures))
    return Section("misses", title, tuple(blocks))


def _split(reason: str) -> tuple[str, str]:
    stage, _, word = reason.partition("/")
    return stage, word.replace("_", " ")


def _row(run: Run, sample: Sample, miss: Miss) -> tuple[Cell, ...]:
    where = ", ".join(
        f"{axis.name} {axis.described(float(q))}" for axis, q in zip(run.manifest.axes, sample.position, strict=False)
    )
    return str(sample.index), str(sample.station), where, f"{miss.stage}: {miss.reason.replace('_', ' ')}", miss.detail


def _picture(run: Run, sample: Sample, miss: Miss) -> Picture | None:
    if not sample.capture_file:
        return None
    image = read_picture(run.path / sample.capture_file)
    if image is None:
        return None
    nothing = np.empty((0, 2))
    words = f"{miss.stage}, {miss.reason.replace('_', ' ')}"
    return Picture(
        f"miss-{sample.index}",
        overlay_png(image, nothing, nothing, ()),
        f"Whole capture of sample {sample.index}, which gave no pose: {words}; {miss.blob_count} candidate blobs.",
        f"Sample {sample.index}, station {sample.station}: {words}.",
    )
