"""The setup in a record: back to the last bit, and refused where it makes no sense."""

from __future__ import annotations

import json
from math import inf

import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.beacon import Beacon, Led
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.errors import FormatError
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.difference import DifferenceConfig
from uvgs_bench.sensor.exposure import ExposurePolicy
from uvgs_bench.sensor.handover import HandoverPolicy
from uvgs_bench.sessions.record_setup import RecordedCamera, RecordSetup, setup_from_text, setup_text
from uvgs_bench.sessions.stream import StreamRules


def random_setup(seed: int) -> RecordSetup:
    rng = np.random.default_rng(seed)
    leds = tuple(
        Led(f"l{i}", rng.normal(size=3) / 3.0, rng.normal(size=3) if i else None, rng.uniform(0.1, 3.0), 0.005 / 3.0)
        for i in range(5)
    )
    root = rng.normal(size=(15, 15)) * 1e-4
    size = spots.lens().parameters.size
    doubt = rng.normal(size=(size + 6, size + 6)) / 7.0
    joint = doubt @ doubt.T
    joint = 0.5 * (joint + joint.T)
    lens = spots.lens().with_parameters(spots.lens().parameters * (1.0 + rng.normal(size=size) / 300.0))
    covariance = joint[:size, :size]
    return RecordSetup(
        "sim:",
        Calibration(lens, "a 'camera'", covariance, 0.1 / 3.0, joint_covariance=joint, notes={"by": "me: \n too"}),
        (Beacon("b", leds, (350.0, 10.0 / 3.0), root @ root.T), spots.beacon()),
        UvgsConfig(hue_deg=(1.0 / 3.0, 20.0), max_rms_px=2.0 / 3.0),
        StreamRules(
            5, True, 2, HandoverPolicy("position", {"b": (0.1, inf)}, hold_s=0.1 + 0.2), "b", DifferenceConfig(4)
        ),
        RecordedCamera(ExposurePolicy(longest_s=0.03 / 7.0), 0.004 / 3.0, (1e-5 / 3.0, 0.1), 4095.0, 3),
        True,
        {"uvgs_bench": "0"},
    )


@pytest.mark.parametrize("seed", range(5))
def test_a_setup_comes_back_to_the_last_bit(seed):
    setup = random_setup(seed)
    back = setup_from_text(setup_text(setup), "r.mcap")
    assert setup_text(back) == setup_text(setup)
    for name in ("parameters", "rules", "camera", "is_live", "source", "versions"):
        assert getattr(back, name) == getattr(setup, name)
    for ours, theirs in zip(setup.beacons, back.beacons, strict=True):
        assert ours.hue == theirs.hue
        np.testing.assert_array_equal(ours.positions_m, theirs.positions_m)
        for led, other in zip(ours.leds, theirs.leds, strict=True):
            # A unit vector made a unit vector once more is often another one.
            assert (led.axis is None) == (other.axis is None)
            if led.axis is not None:
                np.testing.assert_array_equal(led.axis, other.axis)
            assert (led.half_angle_rad, led.diameter_m) == (other.half_angle_rad, other.diameter_m)
    np.testing.assert_array_equal(setup.beacons[0].covariance_m2, back.beacons[0].covariance_m2)
    np.testing.assert_array_equal(setup.calibration.lens.parameters, back.calibration.lens.parameters)
    np.testing.assert_array_equal(setup.calibration.covariance, back.calibration.covariance)
    np.testing.assert_array_equal(setup.calibration.joint_covariance, back.calibration.joint_covariance)


def test_what_makes_no_sense_is_one_line():
    good = json.loads(setup_text(random_setup(0)))
    for change, said in (
        ({"schema": 2}, "schema 2, expected 1"),
        ({"beacons": 3}, "cannot be read: TypeError"),
        ({"parameters": {"unknown": 1}}, "unknown"),
        ({"calibration": "no"}, "cannot be read"),
        ({"rules": {}}, "KeyError"),
    ):
        with pytest.raises(FormatError, match=r"r\.mcap: its setup") as caught:
            setup_from_text(json.dumps(good | change), "r.mcap")
        assert said in str(caught.value)
    for text in ("", "[]", "{}", '"text"'):
        with pytest.raises(FormatError, match=r"r\.mcap: its setup"):
            setup_from_text(text, "r.mcap")
