"""From a calibration to a document: verdict, key figures, chapters in the order of their table."""

from __future__ import annotations

from uvgs_bench import __version__
from uvgs_bench.camera.calibration import Calibration, Verdict
from uvgs_bench.camera.verdict import WARN_HALVES_RATIO
from uvgs_bench.report.calibration_evidence import CalibrationEvidence
from uvgs_bench.report.cells import Interval, Number, State, decimals_for
from uvgs_bench.report.chapters import built_sections
from uvgs_bench.report.document import Alert, Document, KeyFigure
from uvgs_bench.report.sections import CALIBRATION_SECTIONS
from uvgs_bench.units import mrad_from_rad

# Normal law: two-sided 95 %.
_NORMAL_95 = 1.96
_STATES: dict[str, State] = {
    "usable": "pass",
    "usable_within_radius": "pass",
    "not_usable": "fail",
    "inconclusive": "inconclusive",
}


def build_calibration_document(evidence: CalibrationEvidence) -> Document:
    """Build the report of a calibration. It depends on the evidence alone, never on the time of day.

    Args:
        evidence: The calibration and what is known about it.

    Returns:
        The document.
    """
    calibration = evidence.calibration
    verdict = calibration.verdict
    lens = calibration.lens
    return Document(
        title=f"Calibration of camera {calibration.camera_name or 'without a name'}",
        subtitle=f"{lens.model}, {lens.width_px} × {lens.height_px} px, {calibration.view_count} views",
        created_utc=calibration.notes.get("created_utc", "an unrecorded time"),
        verdict="none" if verdict is None else _STATES[verdict.word],
        headline=_headline(verdict),
        banners=_banners(evidence),
        key_figures=_key_figures(evidence),
        sections=built_sections(CALIBRATION_SECTIONS, evidence),
        provenance=_provenance(calibration),
        genre="calibration report",
        subject="calibration",
        verdict_word="not judged" if verdict is None else _word(verdict),
    )


def _word(verdict: Verdict) -> str:
    if verdict.word == "usable_within_radius":
        return f"usable within {verdict.radius_px:.0f} px"
    return verdict.word.replace("_", " ")


def _headline(verdict: Verdict | None) -> str:
    if verdict is None:
        return "Nobody judged this calibration: the camera file carries no verdict."
    said = "; ".join(verdict.reasons) or "no reason is recorded"
    where = " The radius is counted from the principal point." if verdict.word == "usable_within_radius" else ""
    return f"{said[0].upper()}{said[1:]}.{where}"


def _banners(evidence: CalibrationEvidence) -> tuple[Alert, ...]:
    banners = []
    source = evidence.calibration.notes.get("source", "")
    if source.startswith("sim"):
        text = "SIMULATED CAMERA. The pictures were drawn by software: these figures say nothing about a real camera."
        banners.append(Alert("warning", text))
    if evidence.result is None:
        text = (
            "Made from the camera file alone. Residuals, coverage and the map of two halves need the pictures: "
            "calibrate again with --report."
        )
        banners.append(Alert("info", text))
    factor = evidence.too_small
    if factor is not None and factor > WARN_HALVES_RATIO:
        text = (
            f"Two halves of the pictures disagree {factor:.1f} times more than predicted. Verdict, interval and rows "
            "that say so count it; every other deviation on these pages is that much too small."
        )
        banners.append(Alert("warning", text))
    return tuple(banners)


def _key_figures(evidence: CalibrationEvidence) -> tuple[KeyFigure, ...]:
    calibration, result = evidence.calibration, evidence.result
    figures = []
    if calibration.verdict is not None and calibration.verdict.is_usable:
        note = "" if result is None else f"of {result.coverage.picture_radius_px:.0f} px that the picture reaches"
        figures.append(KeyFigure("Usable radius", Number(calibration.verdict.radius_px, 0, "px"), note=note))
    if calibration.sigmas is not None:
        factor = evidence.too_small
        value, half = calibration.lens.fx_px, _NORMAL_95 * float(calibration.sigmas[0]) * (factor or 1.0)
        decimals = decimals_for([half])
        interval = Interval(value - half, value + half, decimals, "px")
        note = "predicted; what halves say is not in the file" if result is None else "predicted; halves not compared"
        if factor is not None:
            note = f"predicted, times {factor:.2f} by the halves" if factor > 1.0 else "predicted; the halves agree"
        figures.append(KeyFigure("Focal length fx", Number(value, decimals, "px"), interval, note))
    if calibration.rms_px is not None:
        note = f"{calibration.corner_count} corners, {calibration.rejected_count} set aside"
        if result is not None:
            note += f"; {mrad_from_rad(result.structure.rms_rad):.3f} mrad"
        figures.append(KeyFigure("Residual, RMS of lengths", Number(calibration.rms_px, 4, "px"), note=note))
        per_axis = Number(calibration.rms_per_axis_px, 4, "px")
        figures.append(KeyFigure("Residual, RMS per axis", per_axis, note="the other convention: lengths / √2"))
    if calibration.held_out_rms_px is not None:
        note = "lengths, in pictures the lens was not fitted to"
        figures.append(KeyFigure("Held out, RMS of lengths", Number(calibration.held_out_rms_px, 4, "px"), note=note))
    if result is not None and result.split_half is not None:
        halves = result.split_half
        note = f"{halves.difference_px:.3f} px; 1 when the stated deviations are honest"
        figures.append(KeyFigure("Halves differ, over predicted", Number(halves.ratio, 2, "times"), note=note))
    return tuple(figures)


def _provenance(calibration: Calibration) -> tuple[tuple[str, str], ...]:
    lens = calibration.lens
    return (
        ("camera", calibration.camera_name or "not named"),
        ("lens model", lens.model),
        ("picture size", f"{lens.width_px} × {lens.height_px} px"),
        *((name.replace("_", " "), text) for name, text in calibration.notes.items()),
        ("report made by", f"uvgs_bench {__version__}"),
    )
