"""A judgement that may fit terms judges by them, also fold by fold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.accuracy import Judgement, judge
from uvgs_bench.accuracy.blind_bench import observe, planted, random_bench, standard_stations
from uvgs_bench.accuracy.observations import Role

TERMS = ("axis_scale", "squareness", "time_offset")


def judged(terms: tuple[str, ...], *, has_roles: bool) -> Judgement:
    rng = np.random.default_rng(21)
    bench = planted(planted(random_bench(rng), "axis_scale", 4e-3, 0), "latency", 0.02)
    obs = observe(bench, standard_stations(rng, places=48, moving=24), rng)
    if not has_roles:
        nobody: tuple[Role, ...] = tuple("judge" for _ in obs.role)
        obs = replace(obs, role=nobody)
    return judge(obs, (), np.random.default_rng(1), gantry_sigma_m=bench.gantry_repeatability_m, terms=terms)


@pytest.mark.parametrize("has_roles", [True, False])
def test_terms_take_the_gantry_s_errors_out_of_the_sensor_s(has_roles: bool) -> None:
    without, fitted = judged((), has_roles=has_roles), judged(TERMS, has_roles=has_roles)
    assert fitted.registration is not None
    assert fitted.registration.axis_terms is not None
    assert fitted.registration.time_offset_s is not None
    assert fitted.summary is not None
    assert without.summary is not None
    before, after = (j.summary.components["lateral"].rms.value for j in (without, fitted) if j.summary is not None)
    # Across the view, where half a millimetre of scale and one of delay in motion stand beside a sixth of noise.
    assert after < 0.6 * before
    assert fitted.budget is not None
    line = next(line for line in fitted.budget.lines if line.name == "axis scale and squareness")
    assert line.source.startswith("fitted with the registration")


def test_unasked_terms_stay_out() -> None:
    found = judged((), has_roles=True)
    assert found.registration is not None
    assert found.registration.term_notes == ()
    assert not found.registration.terms.any()
