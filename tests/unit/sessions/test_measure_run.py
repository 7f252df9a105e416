"""Measuring a beacon from a run whose carriage also turns, from the names it recorded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers.synthetic_run import CAMERA_FROM_GANTRY, axes, beacon, calibration, synthetic_run
from uvgs_bench.beacon.measure import MeasureConfig
from uvgs_bench.devices.gantry.axes import Axis, gantry_from_carriage
from uvgs_bench.geometry import Pose
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.sessions.events import Event, Remark
from uvgs_bench.sessions.measure_beacon import measure_from_run
from uvgs_bench.store.run import Run

TURN_RAD = 0.5
SIGMA_PX = 0.05


def turning_run() -> tuple[Run, int]:
    """Stations before the camera, every third turned to either side, and how many are not turned."""
    rng = np.random.default_rng(4)
    run = synthetic_run(stations=60, shots=1, miss_every=0)
    turning = (*axes(), Axis("A", "rotary", np.array([1.0, 1.0, 0.0]), -1.0, 1.0, 0.5, 2.0))
    samples = []
    for i, sample in enumerate(run.samples):
        turn = TURN_RAD * (i // 3 % 2 * 2 - 1) if i % 3 == 2 else 0.0
        position = np.array([*rng.uniform([0.1, 0.1, 0.0], [0.4, 0.3, 0.3]), turn])
        # The beacon sits off the axis of rotation, where its turned stations are elsewhere.
        on_carriage = Pose(np.eye(3), np.array([0.01, -0.02, 0.03]), "carriage", "beacon")
        true = CAMERA_FROM_GANTRY @ gantry_from_carriage(turning, position) @ on_carriage
        px = calibration().lens.project(true.apply(beacon().positions_m)) + rng.normal(0.0, SIGMA_PX, (4, 2))
        outcome = sample.outcome
        assert isinstance(outcome, PoseEstimate)
        seen = replace(outcome, camera_from_beacon=true, led_px=px)
        samples.append(replace(sample, position=position, outcome=seen))
    manifest = replace(run.manifest, axes=turning)
    return replace(run, manifest=manifest, samples=tuple(samples)), 40


@pytest.mark.parametrize("by", ["gantry", "free"])
def test_a_carriage_that_turns_gives_stations_at_one_attitude_or_free_views(by):
    run, straight = turning_run()
    said: list[Event] = []
    config = MeasureConfig(by, worst_sigma_m=1e-3)
    found = measure_from_run(run, beacon(), calibration(), config, sink=said.append).measurement
    assert found.by == by
    assert found.view_count == (straight if by == "gantry" else 60)
    remarks = [event.text for event in said if isinstance(event, Remark)]
    assert any("20 captures at other attitudes" in text for text in remarks) is (by == "gantry")
    for d in found.distances:
        # Four deviations of each of six distances.
        assert abs(d.distance_m - d.nominal_m) < 4.0 * d.sigma_m
