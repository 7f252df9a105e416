"""What the figures of a follow report mean, and the conventions."""

from __future__ import annotations

from uvgs_bench.report.document import Definitions, Section
from uvgs_bench.report.quantities import CAMERA_CONVENTIONS

_ITEMS = (
    ("Leader, follower", "The leader carries the beacon; the follower carries the camera and is to keep its station."),
    ("Station", "Where the follower's body is to be, fixed in the leader's axes (those of its beacon)."),
    ("Position error", "Distance of the follower's body from its station."),
    ("In tolerance", "Position and attitude error both within the scenario's tolerances."),
    ("Steady", "The leader has long not accelerated (settle_s), nor was there a loss of sight, or it is recovered."),
    ("Overshoot", "Way past a stop of the leader, along the leg it came by."),
    ("Following, holding", "The law acts on fresh poses; it keeps its velocity without them, up to hold_s."),
    ("Braking, aborted", "It comes to rest after hold_s without a fresh pose; it gives up for good after abort_s."),
    ("Loss of sight", "Three or more captures in a row without a believed pose, not all just dropped or skipped."),
    ("Busy, dropped, outlier", "Skipped while the sensor was at work; never arrived; refused by the pose filter."),
    (
        "World",
        "Axes of the leader at its start: x right, y down, z forward from the follower; of the gantry if it follows.",
    ),
)


def build(evidence: object) -> Section | None:
    """The card of definitions and conventions."""
    del evidence
    return Section("definitions", "Definitions and conventions", (Definitions((*_ITEMS, *CAMERA_CONVENTIONS)),))
