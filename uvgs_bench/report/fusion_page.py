"""The report of a fusion."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from uvgs_bench import __version__
from uvgs_bench.navigation.fusion_outcome import FusionOutcome
from uvgs_bench.report.cells import Number, State
from uvgs_bench.report.chapters import built_sections
from uvgs_bench.report.document import Alert, Document, KeyFigure
from uvgs_bench.report.sections import FUSION_SECTIONS
from uvgs_bench.units import deg_from_rad, mm_from_m

_WORDS = {"filter": "error-state filter", "graph": "factor graph", "ar_swap": "poses alone, as in the AR pipeline"}


def build_fusion_document(outcome: FusionOutcome, notes: Mapping[str, str]) -> Document:
    """Build the report of a fusion. It depends on the outcome and the notes alone.

    Args:
        outcome: The fusion with what is beside it.
        notes: Name and value of what the numbers depend on.

    Returns:
        The document.
    """
    main, source = outcome.main, outcome.source
    state: State = "inconclusive" if outcome.problems else "none"
    said = "; ".join(outcome.problems)
    headline = f"{said[0].upper()}{said[1:]}." if said else _headline(outcome)
    kinds = [Alert("warning", f"{text[0].upper()}{text[1:]}.") for text in outcome.problems]
    kinds += [
        Alert("info", text if text.endswith(".") else f"{text[0].upper()}{text[1:]}.") for text in outcome.remarks
    ]
    return Document(
        title=f"Fusion: {source.name}",
        subtitle=f"{_WORDS[main.result.method]}; {source.words}",
        created_utc="",
        verdict=state,
        headline=headline,
        banners=tuple(kinds),
        key_figures=_figures(outcome),
        sections=built_sections(FUSION_SECTIONS, outcome),
        provenance=_provenance(outcome, notes),
        genre="fusion report",
        subject="fusion",
        verdict_word="does not fit" if outcome.problems else "fused",
    )


def _headline(outcome: FusionOutcome) -> str:
    main, alone = outcome.main.score, [run for run in outcome.runs if run.name == "native alone"]
    if not len(main.error):
        return "The truth is not known: only consistency and continuity are judged."
    text = f"Fused to {mm_from_m(main.position_rms_m):.2f} mm RMS, {mm_from_m(main.worst_m):.1f} mm at worst"
    if alone and len(alone[0].score.error):
        text += f"; the native localiser alone errs by up to {mm_from_m(alone[0].score.worst_m):.0f} mm"
    return f"{text}."


def _figures(outcome: FusionOutcome) -> tuple[KeyFigure, ...]:
    score, raw = outcome.main.score, outcome.raw
    nis = np.concatenate(list(score.nis.values())) if score.nis else np.empty(0)
    nis = nis[np.isfinite(nis)]
    found = []
    if len(score.error):
        found = [
            KeyFigure("Position, RMS", Number(mm_from_m(score.position_rms_m), 2, "mm"), note="against the truth"),
            KeyFigure("Position, worst", Number(mm_from_m(score.worst_m), 1, "mm")),
            KeyFigure("Attitude, RMS", Number(deg_from_rad(score.attitude_rms_rad), 3, "deg")),
        ]
    if len(nis):
        found.append(KeyFigure("Mean NIS", Number(float(nis.mean()), 1), note="6 expected"))
    found.append(KeyFigure("Sensor silent at most", Number(raw.silent_s, 1, "s")))
    return tuple(found)


def _provenance(outcome: FusionOutcome, notes: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    source = outcome.source
    n = source.noise
    unit = (
        f"{n.acceleration_noise_mps2_rthz:g} m/s²/√Hz, {n.rate_noise_radps_rthz:g} rad/s/√Hz; walks "
        f"{n.acceleration_walk_mps3_rthz:g} m/s³/√Hz, {n.rate_walk_radps2_rthz:g} rad/s²/√Hz"
    )
    gravity = ", ".join(f"{v:g}" for v in source.gravity_mps2)
    return (
        ("source", source.name),
        ("method", outcome.main.result.method),
        ("inertial unit", f"{source.imu.rate_hz:.0f} Hz, {unit}" if len(source.imu) > 1 else "none"),
        ("gravity", f"({gravity}) m/s², world axes"),
        *notes.items(),
        ("report made by", f"uvgs_bench {__version__}"),
    )
