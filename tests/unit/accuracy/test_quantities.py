"""Named figures: what each sees, what it must not see, and the reason when a run cannot give it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.planted_bench import Noise, planted_observations
from uvgs_bench.accuracy import Limit, Observations, error_table, fit_registration, judge
from uvgs_bench.accuracy.clusters import Clusters, Estimate
from uvgs_bench.accuracy.judgement import QUANTITIES
from uvgs_bench.accuracy.order_intervals import tolerance_bound
from uvgs_bench.accuracy.quantities import quantities
from uvgs_bench.accuracy.quantity_catalogue import LIMITABLE, TEXTS, Quantity
from uvgs_bench.accuracy.two_clusters import two_cluster_quantities
from uvgs_bench.geometry.se3 import so3_exp

USUAL = Noise()


def bench(places: int = 30, shots: int = 3, seed: int = 1, noise: Noise = USUAL) -> Observations:
    return planted_observations("3T", places, shots, np.random.default_rng(seed), noise)


def figures(obs: Observations) -> tuple[Quantity, ...]:
    registration = fit_registration(obs)
    return quantities(obs, error_table(obs, registration), registration, np.random.default_rng(0))


def whole(obs: Observations) -> dict[str, Estimate]:
    return {q.key: q.estimate for q in figures(obs) if not q.group}


def test_every_figure_has_words_a_unit_and_an_interval_or_a_reason() -> None:
    found = figures(bench())
    assert {q.key for q in found} | {"two_cluster_position_rms", "two_cluster_attitude_rms"} == set(TEXTS)
    for q in found:
        assert q.name
        assert q.definition.endswith(".")
        assert q.source
        e = q.estimate
        if np.isfinite(e.value):
            assert e.low <= e.value <= e.high, q.key
        if not (np.isfinite(e.low) and np.isfinite(e.high)):
            assert e.note, q.key


def test_a_run_at_rest_says_why_it_has_no_figures_of_motion() -> None:
    found = whole(bench())
    for key in ("lag", "dynamic_position_rms", "dynamic_attitude_rms"):
        assert np.isnan(found[key].value)
        assert "in motion" in found[key].note
    assert "direction" in found["vap_position"].note
    assert "visited again" in found["drift_position"].note
    assert "one run" in found["reproducibility_sd"].note


def test_all_misses_leave_availability_and_reasons() -> None:
    obs = bench(8)
    registration = fit_registration(obs)
    missed = replace(obs, is_solved=np.zeros(obs.count, dtype=np.bool_), reason=("blobs/none",) * obs.count)
    found = quantities(missed, error_table(missed, registration), registration, np.random.default_rng(0))
    by_key = {q.key: q.estimate for q in found if not q.group}
    assert by_key["availability"].value == 0.0
    assert np.isnan(by_key["absolute_position_rms"].value)
    assert "no capture at rest" in by_key["absolute_position_rms"].note
    assert "no captures" in by_key["false_fix"].note


def test_a_false_fix_is_wrong_beyond_its_sigma_and_beyond_the_gate() -> None:
    obs = bench(20, 2)
    R, t, C = obs.R_cb.copy(), obs.t_cb_m.copy(), obs.covariance.copy()
    # Half a turn, confidently: false. 20 mm at 1.5 m is beyond 5 sigma but not beyond 3 % of the range. Half a radian
    # that says it knows nothing claims nothing.
    R[4] = so3_exp(np.array([np.pi, 0.0, 0.0])) @ R[4]
    t[11] += np.array([0.02, 0.0, 0.0])
    R[21] = so3_exp(np.array([0.5, 0.0, 0.0])) @ R[21]
    C[21] *= 1e6
    registration = fit_registration(obs)
    wrong = replace(obs, R_cb=R, t_cb_m=t, covariance=C)
    table = error_table(wrong, registration)
    found = {q.key: q.estimate for q in quantities(wrong, table, registration, np.random.default_rng(0))}
    assert found["false_fix"].value == pytest.approx(1.0 / 40.0)
    assert found["false_fix"].low > 0.0


def test_relative_errors_do_not_see_the_camera_but_see_the_lever() -> None:
    quiet = Noise((1e-4,) * 3, (0.0,) * 3)
    shift_only = whole(bench(noise=quiet))
    # Two independent positions: root 2 of 1e-4 by root 3 axes, 10 % for 30 places.
    assert shift_only["relative_position_rms"].value == pytest.approx(6**0.5 * 1e-4, rel=0.1)
    assert shift_only["relative_attitude_rms"].value < 1e-6
    turning = whole(bench(noise=Noise((1e-7,) * 3, (0.0, 0.0, 2e-3))))
    # Places in a cube of 0.5 m lie 0.2 m apart across one axis, root mean square (root(2/12) of the edge, two axes
    # together 0.29 m); 2 mrad of attitude noise on that lever.
    assert turning["relative_position_rms"].value == pytest.approx(2e-3 * 0.29, rel=0.2)
    assert turning["ad_rms"].value < 1e-6
    assert turning["absolute_position_rms"].value < 1e-6


def test_groups_part_the_captures_and_admit_to_being_small() -> None:
    obs = bench(40, 2)
    exposure = np.where(np.arange(obs.count) % 4 < 2, 0.002, 0.016)
    found = figures(replace(obs, exposure_s=exposure))
    for grouping in ("range", "zone", "exposure"):
        counts = [q.estimate.capture_count for q in found if q.group == grouping and q.key == "availability"]
        assert len(counts) > 1
        assert sum(counts) == obs.count
    assert {q.group_value for q in found if q.group == "exposure"} == {"1.38 to 2.76 ms", "11 to 22.1 ms"}
    small = [q.estimate for q in found if q.group and q.key == "position_rms" and q.estimate.station_count < 8]
    assert small
    assert all(np.isinf(e.high) and "at least 8" in e.note for e in small)
    assert not [q for q in figures(obs) if q.group == "exposure"]


def test_tolerance_bounds_need_the_known_numbers_of_places() -> None:
    def bound(places: int, shots: int = 1) -> Estimate:
        sizes = np.repeat(np.arange(places, dtype=np.float64), shots)
        clusters = Clusters.of(np.repeat(np.arange(places), shots), np.random.default_rng(0))
        return tolerance_bound(sizes, 0.95, clusters)

    # The published numbers: 59 for the largest, 93 for the second, 124 for the third of the ordered values.
    assert np.isinf(bound(58).high)
    assert "59 are needed" in bound(58).note
    assert [bound(n).value for n in (59, 92, 93, 123, 124)] == [58.0, 91.0, 91.0, 121.0, 121.0]
    # Captures of one place are not more places.
    assert np.isinf(bound(58, 10).high)
    assert bound(93, 10).value == 91.0


def test_limits_may_name_the_new_figures() -> None:
    obs = planted_observations("3T", 100, 3, np.random.default_rng(4), register_every=3)
    wanted = {"rp_position_max_mm": 20.0, "relative_attitude_rms_deg": 0.001, "lag_ms": 5.0, "false_fix_percent": 10.0}
    found = judge(obs, [Limit.of(name, value) for name, value in wanted.items()], np.random.default_rng(0))
    assert [v.verdict for v in found.verdicts] == ["pass", "fail", "inconclusive", "pass"]
    assert "in motion" in found.verdicts[2].reason
    assert found.quantities
    for name, (key, unit) in LIMITABLE.items():
        assert QUANTITIES[name] == ("quantity", key, unit)
        assert {"mm": "m", "deg": "rad", "percent": "1", "ms": "s"}[unit] == TEXTS[key].unit


def test_folds_judge_every_capture_in_its_own_row() -> None:
    obs = bench(40, 2)
    moving = np.zeros((obs.count, 3))
    moving[::7, 0] = 0.05 * (-1.0) ** np.arange(len(moving[::7]))
    late = replace(obs, velocity_gs_mps=moving, t_ns=np.zeros(obs.count, dtype=np.int64))
    found = judge(late, [], np.random.default_rng(0))
    assert found.table is not None
    np.testing.assert_array_equal(found.table.station, obs.station)
    by_key = {q.key: q.estimate for q in found.quantities if not q.group}
    assert by_key["dynamic_position_rms"].capture_count == len(moving[::7])


def test_two_beacons_on_one_bar_need_no_gantry() -> None:
    rng = np.random.default_rng(6)
    obs = bench(30, 3, noise=Noise((1e-9,) * 3, (1e-9,) * 3))
    R_ab, t_ab = so3_exp(np.array([0.1, -0.4, 0.2])), np.array([0.2, 0.0, 0.01])
    R_b, t_b = obs.R_cb @ R_ab, obs.t_cb_m + obs.R_cb @ t_ab
    exact = two_cluster_quantities((obs.R_cb, obs.t_cb_m), (R_b, t_b), obs.place, rng)
    assert all(q.estimate.high < 1e-12 for q in exact)
    noisy = t_b + rng.normal(scale=1e-3, size=t_b.shape)
    position, attitude = two_cluster_quantities((obs.R_cb, obs.t_cb_m), (R_b, noisy), obs.place, rng)
    # 1 mm by root 3 axes; 90 captures know it to 4 %, three deviations allowed.
    assert position.estimate.value == pytest.approx(1e-3 * 3**0.5, rel=0.13)
    assert position.estimate.low < 1e-3 * 3**0.5 < position.estimate.high
    assert attitude.estimate.value < 1e-9
    assert "E3064" in position.source
    with pytest.raises(ValueError, match="both"):
        two_cluster_quantities((R_b[:0], t_b[:0]), (R_b[:0], t_b[:0]), obs.place[:0], rng)


def test_what_differs_between_runs_is_reproducibility() -> None:
    obs = bench(12, 12)
    run = np.tile(np.arange(12) // 3, 12)
    added = np.random.default_rng(8).normal(scale=5e-3, size=(4, 3))
    found = whole(replace(obs, session=run, t_cb_m=obs.t_cb_m + added[run]))
    # Planted per axis: 0.60 mm within a run (0.2, 0.2 and 1 mm), known to 3 %; between runs what these four drew.
    assert found["repeatability_sd"].value == pytest.approx(0.6e-3, rel=0.1)
    drawn = float(np.sqrt(added.var(axis=0, ddof=1).mean()))
    assert found["between_runs_sd"].value == pytest.approx(drawn, rel=0.1)
    assert found["between_runs_sd"].low < 5e-3 < found["between_runs_sd"].high
    total = found["reproducibility_sd"]
    assert total.value**2 == pytest.approx(found["repeatability_sd"].value ** 2 + found["between_runs_sd"].value ** 2)
    assert found["reproducibility_limit"].value == pytest.approx(2.8 * total.value)
    assert "several runs" in found["drift_position"].note


def test_the_page_of_procedures_lists_every_limit() -> None:
    page = (Path(__file__).parents[3] / "procedures" / "README.md").read_text(encoding="utf-8")
    assert [name for name in QUANTITIES if f"`{name}`" not in page] == []
