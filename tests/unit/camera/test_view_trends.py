"""What changes from picture to picture is found, and noise alone is not taken for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uvgs_bench.camera import BoardView, calibrate
from uvgs_bench.sessions.calibration_benchmark import drawn_views

MIDDLE = np.array([645.0, 470.0])


def moved_focus(views: list[BoardView], drift: float) -> list[BoardView]:
    """Pixels as a lens draws them whose scale grows by ``drift`` from the first to the last view."""
    scales = 1.0 + np.linspace(-0.5, 0.5, len(views)) * drift
    return [replace(view, px=MIDDLE + (view.px - MIDDLE) * scale) for view, scale in zip(views, scales, strict=True)]


def test_steady_pictures_show_no_drift_and_no_streaks():
    drifts = []
    for seed in range(12):
        result = calibrate(drawn_views("plumb_bob", 9, 6, 15, np.random.default_rng(seed)), "plumb_bob")
        assert result.trends.streaks == ()
        drifts.append(result.trends.drift / result.trends.drift_sigma)
    # Standard normal: the mean square of twelve lies below 2.7 but once in a thousand.
    assert np.mean(np.square(drifts)) < 2.7


def test_a_moving_focus_is_measured_and_refused():
    views = moved_focus(drawn_views("plumb_bob", 9, 6, 15, np.random.default_rng(1)), 0.01)
    result = calibrate(views, "plumb_bob")
    trends = result.trends
    # Each picture knows its focal length to 0.1 %; four deviations. The distance takes up a part of the change, but
    # only in the mean.
    assert abs(trends.drift - 0.01) < 4.0 * trends.drift_sigma
    verdict = result.calibration.verdict
    assert verdict.word == "not_usable"
    assert any("the focus moved" in reason for reason in verdict.reasons)


def test_pictures_in_motion_are_named_with_their_direction():
    rng = np.random.default_rng(2)
    views = drawn_views("plumb_bob", 9, 6, 12, rng)
    views[4] = replace(views[4], px=views[4].px + rng.normal(0.0, 0.5, (54, 1)) * np.array([1.0, 0.0]))
    result = calibrate(views, "plumb_bob")
    (streak,) = result.trends.streaks
    assert streak.view == 4
    # Along the columns' axis: within 10 degrees of 0 or pi.
    assert abs(np.sin(streak.direction_rad)) < np.sin(np.radians(10.0))
    assert any("view 4 lie along one direction" in reason for reason in result.calibration.verdict.reasons)
