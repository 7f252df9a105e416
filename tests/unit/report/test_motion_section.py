"""The chapter on the motion of a run: told, reported and seen, held poses apart."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.helpers.synthetic_run import synthetic_run
from uvgs_bench.report.document import Figure, Table
from uvgs_bench.report.sections.motion import build
from uvgs_bench.sensor.outcome import Miss
from uvgs_bench.store.judging import judge_run
from uvgs_bench.store.run import Run


def driven_run() -> Run:
    """A synthetic run whose last stations were a motion past two beacons, one miss held."""
    run = synthetic_run(Path("reports/20260102T030405Z_driven"), stations=30, shots=1, miss_every=0)
    count = 20
    samples = list(run.samples)
    for i in range(count, 30):
        samples[i] = replace(
            samples[i],
            target=samples[i].position + 1e-3,
            velocity=np.array([0.02, 0.0, 0.0]),
            role="judge",
            active="blue" if i < 25 else "red",
        )
    miss = Miss("blobs", "too_few_blobs", "", samples[26].t_ns, "red")
    samples[26] = replace(samples[26], outcome=miss, held_age_s=0.7)
    return replace(run, manifest=replace(run.manifest, station_count=count), samples=tuple(samples))


def test_a_motion_is_drawn_with_what_was_held() -> None:
    run = driven_run()
    section = build(run, judge_run(run))
    assert section is not None
    figures = {block.key: block for block in section.blocks if isinstance(block, Figure)}
    assert set(figures) == {"motion-time", "motion-path"}
    assert "red from" in figures["motion-time"].alt
    named = {item.name: np.array(item.values) for item in figures["motion-time"].series}
    # What was told is 1 mm beside what was reported, in every axis.
    np.testing.assert_allclose(named["X told"] - named["X reported"], 1.0, atol=1e-9)
    # Seen through the registration: within the planted noise of some mm, and nothing where it was missed.
    off = named["X seen"] - named["X reported"]
    assert np.isnan(off[6])
    assert np.nanmax(np.abs(off)) < 10.0
    (table,) = [block for block in section.blocks if isinstance(block, Table)]
    numbers = {str(row[0]): row[1].value for row in table.rows}  # type: ignore[union-attr]
    assert numbers["Misses filled by a held pose"] == 1
    assert numbers["Changes of the beacon"] == 1
    assert numbers["Taken while moving"] == 10


def test_a_run_at_rest_has_no_such_chapter() -> None:
    run = synthetic_run(stations=6, shots=1)
    assert build(run, judge_run(run)) is None
