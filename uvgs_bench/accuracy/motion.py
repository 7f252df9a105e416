"""Captures in motion: how late the poses are, and how large the errors are when blocks of time, not captures, count."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.clusters import LEAST_PLACES, TAIL, Clusters, Estimate
from uvgs_bench.accuracy.distributions import t_quantile
from uvgs_bench.accuracy.intervals import moment_intervals
from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.pose_error import ErrorTable
from uvgs_bench.accuracy.registration import Registration
from uvgs_bench.accuracy.time_blocks import stretches, time_blocks
from uvgs_bench.geometry import FloatArray

# Least share of the squared speed that must be about its mean.
_BOTH_WAYS = 0.25
_STILL = "no capture in motion has a pose"


def lag_of(obs: Observations, moving: ErrorTable, registration: Registration) -> Estimate:
    """Time by which poses lag their stamps: error = constant − lag · velocity, over captures in motion.

    Args:
        obs: Captures in motion, all with a pose.
        moving: Their errors.
        registration: Carries velocities into the camera; a time offset it has fitted is added.

    Returns:
        The lag, s; without a figure when motion is all one way, since a lag is then a shift.
    """
    if moving.count == 0:
        return Estimate(np.nan, -np.inf, np.inf, 0, 0, _STILL)
    e = moving.translation_error_m
    n = moving.count
    v = _camera_velocity(obs, registration)
    centred_v, centred_e = v - v.mean(axis=0), e - e.mean(axis=0)
    power = float((centred_v**2).sum())
    if power < _BOTH_WAYS * float((v**2).sum()):
        note = "captures in motion must go both ways: a lag cannot be told from a shift"
        return Estimate(np.nan, -np.inf, np.inf, len(np.unique(moving.place)), n, note)
    fitted = registration.time_offset_s.value if registration.time_offset_s is not None else 0.0
    residual_lag = -float((centred_v * centred_e).sum()) / power
    value = residual_lag + fitted
    rest = centred_e + residual_lag * centred_v
    part, worth = _parts(moving, obs.session, rest)
    names, index = np.unique(part, return_inverse=True)
    S = len(names)
    if S < LEAST_PLACES:
        note = f"only {S} independent parts in motion, at least {LEAST_PLACES} are needed for an interval"
        return Estimate(value, -np.inf, np.inf, S, n, note, worth)
    scores = np.bincount(index, (centred_v * rest).sum(axis=1), S)
    # Two fitted figures along the direction of motion: the lag and a constant.
    sigma = float(np.sqrt(S / (S - 2.0) * (scores**2).sum())) / power
    reach = t_quantile(1.0 - TAIL, S - 2) * sigma
    return Estimate(value, value - reach, value + reach, S, n, "", worth)


def _camera_velocity(obs: Observations, registration: Registration) -> FloatArray:
    """Velocity of the beacon as the camera sees it, shape (n, 3), m/s."""
    if obs.mount == "beacon_on_carriage":
        return np.asarray(obs.velocity_gs_mps @ registration.left.R.T)
    return np.asarray(-np.einsum("ij,nkj,nk->ni", registration.left.R, obs.R_gs, obs.velocity_gs_mps))


def dynamic_figures(
    moving: ErrorTable, session: NDArray[np.int64], rng: np.random.Generator
) -> Iterator[tuple[str, Estimate]]:
    """Errors in motion with intervals over places or blocks of time, whichever are fewer.

    Args:
        moving: Errors of captures in motion, all with a pose.
        session: Run of each, shape (n,).
        rng: Source of randomness.

    Yields:
        Key and figure.
    """
    for key, errors, columns in (
        ("dynamic_position_rms", moving.translation_error_m, slice(3, 6)),
        ("dynamic_attitude_rms", moving.rotation_error_rad, slice(0, 3)),
    ):
        if moving.count == 0:
            yield key, Estimate(np.nan, 0.0, np.inf, 0, 0, _STILL)
            continue
        part, worth = _parts(moving, session, errors)
        found = moment_intervals(errors, moving.registration_factor[:, columns], Clusters.of(part, rng)).rms
        yield key, replace(found, effective_count=worth)


def _parts(table: ErrorTable, session: NDArray[np.int64], errors: FloatArray) -> tuple[NDArray[np.int64], float]:
    """Independent parts: blocks of time, or places where they are fewer; and how many captures they are worth."""
    order = np.lexsort((table.t_ns, session))
    block = np.empty(table.count, dtype=np.int64)
    block[order], worth = time_blocks(errors[order], stretches(table.t_ns[order], session[order]))
    is_fewer = len(np.unique(block)) < len(np.unique(table.place))
    return (block, worth) if is_fewer else (table.place, worth)
