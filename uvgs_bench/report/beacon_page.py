"""Reports about a beacon: what was measured, what may be expected of it, and a picture of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from uvgs_bench import __version__
from uvgs_bench.beacon import Beacon
from uvgs_bench.errors import ConfigError
from uvgs_bench.report.beacon_drawing import draw_view, views_of
from uvgs_bench.report.beacon_evidence import ForecastEvidence, MeasurementEvidence
from uvgs_bench.report.cells import Interval, Number, State, decimals_for
from uvgs_bench.report.chapters import built_sections
from uvgs_bench.report.document import Alert, Document, KeyFigure
from uvgs_bench.report.figures import label_of, style
from uvgs_bench.report.sections import FORECAST_SECTIONS, MEASUREMENT_SECTIONS
from uvgs_bench.units import deg_from_rad, mm_from_m

# Normal law: two-sided 95 %.
_NORMAL_95 = 1.96


def build_measurement_document(evidence: MeasurementEvidence) -> Document:
    """Build the report of a measured beacon. It depends on the evidence alone.

    Args:
        evidence: The measurement.

    Returns:
        The document.
    """
    m = evidence.measurement
    worst = max(m.distances, key=lambda d: d.sigma_m)
    off = max(m.leds, key=lambda led: led.deviation_m)
    decimals = decimals_for([_NORMAL_95 * mm_from_m(worst.sigma_m)], default=3)
    value_mm, half_mm = mm_from_m(worst.distance_m), _NORMAL_95 * mm_from_m(worst.sigma_m)
    interval = Interval(value_mm - half_mm, value_mm + half_mm, decimals, "mm")
    figures = (
        KeyFigure(
            "Least certain distance", Number(value_mm, decimals, "mm"), interval, f"{worst.first} to {worst.second}"
        ),
        KeyFigure("Its deviation, 1 sigma", Number(mm_from_m(worst.sigma_m), 4, "mm")),
        KeyFigure("Farthest off nominal", Number(mm_from_m(off.deviation_m), 3, "mm"), note=f"LED {off.name}"),
        KeyFigure("Centroid noise per axis", Number(m.sigma_px, 3, "px"), note="as found from the residuals"),
        KeyFigure("Views", Number(m.view_count, 0), note=f"{evidence.named} of {evidence.captures} pictures named"),
    )
    said = (
        f"The least certain distance, {worst.first} to {worst.second}, is known to ± {mm_from_m(worst.sigma_m):.4f} mm"
    )
    return Document(
        title=f"Measured beacon {m.beacon.name}",
        subtitle=f"{len(m.beacon.leds)} LEDs, by {m.by}, {m.view_count} views",
        created_utc=evidence.created_utc,
        verdict="inconclusive" if m.warnings else "none",
        headline=f"{said} (1 sigma). Scale: {m.scale_source}. Frame: {m.gauge}.",
        banners=tuple(Alert("warning", text) for text in m.warnings),
        key_figures=figures,
        sections=built_sections(MEASUREMENT_SECTIONS, evidence),
        provenance=_provenance(m.beacon, evidence.notes),
        genre="beacon report",
        subject="measurement",
        verdict_word="measured, with warnings" if m.warnings else "measured",
    )


def build_forecast_document(evidence: ForecastEvidence) -> Document:
    """Build the report of what a beacon can do with a camera. It depends on the evidence alone.

    Args:
        evidence: The forecast.

    Returns:
        The document.
    """
    found = evidence.found
    state: State = "pass"
    word, headline = "sound", "Labels are told apart at every range and view looked at, and no LEDs merge."
    if evidence.warnings:
        state, word = "fail", "weak"
        headline = "; ".join(warning.text for warning in evidence.warnings) + "."
    elif not evidence.is_safe:
        state, word = "inconclusive", "ambiguous in places"
        headline = "At some ranges and views labels are not told apart safely, or LEDs merge: see the findings."
    position_mm = float(mm_from_m(np.nanmax(found.position_sigma_m)))
    attitude_deg = float(deg_from_rad(np.nanmax(found.attitude_sigma_rad)))
    margin = Number(float(np.nanmin(found.margin_px)), 3, "px")
    figures = (
        KeyFigure("Position, worst view", Number(position_mm, 3, "mm"), note="1 sigma"),
        KeyFigure("Attitude, worst view", Number(attitude_deg, 3, "deg"), note="1 sigma"),
        KeyFigure("Nearest other labels", margin, note="RMS residual of the best wrong labels"),
        KeyFigure("Centroid noise assumed", Number(evidence.sigma_px, 3, "px"), note="per axis, 1 sigma"),
    )
    near, far = float(found.range_m[0]), float(found.range_m[-1])
    return Document(
        title=f"Forecast of beacon {evidence.beacon.name}",
        subtitle=f"{len(evidence.beacon.leds)} LEDs, {near:g} to {far:g} m, tilts to "
        f"{deg_from_rad(float(found.tilt_rad[-1])):.0f} deg",
        created_utc="",
        verdict=state,
        headline=f"{headline[0].upper()}{headline[1:]}",
        banners=(),
        key_figures=figures,
        sections=built_sections(FORECAST_SECTIONS, evidence),
        provenance=_provenance(evidence.beacon, evidence.notes),
        genre="beacon report",
        subject="forecast",
        verdict_word=word,
    )


def _provenance(beacon: Beacon, notes: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    return (("beacon", beacon.name), *notes.items(), ("report made by", f"uvgs_bench {__version__}"))


def write_beacon_picture(path: Path, beacon: Beacon) -> None:
    """Draw LEDs and frame, from the front and from the side.

    Args:
        path: PNG, PDF or SVG file.
        beacon: The beacon.

    Raises:
        ConfigError: The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if path.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise ConfigError("expected a .png, .pdf or .svg file", str(path))
    with style(f"beacon-{beacon.name}"):
        figure = Figure(figsize=(10.0, 4.6), layout="constrained")
        FigureCanvasAgg(figure)
        for axes, (_, pair, words) in zip(figure.subplots(1, 2), views_of(beacon), strict=True):
            draw_view(axes, beacon, pair)
            axes.set_title(words)
        figure.suptitle(label_of(_title(beacon), 90))
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            figure.savefig(path, dpi=110, facecolor="white")
        except OSError as error:
            raise ConfigError(f"cannot be written: {error.strerror or error}", str(path)) from None


def _title(beacon: Beacon) -> str:
    if beacon.covariance_m2 is None:
        return f"{beacon.name}: not measured"
    worst = float(np.sqrt(np.diag(beacon.covariance_m2).max()))
    return f"{beacon.name}: measured, coordinates within ± {mm_from_m(worst):.3f} mm (1 sigma)"
