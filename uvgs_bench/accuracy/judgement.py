"""The verdict: every limit against its figure and interval, and what the reader must be told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from uvgs_bench.accuracy.clusters import LEAST_PLACES
from uvgs_bench.accuracy.diagnosis import examine
from uvgs_bench.accuracy.independent import Independent, Link, links_of
from uvgs_bench.accuracy.limits import QUANTITIES, Limit, LimitVerdict, Verdict, limit_verdict
from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.pose_error import ErrorTable, concatenated, error_table
from uvgs_bench.accuracy.quantities import Quantity, quantities
from uvgs_bench.accuracy.registration import GANTRY_SIGMA_M, LEAST_STATIONS, Registration, fit_registration
from uvgs_bench.accuracy.statistics import AccuracySummary, Availability, availability, summarise
from uvgs_bench.accuracy.suspects import Diagnosis, SightLimit, Suspect
from uvgs_bench.accuracy.uncertainty import Budget, BudgetInputs, uncertainty_budget
from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.lens import Lens
from uvgs_bench.errors import RegistrationError
from uvgs_bench.geometry import Pose
from uvgs_bench.units import mm_from_m

__all__ = ["QUANTITIES", "Alert", "Judgement", "Limit", "LimitVerdict", "Verdict", "judge"]


@dataclass(frozen=True, slots=True)
class Alert:
    """Something the reader must know.

    Args:
        level: ``note``, ``warning`` or ``error``.
        text: One line.
    """

    level: Literal["note", "warning", "error"]
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """Everything a report says about accuracy.

    Args:
        registration: The registration, or None when there can be none (``alerts`` say why).
        in_sample_table: Errors of the captures the registration was fitted on (optimistic), or None.
        table: Errors of the captures that judge, or None.
        in_sample_summary: Figures of ``in_sample_table``, or None; never judged against limits.
        summary: Figures of ``table``, or None.
        availability: Over all captures of the run.
        verdicts: One per limit, in the order given.
        verdict: ``fail`` if any limit fails, else ``inconclusive`` if any is or there are none, else ``pass``.
        alerts: What the reader must know, worst first.
        split: How the captures were parted into fitting and judging, one line.
        budget: The uncertainty budget of the captures that judge, or None.
        quantities: Named figures of the captures that judge, with their definitions; of groups of them too.
        diagnosis: Causes the residuals of all captures point to, the likeliest first; empty when nothing stands out.
        sight_limits: How large causes would have to be to be named in a run like this; empty when none were sought.
        links: The chain from the camera to the beacon with the doubt of each link; empty without a registration.
        is_independent: Whether the registration owes nothing to the sensor, so that constant errors of it show.
    """

    registration: Registration | None
    in_sample_table: ErrorTable | None
    table: ErrorTable | None
    in_sample_summary: AccuracySummary | None
    summary: AccuracySummary | None
    availability: Availability
    verdicts: tuple[LimitVerdict, ...]
    verdict: Verdict
    alerts: tuple[Alert, ...]
    split: str
    budget: Budget | None = None
    quantities: tuple[Quantity, ...] = ()
    diagnosis: tuple[Suspect, ...] = ()
    sight_limits: tuple[SightLimit, ...] = ()
    links: tuple[Link, ...] = ()
    is_independent: bool = False


_FOLDS = 5
# The registration's doubt matters when it makes up more than this part of the squared errors.
_DOMINANT_SHARE = 0.25
_RANK: dict[str, int] = {"error": 0, "warning": 1, "note": 2}


def judge(
    obs: Observations,
    limits: Sequence[Limit],
    rng: np.random.Generator,
    *,
    run_completed: bool = True,
    gantry_sigma_m: float = GANTRY_SIGMA_M,
    nominal: Pose | None = None,
    lens: Lens | None = None,
    beacon: Beacon | None = None,
    known: BudgetInputs | None = None,
    terms: tuple[str, ...] = (),
    independent: Independent | None = None,
) -> Judgement:
    """Register on the stations meant for it, judge on the others, and hold the figures against limits.

    Without stations of both roles every fifth of the places is judged by a registration fitted on the rest. With an
    independent registration all stations judge.

    Args:
        obs: All captures of a run, misses included.
        limits: What is demanded.
        rng: Source of randomness for the intervals; the same seed gives the same judgement.
        run_completed: Whether the run reached its end.
        gantry_sigma_m: Standard deviation per axis of the carriage position, m.
        nominal: Where what rides the carriage is drawn to in unseen directions; the identity when None.
        lens: The lens the sensor was told; without it or the beacon nothing is diagnosed.
        beacon: The beacon it was told.
        known: What is known beside the captures, for the uncertainty budget.
        terms: Names of ``TERM_GROUPS`` that may be fitted beside the poses, each only when the data ask for it.
        independent: A registration by a board in place of one by the sensor's own poses.

    Returns:
        The judgement. Too little data gives ``inconclusive`` with the reason, never an exception.
    """
    found = availability(obs, rng)
    alerts: list[Alert] = []
    if not run_completed:
        alerts.append(Alert("warning", "the run did not reach its end: the figures cover only what was taken"))
    try:
        if independent is None:
            fit = _Fit(gantry_sigma_m, nominal, terms)
            registration, fitted_on, judged, table, split = _register_and_judge(obs, fit)
        else:
            registration, fitted_on, judged = independent.registration(), obs.select(obs.is_solved), obs
            table, split = error_table(obs, registration), _independent_split(obs, registration)
    except RegistrationError as error:
        alerts.append(Alert("error", f"no registration, hence no accuracy: {error}"))
        verdicts = tuple(limit_verdict(limit, None, found, ()) for limit in limits)
        return Judgement(
            None,
            None,
            None,
            None,
            None,
            found,
            verdicts,
            _overall(verdicts),
            _sorted(alerts),
            "nothing to judge",
            diagnosis=_diagnosis(obs, None, lens, beacon).suspects,
        )
    table = table.in_blocks()
    in_sample = None if independent is not None else error_table(fitted_on, registration)
    summary = summarise(table, rng)
    named = quantities(judged, table, registration, rng)
    verdicts = tuple(limit_verdict(limit, summary, found, named) for limit in limits)
    alerts += _registration_alerts(registration, is_independent=independent is not None) + _summary_alerts(summary)
    shared = _places_of_both_roles(obs)
    if shared and independent is None:
        alerts.append(
            Alert("warning", f"{shared} places both register and judge: their errors are flattered by the registration")
        )
    if not limits:
        alerts.append(Alert("note", "no limits were given: there is nothing to pass or fail"))
    examined = _diagnosis(obs, registration, lens, beacon)
    return Judgement(
        registration=registration,
        in_sample_table=in_sample,
        table=table,
        in_sample_summary=None if in_sample is None else summarise(in_sample, rng),
        summary=summary,
        availability=found,
        verdicts=verdicts,
        verdict=_overall(verdicts),
        alerts=_sorted(alerts),
        split=split,
        budget=uncertainty_budget(
            judged,
            table,
            registration,
            fitted_on,
            replace(known or BudgetInputs(), is_independent=independent is not None),
            rng,
        ),
        quantities=named,
        diagnosis=examined.suspects,
        sight_limits=examined.limits,
        links=links_of(registration, judged) if independent is None else independent.links(judged),
        is_independent=independent is not None,
    )


def _diagnosis(
    obs: Observations, registration: Registration | None, lens: Lens | None, beacon: Beacon | None
) -> Diagnosis:
    if lens is None or beacon is None:
        return Diagnosis(())
    return examine(obs, registration, lens, beacon.positions_m, beacon.led_names)


@dataclass(frozen=True, slots=True)
class _Fit:
    """How registrations are fitted."""

    gantry_sigma_m: float
    nominal: Pose | None
    terms: tuple[str, ...]

    def of(self, obs: Observations) -> Registration:
        return fit_registration(obs, gantry_sigma_m=self.gantry_sigma_m, nominal=self.nominal, terms=self.terms)


def _independent_split(obs: Observations, registration: Registration) -> str:
    return (
        f"registered by a board on {registration.station_count} places, "
        f"judged on all {len(np.unique(obs.station))} stations"
    )


def _register_and_judge(
    obs: Observations, fit: _Fit
) -> tuple[Registration, Observations, Observations, ErrorTable, str]:
    """Registration, the captures it was fitted on, those that judge with their errors, and how they were parted."""
    registers = obs.has_role("register")
    judges = ~registers
    if registers.any() and judges.any():
        fitted_on = obs.select(registers)
        registration = fit.of(fitted_on)
        split = (
            f"registered on {len(np.unique(obs.station[registers]))} stations, "
            f"judged on {len(np.unique(obs.station[judges]))} others"
        )
        judged = obs.select(judges)
        return registration, fitted_on, judged, error_table(judged, registration), split
    registration = fit.of(obs)
    places = np.unique(obs.place[obs.is_solved])
    if len(places) < 2 * LEAST_STATIONS:
        raise RegistrationError(
            f"all stations have one role and only {len(places)} have a pose: "
            f"at least {2 * LEAST_STATIONS} are needed to judge on other stations than those registered on"
        )
    # Neighbours in time go to different folds, so that a drift does not hide in one.
    fold_of_place = dict(zip(places.tolist(), (np.arange(len(places)) % _FOLDS).tolist(), strict=True))
    fold = np.array([fold_of_place.get(place, 0) for place in obs.place.tolist()])
    parts, rows = [], []
    for k in range(_FOLDS):
        if (fold == k).any():
            held_out = obs.select(fold == k)
            others = fit.of(obs.select(fold != k))
            parts.append(error_table(held_out, others))
            rows.append(np.flatnonzero(fold == k))
    split = (
        f"no stations set apart: each fifth of {len(places)} places judged by a registration on the other four fifths"
    )
    return registration, obs, obs, concatenated(parts, rows), split


def _places_of_both_roles(obs: Observations) -> int:
    registers = obs.has_role("register")
    return len(set(obs.place[registers].tolist()) & set(obs.place[~registers].tolist()))


def _overall(verdicts: Sequence[LimitVerdict]) -> Verdict:
    words = {verdict.verdict for verdict in verdicts}
    if "fail" in words:
        return "fail"
    return "pass" if words == {"pass"} else "inconclusive"


def _registration_alerts(registration: Registration, *, is_independent: bool) -> list[Alert]:
    if is_independent:
        text = (
            "registered by a board: constant errors of the sensor show in these figures, as far as the chain from the "
            "board to the beacon is known; what an error of the lens does to board and beacon alike does not show"
        )
        alerts = [Alert("note", text)]
    else:
        alerts = [
            Alert("note", f"registration, rank {registration.rank} of 12: {text}") for text in registration.blind_spots
        ]
        text = (
            "a constant error of the sensor looks like another place of camera or beacon: the registration absorbs it, "
            "so these figures show everything but that; absolute trueness needs an independently measured link"
        )
        alerts.append(Alert("note", text))
    if registration.outlier_count:
        alerts.append(
            Alert(
                "warning",
                f"{registration.outlier_count} of {registration.capture_count} captures used to register are outliers; "
                "their weight was lowered",
            )
        )
    if registration.station_count < 2 * LEAST_STATIONS:
        alerts.append(
            Alert("warning", f"only {registration.station_count} stations register: their errors shift all others")
        )
    return alerts


def _summary_alerts(summary: AccuracySummary | None) -> list[Alert]:
    if summary is None:
        return [Alert("error", "no station that judges has a pose: there is no accuracy to state")]
    alerts = []
    if summary.station_count + summary.block_count < LEAST_PLACES:
        alerts.append(Alert("warning", f"only {summary.extent} judge: intervals need at least {LEAST_PLACES}"))
    if summary.outlier_count:
        alerts.append(
            Alert(
                "warning",
                f"{summary.outlier_count} of {summary.capture_count} judged captures are outliers (more than 5 times "
                "the usual error); they are in every figure",
            )
        )
    position = summary.components["position"].rms.value
    if summary.registration_share_m**2 > _DOMINANT_SHARE * position**2:
        alerts.append(
            Alert(
                "warning",
                f"the registration's own doubt ({mm_from_m(summary.registration_share_m):.3g} mm) is a large part of "
                f"the position errors ({mm_from_m(position):.3g} mm RMS): register on more stations",
            )
        )
    check = summary.consistency
    if check.verdict != "consistent":
        alerts.append(
            Alert(
                "warning" if check.verdict == "inconsistent" else "note",
                f"the sensor's stated uncertainty is {check.verdict} with its errors: {check.reason} (mean squared "
                f"error over stated variance {check.mean_nees_over_6.value:.2f}, expected {check.band_low:.2f} to "
                f"{check.band_high:.2f})",
            )
        )
    return alerts


def _sorted(alerts: Sequence[Alert]) -> tuple[Alert, ...]:
    return tuple(sorted(alerts, key=lambda alert: _RANK[alert.level]))
