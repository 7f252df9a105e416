"""What a run keeps of each capture for the diagnosis: clipped LEDs, and where the LEDs of a refused fit were seen."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.helpers.synthetic_run import synthetic_run
from uvgs_bench.sensor.outcome import Miss
from uvgs_bench.store.observations import observations_from_run
from uvgs_bench.store.run_format import line_from_sample, sample_from_line

LED_PX = np.array([[1.0, 2.0], [3.5, 4.5], [np.nan, np.nan], [7.0, 8.0]])


def test_a_refused_fit_and_clipped_leds_survive_the_journal() -> None:
    sample = synthetic_run(stations=3, shots=1).samples[0]
    miss = Miss("validate", "residual_too_large", "3 px", sample.t_ns, "tetra_small", 4, led_px=LED_PX)
    again = sample_from_line(line_from_sample(replace(sample, outcome=miss, clipped_leds=2)))
    assert again.clipped_leds == 2
    assert again.outcome.led_px is not None
    np.testing.assert_array_equal(again.outcome.led_px, LED_PX)


@pytest.mark.parametrize("key", ["clipped_leds", "led_px"])
def test_older_journals_say_nothing_of_it(key: str) -> None:
    sample = synthetic_run(stations=3, shots=1).samples[0]
    miss = Miss("validate", "residual_too_large", "3 px", sample.t_ns, "tetra_small", 4, led_px=LED_PX)
    record = json.loads(line_from_sample(replace(sample, outcome=miss, clipped_leds=2)))
    del record[key]
    again = sample_from_line(json.dumps(record))
    assert (again.clipped_leds if key == "clipped_leds" else again.outcome.led_px) is None


def test_observations_carry_both() -> None:
    run = synthetic_run(stations=6, shots=1)
    first = run.samples[0]
    miss = Miss("validate", "residual_too_large", "3 px", first.t_ns, "tetra_small", 4, led_px=LED_PX)
    samples = (replace(first, outcome=miss), replace(run.samples[1], clipped_leds=1), *run.samples[2:])
    obs = observations_from_run(replace(run, samples=samples))
    np.testing.assert_array_equal(obs.led_px[0], LED_PX)
    assert obs.is_saturated.tolist()[:3] == [False, True, False]
