"""The lines of an uncertainty budget: what each source of doubt does to every judged error.

Source: JCGM 100:2008 (GUM), clause 4, type A and type B; 5.2 for errors that all captures share.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from uvgs_bench.accuracy.bench_terms import term_jacobian
from uvgs_bench.accuracy.common_errors import as_errors, left_over, sensor_sensitivities
from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.pose_error import ErrorTable
from uvgs_bench.accuracy.registration import Registration
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray

EXPANSION_PER_K = 23e-6
"""Thermal expansion of aluminium, 1/K."""
Kind = Literal["A", "B"]
Part = Literal["sensor", "reference"]
Distribution = Literal["normal", "t", "rectangular"]

# Fewer degrees of freedom than this say too little of a scatter.
_LEAST_DEGREES = 10
_RECTANGULAR = 3.0**0.5


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


@dataclass(frozen=True, slots=True, eq=False)
class BudgetInputs:
    """What is known beside the captures; whatever is None is a line that is not known.

    Args:
        lens: The lens the sensor was told.
        lens_covariance: Covariance of its parameters, shape (P, P).
        leds_m: LED positions the sensor was told, beacon frame, shape (L, 3), m.
        led_covariance_m2: Their covariance, shape (3L, 3L), m^2.
        axis_covariance: Covariance of the axes' scales and shears as characterised, shape (6, 6).
        time_sigma_s: Doubt of the captures' instants against the gantry's, standard deviation, s.
        temperature_half_span_k: Half of the span of temperature since gantry and beacon were measured, K.
        is_independent: Whether the registration owes nothing to the sensor's poses, and so follows none of its errors.
    """

    lens: Lens | None = None
    lens_covariance: FloatArray | None = None
    leds_m: FloatArray | None = None
    led_covariance_m2: FloatArray | None = None
    axis_covariance: FloatArray | None = None
    time_sigma_s: float | None = None
    temperature_half_span_k: float | None = None
    is_independent: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Share:
    """A line with what it does to every judged capture.

    Args:
        line: The line.
        effect: Effect of unit draws on the (rotation, translation) errors, shape (N, 6, K), rad and m.
    """

    line: BudgetLine
    effect: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """What the lines are computed from.

    Args:
        judged: Captures that judge, all with a pose.
        table: Their errors.
        support: Captures that stand for those the registration was fitted on, all with a pose.
        registration: The registration.
        inputs: What is known beside the captures.
    """

    judged: Observations
    table: ErrorTable
    support: Observations
    registration: Registration
    inputs: BudgetInputs

    def common(self, on_judged: FloatArray, on_support: FloatArray) -> FloatArray:
        """What a common error leaves once the registration has followed it, shape (N, 6, K)."""
        left = left_over(self.judged, self.support, self.registration, on_judged, on_support)
        return as_errors(left, self.table.predicted_t_m)

    def of_sensor(self, on_judged: FloatArray, on_support: FloatArray) -> FloatArray:
        """The same of an error of the sensor, which a registration by a board does not follow."""
        if self.inputs.is_independent:
            return as_errors(on_judged, self.table.predicted_t_m)
        return self.common(on_judged, on_support)


def noise_share(everything: ErrorTable, obs: Observations, chosen: Comparison) -> Share:
    """Scatter of the captures of one station about their mean, in the shape the sensor states.

    Args:
        everything: All judged captures with a pose.
        obs: The same captures.
        chosen: Those the budget is computed at.

    Returns:
        The share; as stated by the sensor when there are too few repeats.
    """
    stated = as_errors(_noise_roots(obs), everything.predicted_t_m)
    here = as_errors(_noise_roots(chosen.judged), chosen.table.predicted_t_m)
    errors = np.concatenate([everything.rotation_error_rad, everything.translation_error_m], axis=1)
    _, of_station, count = np.unique(everything.station, return_inverse=True, return_counts=True)
    mean = np.zeros((len(count), 6))
    np.add.at(mean, of_station, errors)
    deviation = errors - (mean / count[:, None])[of_station]
    degrees = 6.0 * (len(errors) - len(count))
    improve = "average more captures at each station, or make the LEDs brighter"
    if degrees < _LEAST_DEGREES:
        return _share(
            here, "sensor noise", "B", "normal", np.inf, False, "as the sensor states it; too few repeats to see it",
            "take several captures at each station, so that the noise can be seen", "sensor",
        )  # fmt: skip
    own = np.linalg.solve(stated, deviation[:, :, None])
    scale = float(np.sqrt((own**2).sum() / degrees))
    source = f"scatter of repeats at one station, {scale:.2f} of what the sensor states"
    return _share(scale * here, "sensor noise", "A", "t", degrees, False, source, improve, "sensor")


def sensor_shares(c: Comparison) -> list[Share]:
    """Lens and beacon: the same error in every capture, of which the registration takes up a part."""
    inputs = c.inputs
    by_lens = by_led = None
    if inputs.lens is not None and inputs.leds_m is not None:
        here = sensor_sensitivities(inputs.lens, inputs.leds_m, c.judged.R_cb, c.judged.t_cb_m)
        there = sensor_sensitivities(inputs.lens, inputs.leds_m, c.support.R_cb, c.support.t_cb_m)
        if inputs.lens_covariance is not None:
            by_lens = c.of_sensor(here[0], there[0]) @ _root(inputs.lens_covariance)
        if inputs.led_covariance_m2 is not None:
            by_led = c.of_sensor(here[1], there[1]) @ _root(inputs.led_covariance_m2)
    shares = []
    for name, effect, stated, improve in (
        ("camera calibration", by_lens, c.judged.calibration_covariance, "calibrate with more and steeper views"),
        ("LED positions", by_led, c.judged.beacon_covariance, "measure the beacon: uvgs beacon measure"),
    ):
        source = "stated covariance, less what the registration takes up"
        if inputs.is_independent:
            source = "stated covariance; what a lens does to board and beacon alike makes it an upper bound"
        if effect is None and np.isfinite(stated).all():
            effect = as_errors(np.array([_root(each) for each in stated]), c.table.predicted_t_m)
            source = "stated covariance before the registration takes up its part: an upper bound"
        shares.append(_share(effect, name, "B", "normal", np.inf, True, source, improve, "sensor"))
    return shares


def reference_shares(c: Comparison) -> list[Share]:
    """Gantry, axes, registration, time and temperature."""
    N, registration, inputs = c.judged.count, c.registration, c.inputs
    origin = registration.origin_ns
    here, there = (term_jacobian(o, registration.left, registration.terms, origin) for o in (c.judged, c.support))
    terms = c.common(here, there)
    none = np.zeros((N, 6, 1))
    carriage = np.zeros((N, 6, 3))
    carriage[:, 3:] = registration.gantry_sigma_m * np.eye(3)
    shares = [
        _share(
            carriage, "gantry positioning", "B", "normal", np.inf, False, "position_sigma_mm of the bench file",
            "characterise the gantry and state what was found", "reference",
        ),
        _share(
            c.table.registration_factor, "registration", "A", "t", float(max(registration.degrees_of_freedom, 1)), True,
            f"least squares on {registration.station_count} places", "register on more places", "reference",
        ),
    ]  # fmt: skip
    axes = None if inputs.axis_covariance is None else terms[:, :, :6] @ _root(inputs.axis_covariance)
    source = "as characterised, less what the registration takes up"
    if registration.axis_terms is not None:
        axes, source = none, "fitted with the registration: its doubt is in that line"
    shares.append(
        _share(
            axes, "axis scale and squareness", "B", "normal", np.inf, True, source,
            "characterise the axes with a board: uvgs gantry characterise", "reference",
        )
    )  # fmt: skip
    is_moving = bool(np.any(c.judged.velocity_gs_mps) or np.any(c.support.velocity_gs_mps))
    time = None if inputs.time_sigma_s is None else terms[:, :, 6:7] * inputs.time_sigma_s
    source = "doubt of the instants times the speed"
    if not is_moving:
        time, source = none, "every capture was taken at rest"
    elif registration.time_offset_s is not None:
        time, source = none, "fitted with the registration: its doubt is in that line"
    shares.append(
        _share(
            time, "time times speed", "B", "normal", np.inf, True, source,
            "fit the time offset, or judge captures at rest", "reference",
        )
    )  # fmt: skip
    warm = None
    if inputs.temperature_half_span_k is not None:
        grown = EXPANSION_PER_K * inputs.temperature_half_span_k / _RECTANGULAR
        warm = terms[:, :, :3].sum(axis=2, keepdims=True) * grown
    shares.append(
        _share(
            warm, "temperature of the gantry", "B", "rectangular", np.inf, True,
            "expansion of aluminium over the span of temperature, less what the registration takes up",
            "write down the temperatures of measuring and of judging", "reference",
        )
    )  # fmt: skip
    return shares


def _share(
    effect: FloatArray | None,
    name: str,
    kind: Kind,
    distribution: Distribution,
    degrees: float,
    is_common: bool,
    source: str,
    improve: str,
    part: Part,
) -> Share:
    is_known = effect is not None
    effect = np.zeros((1, 6, 1)) if effect is None else effect
    turn, shift = (float(np.sqrt((half**2).sum(axis=(1, 2)).mean())) for half in (effect[:, :3], effect[:, 3:]))
    if not is_known:
        source = "not stated"
    return Share(
        BudgetLine(name, kind, shift, turn, distribution, degrees, is_common, source, improve, part, is_known), effect
    )


def _noise_roots(obs: Observations) -> FloatArray:
    """Factors of the noise covariances, shape (N, 6, 6); what is left of a difference may be flat to rounding."""
    C = obs.noise_covariance
    floor = 1e-9 * np.einsum("nii->ni", obs.covariance)[:, :, None] * np.eye(6)
    return np.asarray(np.linalg.cholesky(C + floor), dtype=np.float64)


def _root(covariance: FloatArray) -> FloatArray:
    """A factor F of a covariance that may be singular: it is ``F F^T``."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
