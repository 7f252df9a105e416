"""Verdicts, and every way in which there is too little to judge."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.planted_bench import Noise, planted_observations
from uvgs_bench.accuracy import Judgement, Limit, Observations, fit_registration, judge
from uvgs_bench.accuracy.clusters import Clusters
from uvgs_bench.accuracy.order_intervals import fraction_interval, max_interval, quantile_interval
from uvgs_bench.errors import RegistrationError


def bench(places: int = 30, shots: int = 2, every: int = 3, seed: int = 1, kind: str = "3T") -> Observations:
    return planted_observations(kind, places, shots, np.random.default_rng(seed), register_every=every)


def judged(obs: Observations, **limits: float) -> Judgement:
    return judge(obs, [Limit.of(name, value) for name, value in limits.items()], np.random.default_rng(0))


def changed(obs: Observations, **fields: object) -> Observations:
    return Observations(**({name: getattr(obs, name) for name in obs.__dataclass_fields__} | fields))


def texts(judgement: Judgement) -> str:
    return "\n".join(alert.text for alert in judgement.alerts)


def test_clear_limits_pass_and_fail() -> None:
    # The planted position error is 1.04 mm RMS, the attitude error 0.33 deg RMS.
    found = judged(bench(), position_rms_mm=3.0, attitude_rms_deg=0.1, position_bias_mm=2.0)
    assert [v.verdict for v in found.verdicts] == ["pass", "fail", "pass"]
    assert found.verdict == "fail"
    assert "3 directions" in texts(found)
    assert judged(bench(), position_rms_mm=3.0, availability_percent=50.0).verdict == "pass"


def test_a_limit_inside_the_interval_is_inconclusive() -> None:
    value = judged(bench(), position_rms_mm=1.0).verdicts[0].value
    found = judged(bench(), position_rms_mm=value * 1.01)
    assert found.verdict == "inconclusive"
    assert "straddles" in found.verdicts[0].reason


def test_no_limits_is_inconclusive_and_says_so() -> None:
    found = judged(bench())
    assert found.verdict == "inconclusive"
    assert "no limits" in texts(found)


def test_p95_and_max_need_enough_stations() -> None:
    few = judged(bench(), position_p95_mm=50.0, position_max_mm=50.0)
    assert [v.verdict for v in few.verdicts] == ["inconclusive", "inconclusive"]
    assert all(np.isinf(v.high) for v in few.verdicts)
    many = judged(bench(places=130, shots=1, every=3), position_p95_mm=50.0, position_max_mm=50.0)
    assert [v.verdict for v in many.verdicts] == ["pass", "pass"]
    # One capture beyond a maximum is proof, however few there are.
    assert judged(bench(), position_max_mm=0.1).verdicts[0].verdict == "fail"


@pytest.mark.parametrize("places", [0, 2, 5])
def test_too_few_stations_is_inconclusive_never_an_exception(places: int) -> None:
    obs = bench(places=12)
    cut = obs.select(obs.station < places)
    found = judged(cut, position_rms_mm=3.0, availability_percent=50.0)
    assert found.registration is None
    assert found.summary is None
    assert found.verdict == "inconclusive"
    assert found.verdicts[0].verdict == "inconclusive"
    assert found.alerts[0].level == "error"
    assert "at least 3 stations" in found.alerts[0].text


def test_all_misses_is_inconclusive_and_counts_them() -> None:
    obs = bench()
    nothing = changed(obs, is_solved=np.zeros(obs.count, dtype=np.bool_), reason=("blobs/too_few_blobs",) * obs.count)
    found = judged(nothing, availability_percent=90.0)
    assert found.availability.reasons == {"blobs/too_few_blobs": obs.count}
    assert found.verdict == "fail"
    assert found.availability.fraction.value == 0.0


def test_judging_stations_without_a_pose_leave_no_figure() -> None:
    obs = bench()
    solved = obs.has_role("register")
    found = judged(changed(obs, is_solved=solved, reason=("a/b",) * obs.count), position_rms_mm=3.0)
    assert found.registration is not None
    assert found.summary is None
    assert found.verdict == "inconclusive"
    assert "no station that judges has a pose" in texts(found)


def test_few_judging_stations_have_no_interval() -> None:
    found = judged(bench(places=9, shots=4, every=2), position_rms_mm=30.0)
    assert found.verdicts[0].verdict == "inconclusive"
    assert "at least 8" in found.verdicts[0].reason


def test_one_role_judges_every_fifth_by_the_others() -> None:
    obs = bench(places=40, every=0)
    found = judged(obs, position_rms_mm=3.0)
    assert found.table is not None
    assert found.table.count == obs.count
    assert found.verdict == "pass"
    assert "other four fifths" in found.split
    assert found.in_sample_summary is not None
    assert found.summary is not None
    inside, outside = (s.components["position"].rms.value for s in (found.in_sample_summary, found.summary))
    assert outside > inside
    with_six = obs.select(obs.station < 5)
    assert "one role" in texts(judged(with_six, position_rms_mm=3.0))


def test_same_seed_same_judgement() -> None:
    first, second = judged(bench(), position_rms_mm=1.1), judged(bench(), position_rms_mm=1.1)
    assert first.verdicts == second.verdicts
    assert first.summary == second.summary


def test_a_revisited_place_counts_once() -> None:
    obs = bench(places=30, shots=2)
    revisited = changed(obs, place=obs.station % 15)
    found = judged(revisited, position_rms_mm=3.0)
    assert found.summary is not None
    assert found.summary.station_count == 10
    spread = changed(obs, place=obs.station % 10)
    assert "both register and judge" in texts(judged(spread, position_rms_mm=3.0))


def test_overconfident_covariance_is_reported() -> None:
    obs = bench(places=120, every=2)
    proud = changed(obs, covariance=obs.covariance / 9.0)
    found = judge(proud, [], np.random.default_rng(0), gantry_sigma_m=0.0)
    assert found.summary is not None
    assert found.summary.consistency.verdict == "inconsistent"
    assert "too small" in texts(found)
    few = judged(bench(places=9, every=2))
    assert few.summary is not None
    # Four places cannot show that sigmas are right, though nothing speaks against them.
    assert few.summary.consistency.verdict == "inconclusive"
    many = judge(obs, [], np.random.default_rng(0), gantry_sigma_m=0.0)
    assert many.summary is not None
    assert many.summary.consistency.verdict == "consistent"
    # Nine times the stated variance, diluted a little by the registration's share; 60 places know it to 7 %.
    assert found.summary.consistency.mean_nees_over_6.value == pytest.approx(8.0, abs=2.0)


def test_an_outlier_is_counted_and_kept() -> None:
    obs = bench(places=40)
    t_m = obs.t_cb_m.copy()
    wrong = int(np.flatnonzero(~obs.has_role("register"))[4])
    t_m[wrong] += np.array([0.2, 0.0, 0.0])
    found = judged(changed(obs, t_cb_m=t_m), position_max_mm=100.0)
    assert found.summary is not None
    assert found.summary.outlier_count == 1
    # 200 mm of planted error, less 1 mm of noise.
    assert found.verdicts[0].value == pytest.approx(200.0, abs=4.0)
    assert found.verdict == "fail"


def test_interrupted_run_says_so() -> None:
    found = judge(bench(), [], np.random.default_rng(0), run_completed=False)
    assert "did not reach its end" in texts(found)


def test_limit_refuses_unknown_quantities_and_units() -> None:
    with pytest.raises(ValueError, match="unknown quantity"):
        Limit.of("position_rms", 1.0)
    with pytest.raises(ValueError, match="in mm, not in deg"):
        Limit("position_rms_mm", "max", 1.0, "deg")
    assert Limit.of("availability_percent", 90.0).bound == "min"


def test_registration_refuses_what_cannot_be_registered() -> None:
    obs = bench(places=8, shots=2, every=0)
    with pytest.raises(RegistrationError, match="at least 3 stations"):
        fit_registration(obs, obs.station < 2)
    still = changed(obs, t_gs_m=np.zeros_like(obs.t_gs_m))
    with pytest.raises(RegistrationError, match="did not move"):
        fit_registration(still)
    with pytest.raises(RegistrationError, match="positive definite"):
        fit_registration(changed(obs, covariance=-obs.covariance))


def test_blind_spots_name_the_parts() -> None:
    assert fit_registration(bench(every=0)).blind_spots == (
        "the beacon's offset on the carriage cannot be told from the camera's offset from the gantry zero: "
        "only their sum is seen (3 directions)",
    )
    turning = fit_registration(bench(every=0, kind="3T1R"))
    assert "along the y axis of the carriage" in turning.blind_spots[0]
    line = fit_registration(bench(every=0, kind="line"))
    assert "rotation about the direction (0.600, 0.000, 0.800)" in line.blind_spots[1]
    rides = planted_observations("3T", 9, 1, np.random.default_rng(1), Noise(), mount="camera_on_carriage")
    assert fit_registration(rides).blind_spots[0].startswith("the camera's offset on the carriage")


def test_order_statistics_know_when_there_are_too_few() -> None:
    sizes = np.linspace(0.0, 1.0, 59)
    rng = np.random.default_rng(0)
    # 59 values bound 95 % with 95 % confidence, 58 do not; the 95th percentile two-sided needs 73.
    assert max_interval(sizes, Clusters.of(np.arange(59), rng)).high == 1.0
    assert np.isinf(max_interval(sizes[:58], Clusters.of(np.arange(58), rng)).high)
    assert np.isinf(quantile_interval(sizes, 0.95, Clusters.of(np.arange(59), rng)).high)
    enough = np.linspace(0.0, 1.0, 100)
    found = quantile_interval(enough, 0.95, Clusters.of(np.arange(100), rng))
    # Binomial(100, 0.95): the 90th and the 100th smallest value enclose the percentile with more than 95 %, the 91st
    # and the 99th with less: 0.9941 and 0.9629 above, so a share 1 / (1 + 99 / 19 * 0.0191 / 0.0121) of the last step.
    assert 89.0 / 99.0 < found.low < 90.0 / 99.0
    assert found.high == pytest.approx((98.0 + 0.108) / 99.0, abs=1e-4)


def test_fraction_without_failures_is_bounded_by_places() -> None:
    clusters = Clusters.of(np.repeat(np.arange(30), 10), np.random.default_rng(0))
    found = fraction_interval(np.ones(300, dtype=np.bool_), clusters)
    # 0.025^(1/30): thirty places without a failure, not three hundred captures.
    assert found.low == pytest.approx(0.8843, abs=1e-4)
    assert found.high == 1.0
