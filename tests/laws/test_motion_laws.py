"""Motions of the mock controller keep the laws of a step generator: limits held, ends exact, no jumps."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from uvgs_bench.devices.sim.grbl_motion import path_limits, run_into, through, trapezoid

POINT = st.tuples(*[st.floats(-500.0, 500.0)] * 3).map(np.array)
LIMITS = st.tuples(*[st.floats(1.0, 100.0)] * 3).map(np.array)
# Rounding of sums of numbers up to 1000 in double precision, with a wide margin.
TIGHT = 1e-8


@given(POINT, POINT, LIMITS, LIMITS, st.floats(0.1, 200.0), st.floats(0.0, 1e4))
def test_limits_are_held_and_the_end_is_exact(start, end, speeds, accelerations, feed, start_s) -> None:
    fastest, acceleration = path_limits(end - start, speeds, accelerations)
    motion = trapezoid(start, end, start_s, min(feed, fastest), acceleration)
    np.testing.assert_array_equal(motion.position(start_s), start)
    np.testing.assert_array_equal(motion.position(motion.end_s), end)
    times = np.linspace(start_s, motion.end_s, 201)
    velocities = np.array([motion.velocity(t) for t in times])
    positions = np.array([motion.position(t) for t in times])
    assert np.all(np.abs(velocities) <= speeds * (1 + 1e-9) + TIGHT)
    assert np.all(np.linalg.norm(velocities, axis=1) <= feed * (1 + 1e-9) + TIGHT)
    step_s = times[1] - times[0]
    assert np.all(np.abs(np.diff(velocities, axis=0)) <= accelerations * step_s * (1 + 1e-6) + TIGHT)
    # The mean speed of a step lies between two speeds that differ by at most acceleration times step.
    moved = np.diff(positions, axis=0)
    mean = 0.5 * (velocities[1:] + velocities[:-1]) * step_s
    assert np.all(np.abs(moved - mean) <= accelerations * step_s**2 + TIGHT)


@given(POINT, POINT, LIMITS, LIMITS, st.floats(0.0, 1.2))
def test_braking_stays_on_the_path_and_within_the_limits(start, end, speeds, accelerations, share) -> None:
    fastest, acceleration = path_limits(end - start, speeds, accelerations)
    motion = trapezoid(start, end, 1.0, fastest, acceleration)
    at_s = 1.0 + share * (motion.end_s - 1.0)
    braked = motion.braked(at_s)
    for t_s in np.linspace(0.9, min(at_s, motion.end_s), 20):
        np.testing.assert_allclose(braked.position(t_s), motion.position(t_s), atol=TIGHT)
    distance, speed = motion.along_path(at_s)
    np.testing.assert_allclose(braked.end_s - min(at_s, motion.end_s), speed / acceleration, atol=TIGHT)
    rest = float(np.linalg.norm(braked.end - start))
    np.testing.assert_allclose(rest, distance + speed**2 / acceleration / 2, rtol=1e-9, atol=1e-6)
    assert rest <= float(np.linalg.norm(end - start)) + TIGHT
    times = np.linspace(at_s, braked.end_s, 50)
    assert np.all(np.diff([braked.along_path(t)[1] for t in times]) <= TIGHT)


@given(POINT, POINT, st.floats(1.0, 50.0), st.floats(1.0, 500.0))
def test_running_into_a_switch_ends_at_the_switch(start, end, speed, acceleration) -> None:
    motion = run_into(start, end, 0.0, speed, acceleration)
    np.testing.assert_array_equal(motion.position(motion.end_s), end)
    just_before = motion.along_path(motion.end_s - 1e-9)[0]
    np.testing.assert_allclose(just_before, np.linalg.norm(end - start), atol=1e-6)


def test_a_known_trapezoid() -> None:
    """100 mm at 50 mm/s and 200 mm/s^2: 0.25 s up, 87.5 mm in 1.75 s, 0.25 s down."""
    motion = trapezoid(np.zeros(3), np.array([100.0, 0.0, 0.0]), 0.0, 50.0, 200.0)
    assert abs(motion.end_s - 2.25) < 1e-12
    np.testing.assert_allclose(motion.position(0.25), [6.25, 0, 0], atol=1e-12)
    np.testing.assert_allclose(motion.position(1.125), [50, 0, 0], atol=1e-12)
    np.testing.assert_allclose(motion.velocity(1.0), [50, 0, 0], atol=1e-12)


def test_no_path_takes_no_time() -> None:
    motion = trapezoid(np.ones(3), np.ones(3), 2.0, 5.0, *path_limits(np.zeros(3), np.ones(3), np.ones(3))[1:])
    assert motion.end_s == 2.0
    np.testing.assert_array_equal(motion.velocity(2.0), 0.0)


@given(POINT, POINT, st.floats(0.0, 50.0), st.floats(0.0, 50.0), st.floats(50.0, 100.0), st.floats(10.0, 500.0))
def test_a_motion_handed_over_keeps_speeds_and_its_end(start, end, entry, leaving, speed, acceleration) -> None:
    length = float(np.linalg.norm(end - start))
    motion = through(start, end, 2.0, entry, leaving, speed, acceleration)
    np.testing.assert_array_equal(motion.position(motion.end_s), end)
    # A picometre at these speeds takes less time than is left off at its end.
    if length < 1e-9:
        return
    times = np.linspace(2.0, motion.end_s - 1e-12, 101)
    speeds = np.array([motion.along_path(t)[1] for t in times])
    assert np.all(np.abs(np.diff(speeds)) <= acceleration * (times[1] - times[0]) * (1 + 1e-6) + 1e-6)
    assert speeds.max() <= speed * (1 + 1e-9) + TIGHT
    reach = np.sqrt(entry**2 + 2.0 * acceleration * length)
    at_least = np.sqrt(max(entry**2 - 2.0 * acceleration * length, 0.0))
    np.testing.assert_allclose(motion.exit_speed, max(min(leaving, reach), at_least), rtol=1e-6, atol=2e-5)
    # Near the end the speed is that of the hand-over: 1e-12 s before it.
    np.testing.assert_allclose(speeds[-1], motion.exit_speed, rtol=1e-6, atol=2e-5)
    changed = motion.going_on(0.5 * (2.0 + motion.end_s), speed, 0.0)
    np.testing.assert_array_equal(changed.position(changed.end_s), end)
    assert changed.end_s >= motion.end_s - 1e-9
