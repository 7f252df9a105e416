"""From a run and its judgement to a document: banners, headline, key figures, chapters in the order of their table."""

from __future__ import annotations

import re

from uvgs_bench import __version__
from uvgs_bench.accuracy.judgement import Judgement, LimitVerdict
from uvgs_bench.report.cells import Interval, Number
from uvgs_bench.report.chapters import built_sections
from uvgs_bench.report.document import Alert, Document, KeyFigure
from uvgs_bench.report.quantities import SCALES, decimals_of, limit_reason, stations_taken
from uvgs_bench.report.sections import SECTIONS
from uvgs_bench.store.run import Run

_KEY_FIGURES = (
    ("Position, RMS", "position", "rms"),
    ("Position, 95th percentile", "position", "p95"),
    ("Lateral, RMS", "lateral", "rms"),
    ("Depth, RMS", "depth", "rms"),
    ("Attitude, RMS", "attitude", "rms"),
)


def build_document(run: Run, judgement: Judgement) -> Document:
    """Build the report of a run. It depends on run and judgement alone, never on the time of day.

    Args:
        run: The run, finished or not.
        judgement: What its errors amount to.

    Returns:
        The document.
    """
    m = run.manifest
    return Document(
        title=f"Accuracy of the uVGS-2 sensor, {m.procedure_name}",
        subtitle=m.id,
        created_utc=m.created_utc,
        verdict=judgement.verdict,
        headline=headline(judgement),
        banners=_banners(run),
        key_figures=_key_figures(judgement),
        sections=built_sections(SECTIONS, run, judgement),
        provenance=_provenance(run),
    )


def _banners(run: Run) -> tuple[Alert, ...]:
    banners: list[Alert] = []
    if run.manifest.simulated:
        text = "SIMULATED BENCH. Camera or gantry are software: these figures say nothing about a real sensor."
        banners.append(Alert("warning", text))
    if run.ended != "completed":
        taken, planned = stations_taken(run), run.manifest.station_count
        how = {"interrupted": "was interrupted", "failed": "failed"}.get(run.ended, "has no recorded end")
        reason = f": {run.end_reason}" if run.end_reason else ""
        text = f"INCOMPLETE. This run {how} after {taken} of {planned} stations{reason}. It is judged on what there is."
        banners.append(Alert("danger", text))
    if run.seams:
        often = "once" if len(run.seams) == 1 else f"{len(run.seams)} times"
        text = f"This run was resumed {often}; the reference checks are in the set-up chapter."
        banners.append(Alert("info", text))
    accepted = sorted({name for seam in run.seams for name in seam.accepted})
    if accepted:
        text = f"CHANGED WITHIN THE RUN and accepted by its user: {', '.join(accepted)}. Its parts are not alike."
        banners.append(Alert("warning", text))
    return tuple(banners)


def headline(judgement: Judgement) -> str:
    """The verdict as one sentence that names the limits it hangs on."""
    verdicts = judgement.verdicts
    if judgement.summary is None:
        why = next((alert.text for alert in judgement.alerts if alert.level == "error"), "there are no judged errors")
        return f"No accuracy can be stated: {why}"
    if not verdicts:
        return "The procedure sets no limits; the figures below are stated without a verdict."
    if judgement.verdict == "pass":
        return f"All {len(verdicts)} limits are met with 95 % confidence."
    chosen = [v for v in verdicts if v.verdict == judgement.verdict]
    if not chosen:
        return "Every limit alone is met, but the run as a whole cannot be judged; the alerts say why."
    said = "; ".join(_short(v) for v in chosen)
    word = "cannot be decided"
    if judgement.verdict == "fail":
        word = "is missed" if len(chosen) == 1 else "are missed"
    return f"{len(chosen)} of {len(verdicts)} limits {word}: {said}."


def _short(verdict: LimitVerdict) -> str:
    return f"{verdict.limit.quantity.rsplit('_', 1)[0].replace('_', ' ')} ({limit_reason(verdict).rstrip('.')})"


def _key_figures(judgement: Judgement) -> tuple[KeyFigure, ...]:
    figures: list[KeyFigure] = []
    if judgement.summary is not None:
        for label, component, statistic in _KEY_FIGURES:
            if component not in judgement.summary.components:
                continue
            statistics = judgement.summary.components[component]
            estimate, scale = getattr(statistics, statistic), SCALES[statistics.unit]
            shown, decimals = estimate.scaled(scale.factor), decimals_of([statistics.rms], scale.factor)
            note = f"{judgement.summary.extent}, {estimate.capture_count} captures"
            interval = Interval(shown.low, shown.high, decimals, scale.unit)
            figures.append(KeyFigure(label, Number(shown.value, decimals, scale.unit), interval, note))
    a, percent = judgement.availability, SCALES["percent"]
    fraction = a.fraction.scaled(percent.factor)
    interval = Interval(fraction.low, fraction.high, 1, percent.unit)
    note = f"{a.solved} of {a.attempted} captures"
    figures.append(KeyFigure("Availability", Number(fraction.value, 1, percent.unit), interval, note))
    return tuple(figures)


def _in_counting_order(item: tuple[str, str]) -> list[tuple[int, str]]:
    """$2 before $10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", item[0])]


def _provenance(run: Run) -> tuple[tuple[str, str], ...]:
    m = run.manifest
    return (
        ("run", m.id),
        ("created (UTC)", m.created_utc),
        ("ended (UTC)", run.ended_utc or "not recorded"),
        ("simulated", "yes" if m.simulated else "no"),
        ("seed", str(m.seed)),
        ("plan hash", m.plan_hash),
        ("camera", m.camera_spec),
        ("gantry", m.gantry_spec),
        ("report made by", f"uvgs_bench {__version__}"),
        *((f"version: {name}", text) for name, text in sorted(m.versions.items())),
        *((f"SHA-256: {name}", text) for name, text in sorted(m.hashes.items())),
        *((f"controller: {name}", text) for name, text in sorted(m.gantry_info.items(), key=_in_counting_order)),
    )
