"""The report of a follow session."""

from __future__ import annotations

from typing import cast

from uvgs_bench import __version__
from uvgs_bench.report.cells import Number, State
from uvgs_bench.report.chapters import built_sections
from uvgs_bench.report.document import Alert, Document, KeyFigure
from uvgs_bench.report.follow_evidence import FollowEvidence, follow_evidence
from uvgs_bench.report.sections import FOLLOW_SECTIONS
from uvgs_bench.store.follow_runs import FollowRun
from uvgs_bench.units import mm_from_m, percent_from_fraction


def build_follow_document(run: FollowRun) -> Document:
    """Build the report of a follow session. It depends on the session alone.

    Args:
        run: The session, finished or not.

    Returns:
        The document.
    """
    evidence = follow_evidence(run)
    q, manifest = evidence.quality, run.manifest
    borne_s, has_s = evidence.fact("margins", "largest_latency_s"), evidence.fact("margins", "latency_s")
    spare_s = None if borne_s is None or has_s is None else borne_s - has_s
    figures = (
        KeyFigure("Steady error, worst", Number(mm_from_m(q.steady_worst_m), 1, "mm"), note="leader calm for long"),
        KeyFigure("Tracking error, RMS", Number(mm_from_m(q.rms_m), 1, "mm"), note="from first in tolerance on"),
        KeyFigure(
            "Overshoot, worst",
            Number(None if q.overshoot_m is None else mm_from_m(q.overshoot_m), 1, "mm"),
            note="past a stop of the leader",
        ),
        KeyFigure("Time in tolerance", Number(percent_from_fraction(q.in_tolerance), 1, "%")),
        KeyFigure("Latency to spare", Number(spare_s, 3, "s"), note="until the loop is unstable"),
    )
    description = f"{manifest.name}, {manifest.plant}, {q.capture_count} captures"
    return Document(
        title=f"Following a leader: {manifest.name}",
        subtitle=description,
        created_utc=manifest.created_utc,
        verdict=cast(State, evidence.verdict),
        headline=f"{evidence.headline[0].upper()}{evidence.headline[1:]}.",
        banners=_banners(evidence),
        key_figures=figures,
        sections=built_sections(FOLLOW_SECTIONS, evidence),
        provenance=_provenance(run),
        genre="follow report",
        subject="session",
    )


def _banners(evidence: FollowEvidence) -> tuple[Alert, ...]:
    run, found = evidence.run, []
    radius = evidence.fact("margins", "spectral_radius")
    if radius is not None and radius >= 1.0:
        found.append(
            Alert(
                "danger", "At the latency it had, the loop is unstable: every figure here depends on how long it ran."
            )
        )
    if run.ending != "completed":
        found.append(Alert("warning", f"The session was {run.ending or 'cut off'}: {run.reason or 'no reason known'}."))
    if run.manifest.facts.get("is_simulated", True):
        found.append(Alert("info", "Simulated: leader, follower and camera; the sensor and the law are the real ones."))
    if faults := run.manifest.facts.get("faults"):
        found.append(Alert("info", f"Planted faults: {faults}."))
    return tuple(found)


def _provenance(run: FollowRun) -> tuple[tuple[str, str], ...]:
    facts = run.manifest.facts
    named = [(name, str(facts[name])) for name in ("bench", "camera", "beacon") if name in facts]
    versions = facts.get("versions")
    made = [(name, str(value)) for name, value in versions.items()] if isinstance(versions, dict) else []
    return (*named, ("seed", str(run.manifest.seed)), *made, ("report made by", f"uvgs_bench {__version__}"))
