"""What of the set-up does not fit is named, with a doubt that holds, and what cannot be told is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers.fusion_bag import drawn_source
from tests.helpers.fusion_flight import fly
from uvgs_bench.geometry import Pose
from uvgs_bench.navigation.delays import find_misfit
from uvgs_bench.navigation.fusion_data import FalsePoses, with_false_poses
from uvgs_bench.navigation.fusion_outcome import misfit_lines, untold

BODY_FROM_CAMERA = Pose.exp((-1.2, 1.2, -1.2, 0.1, 0.0, 0.05), "body", "camera")
WORLD_FROM_BEACON = Pose.exp((-1.2, 1.2, -1.2, 1.2, 0.1, 0.0), "world", "beacon")


@pytest.fixture(scope="module")
def flown():
    flight = fly(6)
    whole = drawn_source(flight, WORLD_FROM_BEACON, BODY_FROM_CAMERA)
    return flight, replace(whole, sensed=whole.sensed[:110])


def misfit_of(flown, source):
    found = find_misfit(source.imu, source.sensed, source.world_from_beacon, source.body_from_camera, flown[0].config)
    assert found is not None
    return found


def test_a_set_up_that_fits(flown):
    found = misfit_of(flown, flown[1])
    assert misfit_lines(found) == ()
    # Some 650 numbers: the mean square of right innovations lies within 0.2 of 1.
    assert found.surprise_before == pytest.approx(1.0, abs=0.2)
    values = np.concatenate(([found.offset_s], found.rotation_rad, found.shift_m))
    assert (np.abs(values) < 4.0 * found.sigma)[list(found.is_known)].all()


@pytest.mark.parametrize("offset_s", [0.05, -0.18])
def test_a_clock_offset_is_named_with_its_size(flown, offset_s):
    source = replace(flown[1], imu=flown[1].imu.shifted(round(-offset_s * 1e9)))
    found = misfit_of(flown, source)
    assert found.offset_s == pytest.approx(offset_s, abs=max(4.0 * found.sigma[0], 0.005))
    (line,) = misfit_lines(found)
    assert "clocks" in line
    assert ("late" if offset_s > 0 else "early") in line


def test_a_wrong_mounting_is_named(flown):
    wrong = np.array([0.05, 0.0, -0.04, 0.0, 0.0, 0.0])
    source = replace(flown[1], body_from_camera=BODY_FROM_CAMERA @ Pose.exp(-wrong, "camera", "camera"))
    found = misfit_of(flown, source)
    assert (np.abs(found.rotation_rad - wrong[:3]) < 4.0 * found.sigma[1:4] + 2e-3).all()
    assert any("turned" in line for line in misfit_lines(found))


def test_false_poses_do_not_lead(flown):
    spoilt, _ = with_false_poses(flown[1], FalsePoses(0.05, 0.3, 1))
    found = misfit_of(flown, replace(spoilt, imu=spoilt.imu.shifted(-50_000_000)))
    assert found.offset_s == pytest.approx(0.05, abs=max(4.0 * found.sigma[0], 0.005))


def test_a_body_at_rest_tells_nothing_of_its_clock(flown):
    flight, source = flown
    rest = [pose for pose in source.sensed if pose.t_ns < 900_000_000]
    still = tuple(replace(rest[k % len(rest)], t_ns=100_000_000 + k * 10_000_000) for k in range(60))
    found = find_misfit(source.imu.between(0, 900_000_000), still, WORLD_FROM_BEACON, BODY_FROM_CAMERA, flight.config)
    assert found is not None
    assert not found.is_known[0]
    assert "clock offset" in untold(found)


def test_too_little_data_is_an_absence(flown):
    flight, source = flown
    nothing = source.imu.between(0, 0)
    for imu, sensed in ((nothing, source.sensed), (source.imu, source.sensed[:10])):
        assert find_misfit(imu, sensed, WORLD_FROM_BEACON, BODY_FROM_CAMERA, flight.config) is None
