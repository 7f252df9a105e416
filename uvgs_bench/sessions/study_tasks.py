"""What is done on one simulated bench of a study; each function gets a generator and gives plain values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from uvgs_bench.accuracy import Registration, error_table, fit_registration, judge
from uvgs_bench.accuracy.bench_model import predicted
from uvgs_bench.accuracy.blind_bench import BlindBench, observe, planted, random_bench, standard_stations
from uvgs_bench.accuracy.clusters import Estimate
from uvgs_bench.accuracy.diagnosis import examine
from uvgs_bench.accuracy.distributions import t_quantile
from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.statistics import AccuracySummary, summarise
from uvgs_bench.accuracy.tangent import hats, rotation_logs
from uvgs_bench.errors import RegistrationError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.sessions.study_runner import Row
from uvgs_bench.units import m_from_mm, mrad_from_rad, percent_from_fraction, rad_from_mrad, s_from_ms

PLANTED: dict[str, tuple[float, int]] = {
    "led_offset": (m_from_mm(1.0), 12),
    "axis_scale": (2e-3, 3),
    "squareness": (rad_from_mrad(1.0), 3),
    "latency": (s_from_ms(20.0), 1),
    "focal_length": (5e-3, 1),
    "backlash": (m_from_mm(0.1), 1),
}
"""Causes the diagnosis must find: size and number of places it may sit at."""
ALONG = "_seen_along_an_axis"
"""Ending of kinds whose camera looks along a gantry axis, where less can be told apart."""
DIAGNOSIS_KINDS = ("clean", *PLANTED, *(f"{cause}{ALONG}" for cause in ("squareness", "axis_scale", "focal_length")))
LAYOUTS: dict[str, tuple[float, float, float]] = {
    "box": (0.14, 0.14, 0.12),
    "half the box": (0.07, 0.07, 0.06),
    "flat, across the view": (0.14, 0.0, 0.12),
    "line along the view": (0.0, 0.14, 0.0),
}
"""Where places lie: half edges along gantry x (right), y (away from the camera) and z (up), m."""
PLANNING_KINDS: tuple[tuple[int, int, str], ...] = (
    *((places, shots, "box") for places in (18, 27, 36, 54, 72, 108) for shots in (1, 3)),
    *((54, 3, layout) for layout in LAYOUTS if layout != "box"),
)
"""Places, captures at each, and layout."""
PLANNED_HALF = 0.2
"""Half an interval over its figure that a plan should reach."""

# Units people read the sizes of causes in, per SI unit.
_READ_PER_SI = {
    "axis_scale": percent_from_fraction(1.0),
    "focal_length": percent_from_fraction(1.0),
    "squareness": mrad_from_rad(1.0),
}
_LED_NAMES = ("1", "2", "3", "4")
_POPULATION = 4000
_AXES: dict[str, tuple[str, tuple[int, ...]]] = {
    "lateral x": ("m", (0,)),
    "lateral y": ("m", (1,)),
    "depth": ("m", (2,)),
    "position": ("m", (0, 1, 2)),
    "tilt x": ("rad", (0,)),
    "tilt y": ("rad", (1,)),
    "roll": ("rad", (2,)),
    "attitude": ("rad", (0, 1, 2)),
}
_TERM_NAMES = ("scale x", "scale y", "scale z", "square xy", "square xz", "square yz")


def coverage_bench(rng: np.random.Generator, number: int) -> Row:
    """Whether the intervals of one clean bench hold the truth, and those of the terms of one with planted terms.

    Args:
        rng: Source of randomness.
        number: The bench's number.

    Returns:
        ``inside``: figure to whether its interval holds the truth; ``open``: figures whose interval is open above;
        ``failed``: what could not be computed, with the reason.
    """
    bench = random_bench(rng)
    stations = standard_stations(rng, places=120, revisits=24, moving=12, shots=2)
    found = judge(observe(bench, stations, rng), (), rng, gantry_sigma_m=bench.gantry_repeatability_m)
    row: Row = {"inside": {}, "open": [], "failed": {}}
    if found.registration is None or found.summary is None:
        row["failed"]["judgement"] = found.alerts[0].text
    else:
        errors = _population(bench, found.registration, rng)
        for name, estimate, truth in _figures(found.summary, errors):
            row["inside"][name] = bool(estimate.low <= truth <= estimate.high)
            if not np.isfinite(estimate.high):
                row["open"].append(name)
        row["inside"] |= _registration_inside(bench, found.registration)
    try:
        row["inside"] |= _terms_inside(bench, rng, row["failed"])
    except RegistrationError as error:
        row["failed"]["terms"] = str(error)
    return row


def diagnosis_bench(rng: np.random.Generator, number: int) -> Row:
    """What the diagnosis says of one bench; kinds take turns.

    Args:
        rng: Source of randomness.
        number: The bench's number; its remainder says which of ``DIAGNOSIS_KINDS`` it is.

    Returns:
        ``kind``; ``named``: causes in the order named; ``right``: whether the first names the planted part, too;
        ``alike``: causes the first could not be told from; ``beyond``: whether the run said that it could not show the
        planted cause at its size.
    """
    kind = DIAGNOSIS_KINDS[number % len(DIAGNOSIS_KINDS)]
    cause = kind.removesuffix(ALONG)
    bench = random_bench(rng, is_oblique=cause == kind)
    size, index, sign = 0.0, 0, 1.0
    if cause != "clean":
        size, places = PLANTED[cause]
        index, sign = int(rng.integers(places)), float(rng.choice((-1.0, 1.0)))
        # Play has no sign.
        bench = planted(bench, cause, size if cause == "backlash" else sign * size, index)
    obs = observe(bench, standard_stations(rng), rng)
    registration: Registration | None = None
    # A sensor that refuses the fits of a wrong beacon leaves nothing to register, and still something to diagnose.
    with suppress(RegistrationError):
        registration = fit_registration(obs, gantry_sigma_m=bench.gantry_repeatability_m)
    found = examine(obs, registration, bench.lens, bench.leds_m, _LED_NAMES)
    named = [suspect.cause for suspect in found.suspects]
    part = _part(cause, index)
    limits = [limit.least for limit in found.limits if limit.cause == cause and part in limit.title]
    return {
        "kind": kind,
        "named": named,
        "right": bool(named) and named[0] == cause and part in found.suspects[0].title,
        "alike": list(found.suspects[0].alternative_causes) if named else [],
        "beyond": bool(limits) and min(limits) > size * _READ_PER_SI.get(cause, 1.0),
    }


def planning_bench(rng: np.random.Generator, number: int) -> Row:
    """How wide the interval of the position RMS comes out; kinds take turns.

    Args:
        rng: Source of randomness.
        number: The bench's number; its remainder says which of ``PLANNING_KINDS`` it is.

    Returns:
        ``kind``; ``half``: half of the interval over the figure; ``share``: part of the squared errors that is the
        registration's; None where the data cannot bound it.
    """
    places, shots, layout = PLANNING_KINDS[number % len(PLANNING_KINDS)]
    kind = planning_name(places, shots, layout)
    bench = random_bench(rng)
    stations = standard_stations(rng, places=places, revisits=0, moving=0, shots=shots, half_m=LAYOUTS[layout])
    obs = observe(bench, stations, rng)
    registers = obs.has_role("register")
    try:
        registration = fit_registration(obs.select(registers), gantry_sigma_m=bench.gantry_repeatability_m)
    except RegistrationError as error:
        return {"kind": kind, "failed": str(error)}
    summary = summarise(error_table(obs.select(~registers), registration), rng)
    if summary is None:
        return {"kind": kind, "failed": "no station that judges has a pose"}
    rms = summary.components["position"].rms
    half = relative_half(rms)
    return {
        "kind": kind,
        "half": half if np.isfinite(half) else None,
        "share": float(min((summary.registration_share_m / rms.value) ** 2, 1.0)),
    }


def planning_name(places: int, shots: int, layout: str) -> str:
    """A kind of ``PLANNING_KINDS`` in words."""
    return f"{places} places, {shots} capture{'s' if shots > 1 else ''} each, {layout}"


def relative_half(estimate: Estimate) -> float:
    """Half of an interval over the figure; inf when it is open."""
    if not (np.isfinite(estimate.high) and np.isfinite(estimate.low) and abs(estimate.value) > 0.0):
        return float("inf")
    return 0.5 * (estimate.high - estimate.low) / abs(estimate.value)


def _figures(summary: AccuracySummary, errors: dict[str, FloatArray]) -> Iterator[tuple[str, Estimate, float]]:
    """Figures with the truth: noise draws the sensor to no side, all else is that of the population."""
    for name, (_, axes) in _AXES.items():
        figures = summary.components[name.replace(" ", "_")]
        error = errors[name]
        sizes = np.linalg.norm(error, axis=1)
        if len(axes) == 1:
            yield f"{name} bias", figures.bias, 0.0
        if name in ("depth", "position", "attitude"):
            yield f"{name} spread", figures.spread, float(np.sqrt(((error - error.mean(axis=0)) ** 2).sum(1).mean()))
            yield f"{name} RMS", figures.rms, float(np.sqrt((sizes**2).mean()))
            yield f"{name} p95", figures.p95, float(np.quantile(sizes, 0.95))


def _population(bench: BlindBench, registration: Registration, rng: np.random.Generator) -> dict[str, FloatArray]:
    """Errors of very many places of the same bench, judged by the true poses."""
    stations = standard_stations(rng, places=_POPULATION, revisits=0, moving=0, shots=1)
    truth = replace(
        registration,
        left=bench.left,
        right=bench.right,
        covariance=np.zeros((12, 12)),
        terms=np.zeros_like(registration.terms),
        term_factor=np.empty((0, 0)),
    )
    table = error_table(observe(bench, stations, rng), truth)
    of_unit = {"m": table.translation_error_m[table.is_solved], "rad": table.rotation_error_rad[table.is_solved]}
    return {name: of_unit[unit][:, list(axes)] for name, (unit, axes) in _AXES.items()}


def _registration_inside(bench: BlindBench, found: Registration) -> dict[str, bool]:
    """The directions every gantry of three linear axes sees: both attitudes, and where the beacon is at zero."""
    reach = t_quantile(0.975, found.degrees_of_freedom)
    zero = _at_zero(found)
    _, t = found.predict(zero)
    _, true_t = predicted(bench.left, bench.right, np.eye(3)[None], np.zeros((1, 3)))
    factor = found.prediction_factor(zero)[0]
    shift = factor[3:] - hats(t)[0] @ factor[:3]
    parts = {
        "camera attitude": (
            rotation_logs((bench.left.R @ found.left.R.T)[None])[0],
            np.diag(found.left_covariance)[:3],
        ),
        "beacon attitude": (
            rotation_logs((bench.right.R @ found.right.R.T)[None])[0],
            np.diag(found.right_covariance)[:3],
        ),
        "beacon at zero": ((true_t - t)[0], np.diag(shift @ shift.T)),
    }
    return {
        f"registration, {name} {axis}": bool(abs(error[k]) <= reach * np.sqrt(variance[k]))
        for name, (error, variance) in parts.items()
        for k, axis in enumerate("xyz")
    }


def _at_zero(found: Registration) -> Observations:
    """One capture with the carriage at gantry zero, as far as a prediction needs it."""
    nothing = np.zeros((1, 3))
    return Observations(
        station=np.zeros(1, dtype=np.int64),
        role=("judge",),
        t_ns=np.array([found.origin_ns], dtype=np.int64),
        axis_position=nothing,
        R_gs=np.eye(3)[None],
        t_gs_m=nothing,
        R_cb=np.eye(3)[None],
        t_cb_m=nothing,
        covariance=np.eye(6)[None],
        is_solved=np.ones(1, dtype=np.bool_),
        reason=("",),
        mount=found.mount,
    )


def _terms_inside(bench: BlindBench, rng: np.random.Generator, failed: dict[str, str]) -> dict[str, bool]:
    """Terms large enough to be asked for by the data, so that the intervals are not those of a lucky few."""
    signs = rng.choice((-1.0, 1.0), size=7)
    sizes = signs * rng.uniform((2e-3,) * 3 + (1e-3,) * 3 + (0.01,), (4e-3,) * 3 + (3e-3,) * 3 + (0.03,))
    bent = replace(bench, axis_scale=_three(sizes[:3]), shear_rad=_three(sizes[3:6]), delay_s=float(sizes[6]))
    obs = observe(bent, standard_stations(rng, places=60, revisits=12, moving=24, shots=2), rng)
    found = fit_registration(
        obs, gantry_sigma_m=bench.gantry_repeatability_m, terms=("axis_scale", "squareness", "time_offset")
    )
    inside: dict[str, bool] = {}
    M = bent.axes_matrix
    if found.axis_terms is None:
        failed["axis terms"] = "; ".join(found.term_notes)
    else:
        held = found.axis_terms.null_directions
        truth = np.array([*(np.diag(M) - 1.0), M[0, 1], M[0, 2], M[1, 2]])
        # What looks like the sensor's own scale is held at zero: the rest is what is stated.
        truth = truth - held.T @ (held @ truth)
        stated = np.concatenate([found.axis_terms.scale, found.axis_terms.shear_rad])
        for k, name in enumerate(_TERM_NAMES):
            half = float(found.axis_terms.half_widths[k])
            if half > 0.0:
                inside[f"axis terms, {name}"] = bool(abs(stated[k] - truth[k]) <= half)
    if found.time_offset_s is None:
        failed["time offset"] = "; ".join(found.term_notes)
    else:
        inside["time offset"] = bool(found.time_offset_s.low <= bent.delay_s <= found.time_offset_s.high)
    return inside


def _three(values: Sequence[Any] | FloatArray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def _part(kind: str, index: int) -> str:
    """What a title must name besides the cause."""
    if kind == "led_offset":
        return f"LED {_LED_NAMES[index // 3]} "
    if kind == "axis_scale":
        return f"axis {'xyz'[index]} "
    if kind == "squareness":
        earlier, later = (("x", "y"), ("x", "z"), ("y", "z"))[index]
        return f"{earlier} and {later} "
    return ""
