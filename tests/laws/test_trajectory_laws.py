"""Laws of trajectories: limits are never exceeded, everything is continuous, and places are reached."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from uvgs_bench.navigation.rigid import rigid_state
from uvgs_bench.navigation.trajectory import MotionLimits, PathPoint, Trajectory, plan_trajectory

coordinate = st.floats(-0.5, 0.5).map(lambda v: round(v, 3))
positive = st.floats(0.01, 1.0)


@st.composite
def plans(draw: st.DrawFn) -> tuple[list[PathPoint], MotionLimits]:
    """Places in two lengths and one angle, some the same, with limits."""
    n = draw(st.integers(1, 7))
    points = [
        PathPoint(
            np.array([draw(coordinate) for _ in range(3)]),
            dwell_s=draw(st.sampled_from([0.0, 0.0, 0.7])),
            blend=draw(st.sampled_from([0.0, 0.01, 0.05, 1.0])),
        )
        for _ in range(n)
    ]
    if draw(st.booleans()):
        points.append(points[-1])
    limits = MotionLimits(
        draw(positive),
        draw(positive),
        np.array([draw(positive) for _ in range(3)]),
        np.array([draw(positive) for _ in range(3)]),
        np.array([False, False, True]),
    )
    return points, limits


def ends(path: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position and velocity at the end of each piece, with its duration."""
    dt = np.diff(np.append(path.begin_s, path.duration_s))[:, None]
    return (
        path.position + (path.velocity + 0.5 * dt * path.acceleration) * dt,
        path.velocity + dt * path.acceleration,
        dt,
    )


@settings(max_examples=150, deadline=None)
@given(plans())
def test_no_instant_exceeds_a_limit(plan: tuple[list[PathPoint], MotionLimits]) -> None:
    points, limits = plan
    path = plan_trajectory(points, limits)
    _, v_end, _ = ends(path)
    # Velocity is linear and speed convex within a piece: its ends are its extremes. 1e-9 relative is rounding.
    for v in (path.velocity, v_end):
        assert (np.abs(v) <= limits.axis_speed * (1.0 + 1e-9) + 1e-12).all()
        linear = np.linalg.norm(v[:, :2], axis=1)
        assert (linear <= limits.speed * (1.0 + 1e-9) + 1e-12).all()
        assert (np.abs(v[linear == 0.0, 2]) <= limits.turning_speed * (1.0 + 1e-9)).all()
    assert (np.abs(path.acceleration) <= limits.axis_acceleration * (1.0 + 1e-9) + 1e-12).all()


@settings(max_examples=150, deadline=None)
@given(plans())
def test_positions_and_velocities_do_not_jump(plan: tuple[list[PathPoint], MotionLimits]) -> None:
    points, limits = plan
    path = plan_trajectory(points, limits)
    p_end, v_end, _ = ends(path)
    after_p = np.vstack((path.position[1:], path.last[None]))
    after_v = np.vstack((path.velocity[1:], np.zeros((1, 3))))
    if len(path.begin_s):
        # 1e-9 m and 1e-7 m/s: rounding of square roots of differences of speeds near zero.
        assert np.abs(p_end - after_p).max() < 1e-9
        assert np.abs(v_end - after_v).max() < 1e-7
        assert not path.velocity[0].any() or np.abs(path.velocity[0]).max() < 1e-12
    assert np.array_equal(path.state_at(-1.0).position, points[0].position)
    assert np.array_equal(path.state_at(path.duration_s + 1.0).position, points[-1].position)
    assert path.state_at(path.duration_s).place == len(points) - 1
    times = np.linspace(-0.1, path.duration_s + 0.1, 40)
    passed = [path.state_at(float(t)).place for t in times]
    assert passed == sorted(passed)
    assert passed[-1] == len(points) - 1
    each = np.array([path.state_at(float(t)).position for t in times])
    assert np.allclose(path.positions_at(times), each, rtol=0.0, atol=1e-12)


@settings(max_examples=100, deadline=None)
@given(plans())
def test_every_place_is_passed_within_its_blend(plan: tuple[list[PathPoint], MotionLimits]) -> None:
    points, limits = plan
    path = plan_trajectory(points, limits)
    begins = np.append(path.position, path.last[None], axis=0)
    for point in points:
        # In the middle of a blend a piece begins; the coordinates of a leg of 1 m are at most scaled by their ratio.
        miss = np.linalg.norm((begins - point.position)[:, :2], axis=1).min()
        assert miss <= 0.36 * point.blend + 1e-9


@settings(max_examples=50, deadline=None)
@given(plans())
def test_a_wait_is_kept_at_rest(plan: tuple[list[PathPoint], MotionLimits]) -> None:
    points, limits = plan
    path = plan_trajectory(points, limits)
    _, _, dt = ends(path)
    rests = ~(path.velocity.any(axis=1) | path.acceleration.any(axis=1))
    wanted = sum(point.dwell_s for point in points)
    assert abs(float(dt[rests].sum()) - wanted) < 1e-9  # s: rounding


def test_the_square_has_the_known_duration() -> None:
    limits = MotionLimits(0.05, 1.0, np.full(2, 1.0), np.full(2, 0.5), np.zeros(2, dtype=bool))
    corners = np.array([[0, 0], [0.3, 0], [0.3, 0.3], [0, 0.3], [0, 0]], dtype=float)
    stopped = plan_trajectory([PathPoint(c) for c in corners], limits)
    # Each side: 0.3 / 0.05 + 0.05 / 0.5 s.
    assert abs(stopped.duration_s - 4 * 6.1) < 1e-9
    blended = plan_trajectory([PathPoint(c, blend=0.01) for c in corners], limits)
    # Three corners are passed at full speed: each blend of 2 r / v replaces 2 r of straight path and a stop.
    assert abs(blended.duration_s - (4 * 0.3 / 0.05 + 0.05 / 0.5)) < 1e-9


def test_a_reversal_goes_all_the_way() -> None:
    limits = MotionLimits(0.05, 1.0, np.full(1, 1.0), np.full(1, 0.5), np.zeros(1, dtype=bool))
    path = plan_trajectory([PathPoint(np.array([v]), blend=0.1) for v in (0.0, 0.2, 0.0)], limits)
    assert path.position.max() == 0.2


def test_rates_of_a_body_are_the_derivatives_of_its_pose() -> None:
    limits = MotionLimits.rigid(0.3, 0.4, 0.8, 0.9)
    places = np.array([[0, 0, 0, 0, 0, 0], [0.5, 0.1, -0.2, 0.6, -0.4, 0.5], [0.1, 0.4, 0.3, -0.5, 0.3, -0.6]])
    path = plan_trajectory([PathPoint(p, blend=0.1) for p in places], limits)
    h = 1e-5
    for t in np.linspace(0.1, path.duration_s - 0.1, 11):
        here = rigid_state(path.state_at(float(t)))
        later, before = rigid_state(path.state_at(float(t + h))), rigid_state(path.state_at(float(t - h)))
        twist = (before.pose.inverse() @ later.pose).log() / (2 * h)
        # rad/s and rad/s^2: error of a central difference over 1e-5 s, at a step of acceleration half of it.
        assert np.abs(twist[:3] - here.rate_radps).max() < 1e-5
        alpha = (later.rate_radps - before.rate_radps) / (2 * h)
        assert np.abs(alpha - here.angular_acceleration_radps2).max() < 1e-4
        assert np.abs((later.pose.t_m - before.pose.t_m) / (2 * h) - here.velocity_mps).max() < 1e-5
