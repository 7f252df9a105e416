"""Chapters of a report, one file each, strangers to each other.

To add a section: 1. write ``sections/<name>.py`` with ``build(run, judgement) -> Section | None`` (None leaves it out);
2. add one line to ``SECTIONS`` where it is to be read; shared drawing belongs into ``report/figures.py``.
"""

SECTIONS: dict[str, str] = {
    "limits": "uvgs_bench.report.sections.limits:build",
    "setup": "uvgs_bench.report.sections.setup:build",
    "traceability": "uvgs_bench.report.sections.traceability:build",
    "accuracy": "uvgs_bench.report.sections.accuracy:build",
    "quantities": "uvgs_bench.report.sections.quantities:build",
    "motion": "uvgs_bench.report.sections.motion:build",
    "volume": "uvgs_bench.report.sections.volume:build",
    "errors": "uvgs_bench.report.sections.errors:build",
    "distribution": "uvgs_bench.report.sections.distribution:build",
    "registration": "uvgs_bench.report.sections.registration:build",
    "budget": "uvgs_bench.report.sections.budget:build",
    "diagnosis": "uvgs_bench.report.sections.diagnosis:build",
    "misses": "uvgs_bench.report.sections.misses:build",
    "worst": "uvgs_bench.report.sections.worst:build",
    "gantry": "uvgs_bench.report.sections.gantry:build",
    "calibration": "uvgs_bench.report.sections.calibration:build",
    "beacon": "uvgs_bench.report.sections.beacon:build",
    "definitions": "uvgs_bench.report.sections.definitions:build",
    "conventions": "uvgs_bench.report.sections.conventions:build",
}
"""Key -> builder, in reading order."""

CALIBRATION_SECTIONS: dict[str, str] = {
    key: f"uvgs_bench.report.sections.calibration_{key}:build"
    for key in (
        "verdict", "pose", "coverage", "residuals", "uncertainty", "halves", "boards", "views", "lens", "definitions",
    )
}  # fmt: skip
"""The same for calibrations: ``build(evidence) -> Section | None``."""

MEASUREMENT_SECTIONS: dict[str, str] = {
    key: f"uvgs_bench.report.sections.beacon_{key}:build"
    for key in ("distances", "leds", "angles", "pictures", "definitions")
}
"""The same for measured beacons."""

FORECAST_SECTIONS: dict[str, str] = {
    key: f"uvgs_bench.report.sections.beacon_{key}:build" for key in ("forecast", "geometry", "definitions")
}
"""The same for beacons looked at before they are trusted."""

FOLLOW_SECTIONS: dict[str, str] = {
    key: f"uvgs_bench.report.sections.follow_{key}:build"
    for key in ("tracking", "margin", "motion", "losses", "setup", "definitions")
}
"""The same for follow sessions."""

FUSION_SECTIONS: dict[str, str] = {
    key: f"uvgs_bench.report.sections.fusion_{key}:build"
    for key in ("ways", "path", "pauses", "consistency", "fit", "definitions")
}
"""The same for fusions."""

__all__ = [
    "CALIBRATION_SECTIONS",
    "FOLLOW_SECTIONS",
    "FORECAST_SECTIONS",
    "FUSION_SECTIONS",
    "MEASUREMENT_SECTIONS",
    "SECTIONS",
]
