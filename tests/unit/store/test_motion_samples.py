"""Samples in motion on disk and as what is judged."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np

from tests.helpers.synthetic_run import synthetic_run
from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.store.observations import observations_from_run
from uvgs_bench.store.run_format import line_from_sample, sample_from_line


def test_a_sample_in_motion_comes_back_to_the_last_bit() -> None:
    (sample, *_) = synthetic_run(stations=3).samples
    moving = replace(
        sample, velocity=np.array([0.1 / 3.0, 0.0, -1e-3]), active="red", switched="commanded", held_age_s=0.1
    )
    again = sample_from_line(line_from_sample(moving))
    np.testing.assert_array_equal(again.velocity, moving.velocity)
    assert (again.active, again.switched, again.held_age_s, again.is_moving) == ("red", "commanded", 0.1, True)


def test_a_sample_at_rest_says_nothing_of_motion() -> None:
    (sample, *_) = synthetic_run(stations=3).samples
    record = json.loads(line_from_sample(sample))
    assert not {"velocity", "active", "switched", "held_age_s"} & set(record)
    assert not sample_from_line(json.dumps(record)).is_moving


def test_axis_rates_become_the_carriage_velocity_and_its_side_of_the_play() -> None:
    run = synthetic_run(stations=3)
    rates = np.array([0.03, -0.02, 0.0])
    moved = replace(run, samples=(replace(run.samples[0], velocity=rates), *run.samples[1:]))
    found = observations_from_run(moved)
    directions = np.array([axis.scale * axis.direction for axis in run.manifest.axes])
    # m/s: rounding of a difference of positions over 2 ms.
    np.testing.assert_allclose(found.velocity_gs_mps[0], rates @ directions, atol=1e-12)
    assert not found.velocity_gs_mps[1:].any()
    np.testing.assert_array_equal(found.approach[0], [1, -1, 0])


def test_a_carriage_that_only_turns_is_not_at_rest() -> None:
    run = synthetic_run(stations=3)
    turning = Axis("A", "rotary", np.array([0.0, 0.0, 1.0]), -1.0, 1.0, 0.5, 1.0)
    samples = tuple(
        replace(s, position=np.append(s.position, 0.1), target=np.append(s.target, 0.1), velocity=np.zeros(4))
        for s in run.samples
    )
    first = replace(samples[0], velocity=np.array([0.0, 0.0, 0.0, 0.3]))
    manifest = replace(run.manifest, axes=(*run.manifest.axes, turning))
    found = observations_from_run(replace(run, manifest=manifest, samples=(first, *samples[1:])))
    np.testing.assert_allclose(found.turn_gs_radps[0], [0.0, 0.0, 0.3], atol=1e-9)
    assert not found.velocity_gs_mps.any()
    assert found.is_moving.tolist() == [True] + [False] * (len(samples) - 1)
