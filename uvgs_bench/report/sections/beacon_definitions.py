"""What the figures of a beacon report mean, and the conventions."""

from __future__ import annotations

from uvgs_bench.report.document import Definitions, Section
from uvgs_bench.report.quantities import CAMERA_CONVENTIONS

_ITEMS = (
    ("Distance", "Between the emission centres of two LEDs; no frame enters, only the scale."),
    ("1 sigma", "One standard deviation: if the model is right, 95 of 100 measurements err by less than 1.96."),
    ("Doubt, 3-D", "Root sum of squares of the deviations of x, y, z; it depends on what fixes the frame."),
    ("Scale", "Comes from exactly one named source; a second one is a check."),
    ("Off nominal", "Distance from the nominal place after laying most LEDs onto theirs."),
    ("Wander", "Apparent travel of the bright centre along the LED's axis, times 1 − cos of the view angle."),
    ("Tilt", "Angle between the beacon's z axis turned to the camera and the line of sight."),
    ("Nearest other labels", "RMS residual per axis of the best pose with wrong labels: small means easily confused."),
    ("Beacon frame", "As in the beacon's file, right-handed; drawn at its origin."),
)


def build(evidence: object) -> Section | None:
    """The card of definitions and conventions."""
    del evidence
    return Section("definitions", "Definitions and conventions", (Definitions((*_ITEMS, *CAMERA_CONVENTIONS)),))
