"""What holds for every run: identities of the figures, invariance to frames, and verdicts that never contradict."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.planted_bench import planted_observations
from tests.helpers.strategies import poses
from uvgs_bench.accuracy import Limit, error_table, fit_registration, judge
from uvgs_bench.accuracy.clusters import Clusters
from uvgs_bench.accuracy.intervals import moment_intervals
from uvgs_bench.accuracy.judgement import QUANTITIES
from uvgs_bench.accuracy.order_intervals import fraction_interval, max_interval, quantile_interval
from uvgs_bench.accuracy.tangent import adjoints, pose_logs, rotation_logs
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import se3_adjoint, se3_log


@given(st.lists(poses(), min_size=1, max_size=5))
def test_batched_maps_agree_with_the_scalar_ones(several: list[Pose]) -> None:
    R = np.array([pose.R for pose in several])
    t_m = np.array([pose.t_m for pose in several])
    # 1e-6: at half a turn the sign and the last digits of a logarithm depend on rounding; compare the poses they mean.
    for pose, xi in zip(several, pose_logs(R, t_m), strict=True):
        again = Pose.exp(xi, pose.target, pose.source)
        np.testing.assert_allclose(again.matrix(), pose.matrix(), atol=1e-6 * (1.0 + np.abs(pose.t_m).max()))
        if np.linalg.norm(xi[:3]) < 3.0:
            np.testing.assert_allclose(xi, se3_log(pose.R, pose.t_m), atol=1e-9 * (1.0 + np.abs(pose.t_m).max()))
    expected = [se3_adjoint(pose.R, pose.t_m) for pose in several]
    np.testing.assert_allclose(adjoints(R, t_m), expected, atol=1e-12 * (1.0 + np.abs(t_m).max()))


def test_rotation_logs_keep_their_digits_near_zero() -> None:
    w = np.array([[1e-9, -2e-9, 3e-9], [1e-5, 0.0, 0.0]])
    R = np.array([Pose.exp([*x, 0.0, 0.0, 0.0], "camera", "beacon").R for x in w])
    # 1e-15 rad: rounding of matrix entries near one does not reach the small angle.
    np.testing.assert_allclose(rotation_logs(R), w, atol=1e-15)


@given(seed=st.integers(0, 10_000), places=st.integers(8, 25), shots=st.integers(1, 4), d=st.sampled_from([1, 3]))
@settings(max_examples=25)
def test_figures_obey_their_identities(seed: int, places: int, shots: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    errors = rng.normal(size=(places * shots, d)) + rng.normal(size=d)
    clusters = Clusters.of(np.repeat(np.arange(places), shots), rng)
    found = moment_intervals(errors, np.zeros((len(errors), d, 12)), clusters)
    assert np.isclose(found.rms.value**2, found.bias.value**2 + found.spread.value**2, rtol=1e-9)
    sizes = np.linalg.norm(errors, axis=1)
    median, p95, top = (
        quantile_interval(sizes, 0.5, clusters),
        quantile_interval(sizes, 0.95, clusters),
        max_interval(sizes, clusters),
    )
    assert median.value <= p95.value <= top.value
    for each in (found.bias, found.spread, found.rms, median, p95, top):
        assert each.low <= each.value <= each.high
        assert each.station_count == places
        assert each.capture_count == places * shots


@given(solved=st.lists(st.booleans(), min_size=1, max_size=40))
def test_fraction_interval_holds_the_fraction(solved: list[bool]) -> None:
    flags = np.array(solved)
    clusters = Clusters.of(np.arange(len(flags)) // 2, np.random.default_rng(0))
    found = fraction_interval(flags, clusters)
    assert 0.0 <= found.low <= found.value <= found.high <= 1.0
    assert found.low < found.high


@given(seed=st.integers(0, 1000), moved=poses())
@settings(max_examples=10)
def test_errors_do_not_depend_on_where_the_gantry_zero_is(seed: int, moved: Pose) -> None:
    obs = planted_observations("3T1R", 8, 2, np.random.default_rng(seed))
    shift = Pose(moved.R, moved.t_m / (1.0 + np.linalg.norm(moved.t_m)), "gantry", "gantry")
    fields = {name: getattr(obs, name) for name in obs.__dataclass_fields__}
    fields |= {"R_gs": shift.R @ obs.R_gs, "t_gs_m": shift.apply(obs.t_gs_m)}
    other = type(obs)(**fields)
    here, there = (error_table(o, fit_registration(o)) for o in (obs, other))
    # 1e-8 m and rad: where the least squares stops.
    np.testing.assert_allclose(here.translation_error_m, there.translation_error_m, atol=1e-8)
    np.testing.assert_allclose(here.rotation_error_rad, there.rotation_error_rad, atol=1e-8)


@given(quantity=st.sampled_from(sorted(QUANTITIES)), value=st.floats(1e-4, 200.0), seed=st.integers(0, 5))
@settings(max_examples=20)
def test_verdicts_follow_the_interval(quantity: str, value: float, seed: int) -> None:
    obs = planted_observations("3T", 18, 2, np.random.default_rng(seed), register_every=2)
    (verdict,) = judge(obs, [Limit.of(quantity, value)], np.random.default_rng(0)).verdicts
    low, high = verdict.low, verdict.high
    inside = high <= value if verdict.limit.bound == "max" else low >= value
    outside = low > value if verdict.limit.bound == "max" else high < value
    assert verdict.verdict == ("pass" if inside else "fail" if outside else "inconclusive")
    assert verdict.reason
