"""Changing parameters of a running sensor: what is taken, what is refused, and when."""

from __future__ import annotations

import pytest

from tests.helpers import spots
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.sessions.retune import TUNABLE, Retuner


def retuner(count: int = 1) -> tuple[dict[str, Uvgs], Retuner]:
    sensors = {f"b{k}": Uvgs(spots.calibration(), spots.beacon()) for k in range(count)}
    return sensors, Retuner(sensors, UvgsConfig(), lambda: 0.0)


def test_a_change_waits_for_the_next_capture() -> None:
    sensors, tuner = retuner()
    before = sensors["b0"]
    assert tuner.ask({"threshold_k": 3, "max_area_px2": 900.0, "solver": "opencv_iterative"}) is None
    assert sensors["b0"] is before
    assert tuner.parameters.threshold_k == 3.0
    assert tuner.apply()
    assert (sensors["b0"].config.threshold_k, sensors["b0"].config.max_area_px2) == (3.0, 900.0)
    assert sensors["b0"].config.solver == "opencv_iterative"
    assert not tuner.apply()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"threshold_k": -1.0}, "threshold_k must not be negative"),
        ({"window_px": 60}, "odd"),
        ({"threshold_q": 1.0}, "did you mean 'threshold_k'"),
        ({"threshold_k": "high"}, "threshold_k"),
        ({"solver": "no_such"}, "no_such"),
        ({"min_area_px2": 5000.0}, "max_area_px2 must exceed"),
    ],
)
def test_a_wrong_value_is_refused_and_nothing_changes(changes: dict[str, object], reason: str) -> None:
    _, tuner = retuner()
    refusal = tuner.ask(changes)
    assert refusal is not None
    assert reason in refusal
    assert "\n" not in refusal
    assert tuner.parameters == UvgsConfig()
    assert not tuner.apply()


def test_hues_belong_to_one_beacon_and_can_be_given_back() -> None:
    _, tuner = retuner()
    assert tuner.ask({"hue_deg": [350.0, 10.0]}) is None
    assert tuner.parameters.hue_deg == (350.0, 10.0)
    assert tuner.ask({"hue_deg": []}) is None
    assert tuner.parameters.hue_deg is None
    _, tuner = retuner(2)
    assert "several beacons" in str(tuner.ask({"hue_deg": [0.0, 10.0]}))


def test_every_parameter_can_be_asked_for() -> None:
    _, tuner = retuner()
    assert {"threshold_k", "hue_deg", "min_circularity"} <= set(TUNABLE)
    for name in TUNABLE:
        value = getattr(UvgsConfig(), name)
        assert tuner.ask({name: [] if value is None else value}) is None
    assert not tuner.apply()
