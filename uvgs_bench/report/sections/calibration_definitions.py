"""What every figure of a calibration report means, and the conventions."""

from __future__ import annotations

from uvgs_bench.report.calibration_evidence import CalibrationEvidence
from uvgs_bench.report.document import Definitions, Section
from uvgs_bench.report.quantities import CAMERA_CONVENTIONS

_ITEMS = (
    ("RMS of lengths", "sqrt(mean(dx² + dy²)) over the kept corners; OpenCV and this tool print it first."),
    ("RMS per axis", "sqrt of the mean of all dx² and dy² together: the RMS of lengths over √2; mrcal and Kalibr."),
    ("As an angle", "Angle between the ray of the seen corner and the predicted one; does not depend on resolution."),
    (
        "1 sigma",
        "One standard deviation: if the lens model is right, 95 of 100 calibrations err by less than 1.96.",
    ),
    ("Noise of a picture", "Standard deviation of one residual component of that picture, degrees of freedom counted."),
    ("Held out", "Error in pictures the lens was not fitted to: pose from half of the corners, error of the others."),
    ("Halves", "Two lenses from disjoint halves of the pictures, compared after the rotation that fits them best."),
    ("Predicted", "What the halves' own covariances say of their difference; a ratio of 1 is honest, 3 is not."),
    ("Shared residual", "√correlation × RMS, of nearest corners on one board: what the lens or the board leaves over."),
    (
        "Total error",
        "sqrt((ratio × sigma)² + shared²) in px: sigma of a far point along its worst direction, ratio of the halves "
        "where above 1.",
    ),
    ("Covered", "Radius about the principal point within which four of five cells hold a corner."),
    ("Usable", "Radius within which boards were seen and the total error stays below its limit."),
    ("Tilt, distance", "Angle between board and picture plane; distance of the middle of its seen corners."),
    ("Set aside", "Corners beyond four robust standard deviations of their picture, at most a tenth of all."),
)


def build(evidence: CalibrationEvidence) -> Section | None:
    """The card of definitions and conventions."""
    del evidence
    return Section("definitions", "Definitions and conventions", (Definitions((*_ITEMS, *CAMERA_CONVENTIONS)),))
