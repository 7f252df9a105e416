"""What the figures of a fusion report mean."""

from __future__ import annotations

from uvgs_bench.report.document import Definitions, Section

_ITEMS = (
    ("Body, world", "The body carries camera and inertial unit and has the unit's axes; the world is where the beacon "
     "stands still."),
    ("Fused", "What a method knew at each instant without looking ahead (unless smoothed), from all there is."),
    ("Native localiser", "Another source of poses, such as map landmarks; alone means without the sensor's poses but "
     "with the inertial unit."),
    ("Error", "Distance of the fused position from the true one; angle between the attitudes."),
    ("NEES", "Squared errors of position, velocity and rotation in units of the stated covariance; 9 on average when "
     "the covariance is right."),
    ("NIS", "Squared innovation (measured minus expected pose) in units of what was expected of it; 6 on average."),
    ("Refused", "A pose farther off than the gate allows (99 % of right poses lie within). After two refusals that "
     "agree, the next that agrees is believed: then it is the estimate that was wrong."),
    ("Pause", "The sensor gave no pose for more than 0.5 s and three of its usual steps."),
    ("False pose", "A pose made wrong on purpose, with the covariance of a right one."),
)  # fmt: skip


def build(outcome: object) -> Section | None:
    """The card of definitions."""
    del outcome
    return Section("definitions", "Definitions", (Definitions(_ITEMS),))
