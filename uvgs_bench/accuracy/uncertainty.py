"""The uncertainty budget of a comparison of sensor and gantry, after the GUM and by Monte Carlo.

Measurand: one error of the sensor against the registered gantry, at a capture that judges, drawn at random. Lines of
the sensor say how large such errors should be; lines of the reference say how far the gantry itself can be trusted.

Source: JCGM 100:2008 (GUM), clauses 4, 5 and G.4; JCGM 101:2008, clause 7; JCGM 102:2011 for vectors; F. E.
Satterthwaite, 1946, for the length of a vector whose components are not alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.budget_lines import (
    BudgetInputs,
    BudgetLine,
    Comparison,
    Share,
    noise_share,
    reference_shares,
    sensor_shares,
)
from uvgs_bench.accuracy.distributions import chi2_quantile, f_quantile
from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.pose_error import ErrorTable
from uvgs_bench.accuracy.registration import Registration
from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import mm_from_m

__all__ = ["Budget", "BudgetInputs", "BudgetLine", "uncertainty_budget"]

_DRAWS = 200_000
_MOST_CAPTURES = 500
_AGREEMENT = 0.05
_PROBABILITY = 0.95
# What was observed is said to be unexplained when it is larger by this, and by more than chance.
_UNEXPLAINED = 1.2


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


def uncertainty_budget(
    judged: Observations,
    table: ErrorTable,
    registration: Registration,
    fitted_on: Observations,
    inputs: BudgetInputs,
    rng: np.random.Generator,
) -> Budget | None:
    """Add up what makes sensor and gantry differ, and hold the sum against what was observed.

    Args:
        judged: Captures that judge, in the order of the table.
        table: Their errors.
        registration: The registration they are judged by.
        fitted_on: Captures the registration was fitted on.
        inputs: What is known beside the captures.
        rng: Source of randomness for the Monte Carlo.

    Returns:
        The budget, or None when no judged capture has a pose.
    """
    if not table.is_solved.any():
        return None
    obs, errors = judged.select(table.is_solved), table.select(table.is_solved)
    rows = np.unique(np.linspace(0, obs.count - 1, min(obs.count, _MOST_CAPTURES)).round().astype(np.intp))
    solved = fitted_on.select(fitted_on.is_solved)
    # One capture of a place says as much as all of them about how the registration follows a common error.
    _, first = np.unique(solved.place, return_index=True)
    chosen = Comparison(
        obs.select(_mask(obs.count, rows)),
        errors.select(_mask(obs.count, rows)),
        solved.select(_mask(solved.count, first)),
        registration,
        inputs,
    )
    return _put_together(
        [noise_share(errors, obs, chosen), *sensor_shares(chosen), *reference_shares(chosen)], errors, len(rows), rng
    )


def _mask(count: int, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
    out = np.zeros(count, dtype=np.bool_)
    out[rows] = True
    return out


def _put_together(shares: Sequence[Share], errors: ErrorTable, count: int, rng: np.random.Generator) -> Budget:
    known = [share for share in shares if share.line.is_known]
    lines = [share.line for share in known]
    covariance = np.zeros((count, 6, 6))
    for share in known:
        covariance += share.effect @ share.effect.transpose(0, 2, 1)
    position, position_dof, k, spread = _expanded(covariance[:, 3:, 3:], [line.position_m for line in lines], lines)
    attitude, _, k_attitude, _ = _expanded(covariance[:, :3, :3], [line.attitude_rad for line in lines], lines)
    drawn = _drawn(known, count, rng)
    length, angle = (np.sort(np.linalg.norm(drawn[:, part].swapaxes(1, 2), axis=2).ravel()) for part in _PARTS)
    low, high = _shortest(length)
    by_draws = float(np.quantile(length, _PROBABILITY)), float(np.quantile(angle, _PROBABILITY))
    by_gum = k * position, k_attitude * attitude
    reference = [line for line in lines if line.part == "reference"]
    observed = float(np.sqrt((errors.translation_error_m**2).sum(axis=1).mean()))
    dominant = max(lines, key=lambda line: line.position_m)
    ordered = sorted(lines, key=lambda line: -line.position_m) + [s.line for s in shares if not s.line.is_known]
    return Budget(
        lines=tuple(ordered),
        combined_position_m=position,
        combined_attitude_rad=attitude,
        reference_position_m=float(np.sqrt(sum(line.position_m**2 for line in reference))),
        reference_attitude_rad=float(np.sqrt(sum(line.attitude_rad**2 for line in reference))),
        degrees_of_freedom=position_dof,
        coverage_factor=k,
        attitude_coverage_factor=k_attitude,
        expanded_position_m=by_gum[0],
        expanded_attitude_rad=by_gum[1],
        monte_carlo_position_m=by_draws[0],
        monte_carlo_low_m=low,
        monte_carlo_high_m=high,
        monte_carlo_attitude_rad=by_draws[1],
        is_confirmed=all(abs(a - b) <= _AGREEMENT * b for a, b in zip(by_gum, by_draws, strict=True)),
        observed_position_m=observed,
        observed_attitude_rad=float(np.sqrt((errors.rotation_error_rad**2).sum(axis=1).mean())),
        dominant=dominant.name,
        advice=_advice(ordered, dominant, position, observed, spread * len(np.unique(errors.place))),
    )


_PARTS = np.s_[3:], np.s_[:3]


def _expanded(
    covariance: FloatArray, shares: Sequence[float], lines: Sequence[BudgetLine]
) -> tuple[float, float, float, float]:
    """Combined doubt of a vector, its degrees of freedom, coverage factor of its length, equally strong directions."""
    each = np.trace(covariance, axis1=1, axis2=2)
    mean = float(each.mean())
    # Captures differ: the square of the length varies within a capture's covariance and from capture to capture.
    variance = float(2.0 * (covariance**2).sum(axis=(1, 2)).mean() + each.var())
    directions = 2.0 * mean**2 / max(variance, 1e-300)
    doubt = sum(share**4 / line.degrees_of_freedom for share, line in zip(shares, lines, strict=True))
    degrees = mean**2 / doubt if doubt > 0.0 else np.inf
    if np.isinf(degrees) or degrees > 1e6:
        square = chi2_quantile(_PROBABILITY, directions) / directions
    else:
        square = f_quantile(_PROBABILITY, directions, degrees)
    return float(np.sqrt(mean)), float(degrees), float(np.sqrt(square)), directions


def _drawn(shares: Sequence[Share], count: int, rng: np.random.Generator) -> FloatArray:
    """Errors drawn from the lines, (rotation, translation), shape (N, 6, M)."""
    M = -(-_DRAWS // count)
    normal = np.zeros((count, 6, 6))
    out = np.zeros((count, 6, M))
    for share in shares:
        line, effect = share.line, share.effect
        if line.distribution == "rectangular":
            out += effect @ rng.uniform(-(3.0**0.5), 3.0**0.5, (count, effect.shape[2], M))
        elif line.distribution == "t":
            stretch = np.sqrt(line.degrees_of_freedom / rng.chisquare(line.degrees_of_freedom, (count, 1, M)))
            out += stretch * (_roots(effect @ effect.transpose(0, 2, 1)) @ rng.normal(size=(count, 6, M)))
        else:
            normal += effect @ effect.transpose(0, 2, 1)
    return out + _roots(normal) @ rng.normal(size=(count, 6, M))


def _roots(covariance: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])


def _shortest(ordered: FloatArray) -> tuple[float, float]:
    """The shortest interval that holds 95 % of sorted draws."""
    inside = int(np.ceil(_PROBABILITY * len(ordered)))
    first = int(np.argmin(ordered[inside - 1 :] - ordered[: len(ordered) - inside + 1]))
    return float(ordered[first]), float(ordered[first + inside - 1])


def _advice(
    lines: Sequence[BudgetLine], dominant: BudgetLine, combined_m: float, observed_m: float, freedom: float
) -> tuple[str, ...]:
    share = (dominant.position_m / combined_m) ** 2 if combined_m > 0.0 else 0.0
    advice = [f"{dominant.name} makes up {100.0 * share:.0f} % of the squared doubt: {dominant.improve}"]
    chance = chi2_quantile(0.975, freedom) / freedom
    if observed_m > combined_m * max(_UNEXPLAINED, float(np.sqrt(chance))):
        advice.insert(
            0,
            f"the observed errors ({mm_from_m(observed_m):.3g} mm RMS) are larger than all lines explain "
            f"({mm_from_m(combined_m):.3g} mm): something is missing here or wrong on the bench",
        )
    advice += [
        f"nothing is stated about {line.name}, so it counts as nothing here: {line.improve}"
        for line in lines
        if not line.is_known
    ]
    return tuple(advice)
