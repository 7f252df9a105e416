"""What may be wrong with the bench: ranked suspects, or the plain word that nothing stands out."""

from __future__ import annotations

import numpy as np

from uvgs_bench.accuracy.diagnosis import LEAST_VISITS, Suspect
from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.accuracy.suspects import SightLimit
from uvgs_bench.report.cells import Cell, Interval, Measured, Number, decimals_for
from uvgs_bench.report.document import Block, Column, Definitions, Paragraph, Section, Table
from uvgs_bench.store.run import Run
from uvgs_bench.units import mm_from_m

_LEAST_SHOWN = 1e-4


def build(run: Run, judgement: Judgement) -> Section | None:
    """Suspects with evidence and the check that would confirm each."""
    title = "Diagnosis"
    if judgement.registration is None and not judgement.diagnosis:
        text = (
            "Not diagnosed: without a registration there are no errors whose pattern could be held against known "
            "causes. The alerts say what the registration needs."
        )
        return Section("diagnosis", title, (Paragraph(text),))
    visits = len({sample.station for sample in run.samples if sample.is_solved})
    if visits < LEAST_VISITS and not judgement.diagnosis:
        text = f"Not diagnosed: {visits} stations have a pose, at least {LEAST_VISITS} are needed to tell causes apart."
        return Section("diagnosis", title, (Paragraph(text),))
    if not judgement.diagnosis:
        text = (
            f"Nothing stands out: the residuals at {visits} stations fit no known cause better than chance would in "
            "one clean run of twenty. A cause that the registration absorbs whole cannot be seen here."
        )
        return Section("diagnosis", title, (Paragraph(text), *_sight(judgement.sight_limits)))
    text = (
        "Residuals were held against the signatures of known causes. These stand out, likeliest first. A suspect is "
        "no proof: each comes with the check that would confirm it. Chance is that of such residuals on a clean bench, "
        "all causes tested taken together."
    )
    columns = (
        Column("Suspect"),
        Column("Size", is_numeric=True),
        Column("Adds to position", "mm", True),
        Column("Chance", is_numeric=True),
        Column("Evidence"),
        Column("Check"),
    )
    rows = tuple(_row(suspect) for suspect in judgement.diagnosis)
    caption = "Suspects, the likeliest first, with the size they would have and its 95 % interval."
    blocks: list[Block] = [Paragraph(text), Table(caption, columns, rows)]
    like = tuple(
        (f"Suspect {s.rank}", f"These data cannot tell it from: {'; '.join(s.alternatives)}.")
        for s in judgement.diagnosis
        if s.alternatives
    )
    if like:
        blocks.append(Definitions(like))
    blocks += _sight(judgement.sight_limits)
    return Section("diagnosis", title, tuple(blocks))


def _sight(limits: tuple[SightLimit, ...]) -> tuple[Block, ...]:
    """What silence about a cause means: how large it would have to be."""
    if not limits:
        return ()
    rows: list[tuple[Cell, ...]] = []
    for limit in limits:
        is_seen = np.isfinite(limit.least)
        least = Number(limit.least, decimals_for([0.1 * limit.least]), limit.unit)
        rows.append((_capital(limit.title), least if is_seen else "cannot be seen in this run, whatever its size"))
    columns = (Column("Cause"), Column("Named 19 times of 20 from", is_numeric=True))
    caption = "How large a cause alone on a clean bench would have to be for a run like this one to name it."
    return (Table(caption, columns, tuple(rows)),)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _row(s: Suspect) -> tuple[Cell, ...]:
    decimals = decimals_for([0.5 * (s.high - s.low)])
    size = Measured(Number(s.estimate, decimals, s.unit), Interval(s.low, s.high, decimals, s.unit))
    effect = mm_from_m(s.effect_position_m) if np.isfinite(s.effect_position_m) else None
    chance: Cell = f"< {_LEAST_SHOWN:g}" if s.p_value < _LEAST_SHOWN else Number(s.p_value, 4)
    return f"{s.rank}. {s.title}", size, Number(effect, 3, "mm"), chance, s.evidence, s.check
