"""What the reports about a beacon are made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from uvgs_bench.beacon.accuracy_map import AccuracyMap, Gain
from uvgs_bench.beacon.checks import BeaconWarning
from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.beacon.measure_types import BeaconMeasurement


@dataclass(frozen=True, slots=True, eq=False)
class MeasurementEvidence:
    """A measured beacon and how its pictures fared.

    Args:
        measurement: The measurement.
        nominal: The beacon as meant, in its own frame.
        created_utc: When it was measured.
        captures: Pictures looked at.
        named: Pictures whose blobs could be named.
        misses: Reasons of the others and how often.
        notes: Name and value of everything the numbers depend on.
    """

    measurement: BeaconMeasurement
    nominal: Beacon
    created_utc: str
    captures: int
    named: int
    misses: Mapping[str, int] = field(default_factory=dict)
    notes: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class ForecastEvidence:
    """What a beacon can do with a camera, before anybody built or trusted it.

    Args:
        beacon: The beacon.
        found: The map.
        gains: What moving one LED would bring, best first.
        sigma_px: Deviation of a centroid per axis it was computed for, px.
        step_m: By how much the LED was moved for that, m.
        lines: The weakest places, for people.
        is_safe: Whether labels are told apart everywhere and no LEDs merge.
        warnings: Weaknesses of the geometry itself.
        notes: Name and value of everything the numbers depend on.
    """

    beacon: Beacon
    found: AccuracyMap
    gains: tuple[Gain, ...]
    sigma_px: float
    step_m: float
    lines: tuple[str, ...]
    is_safe: bool
    warnings: tuple[BeaconWarning, ...] = ()
    notes: Mapping[str, str] = field(default_factory=dict)
