"""The uncertainty budget of a comparison of sensor and gantry, after the GUM and by Monte Carlo.

Measurand: one error of the sensor against the registered gantry, at a capture that judges, drawn at random. Lines of
the sensor say how large such errors should be; lines of the reference say how far the gantry itself can be trusted.

Source: JCGM 100:2008 (GUM), clauses 4, 5 and G.4; JCGM 101:2008, clause 7; JCGM 102:2011 for vectors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["A", "B"]
Part = Literal["sensor", "reference"]
Distribution = Literal["normal", "t", "rectangular"]


@dataclass(frozen=True, slots=True)
class BudgetLine:
    """One source of doubt.

    Args:
        name: What it is, for tables.
        kind: How its size is known: ``A`` from the scatter of these data, ``B`` from elsewhere.
        position_m: What it adds to one position error, root of the trace of its covariance, RMS over captures, m.
        attitude_rad: What it adds to one attitude error, likewise, rad.
        distribution: What it is drawn from.
        degrees_of_freedom: How well its size is known; inf when stated without doubt.
        is_common: Whether it is the same error in every capture, so that averaging does not help.
        source: Where the number comes from, one line.
        improve: What would make it smaller, one line.
        part: Whether it belongs to the sensor or to the reference.
        is_known: Whether anything was stated; a line that is not known adds nothing and is named in the advice.
    """

    name: str
    kind: Kind
    position_m: float
    attitude_rad: float
    distribution: Distribution
    degrees_of_freedom: float
    is_common: bool
    source: str
    improve: str
    part: Part = "sensor"
    is_known: bool = True


@dataclass(frozen=True, slots=True)
class Budget:
    """All lines, put together.

    Args:
        lines: The lines, largest position share first; those not known last.
        combined_position_m: Root of the sum of squares, m.
        combined_attitude_rad: The same of attitudes, rad.
        reference_position_m: The same over the lines of the reference only, m.
        reference_attitude_rad: The same, rad.
        degrees_of_freedom: Of the combined position doubt (Welch-Satterthwaite).
        coverage_factor: Length of the position error that 95 % stay below, over the combined doubt.
        attitude_coverage_factor: The same for attitudes.
        expanded_position_m: ``coverage_factor`` times the combined doubt, m.
        expanded_attitude_rad: The same, rad.
        monte_carlo_position_m: 95th percentile of the length by Monte Carlo, m.
        monte_carlo_low_m: Lower end of the shortest interval that holds 95 % of the lengths by Monte Carlo, m.
        monte_carlo_high_m: Upper end, m.
        monte_carlo_attitude_rad: 95th percentile of the angle by Monte Carlo, rad.
        is_confirmed: Whether Monte Carlo and the GUM agree to 5 % in both.
        observed_position_m: Root mean square of the position errors that were observed, m.
        observed_attitude_rad: The same of attitudes, rad.
        dominant: Name of the line that adds most to the position.
        advice: What to improve first and what is missing, most useful first.
    """

    lines: tuple[BudgetLine, ...]
    combined_position_m: float
    combined_attitude_rad: float
    reference_position_m: float
    reference_attitude_rad: float
    degrees_of_freedom: float
    coverage_factor: float
    attitude_coverage_factor: float
    expanded_position_m: float
    expanded_attitude_rad: float
    monte_carlo_position_m: float
    monte_carlo_low_m: float
    monte_carlo_high_m: float
    monte_carlo_attitude_rad: float
    is_confirmed: bool
    observed_position_m: float
    observed_attitude_rad: float
    dominant: str
    advice: tuple[str, ...]
