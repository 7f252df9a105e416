"""The conventions card."""

from __future__ import annotations

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.report.document import Definitions, Section
from uvgs_bench.report.quantities import CAMERA_CONVENTIONS
from uvgs_bench.store.run import Run

_CAMERA_FRAME, _TRANSFORMS, _PIXELS = CAMERA_CONVENTIONS
_ITEMS = (
    _CAMERA_FRAME,
    ("Beacon frame", "As in the beacon's file; see the beacon's section."),
    ("Gantry, carriage", "Machine zero with axes as declared; the carriage equals the gantry frame at position 0."),
    _TRANSFORMS,
    (
        "Tangent",
        "ξ = (ω, v), rotation first; updates on the left, T ← exp(ξ^) T; covariances in camera axes.",
    ),
    (
        "Rotation errors",
        "Rotation vectors, never differences of Euler angles. Euler angles: a view, Z-Y-X.",
    ),
    _PIXELS,
    ("Units", "Millimetres and degrees on these pages, SI in the files of the run; time in ns of one monotonic clock."),
)


def build(run: Run, judgement: Judgement) -> Section | None:
    """The conventions card, with the chain of this run's mount."""
    del judgement
    beacon_rides = run.manifest.mount == "beacon_on_carriage"
    chain = (
        "camera_from_beacon = camera_from_gantry · gantry_from_carriage(q) · carriage_from_beacon"
        if beacon_rides
        else "camera_from_beacon = camera_from_carriage · carriage_from_gantry(q) · gantry_from_beacon"
    )
    items = (("Chain of this bench", f"{chain} ({run.manifest.mount.replace('_', ' ')})"), *_ITEMS)
    return Section("conventions", "Conventions", (Definitions(items),))
