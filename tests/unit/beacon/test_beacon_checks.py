from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.beacon import Beacon, Led, check_beacon
from uvgs_bench.beacon.checks import relabeling_residual_m, thickness_m
from uvgs_bench.errors import ConfigError


def make(positions) -> Beacon:
    return Beacon("b", tuple(Led(f"l{i}", np.array(p, dtype=float)) for i, p in enumerate(positions)))


CLEAR = [[0.0, 0.077, 0.0], [-0.05, -0.068, -0.016], [0.054, -0.009, -0.013], [0.033, -0.048, -0.062]]


def test_a_clear_beacon_has_nothing_to_say():
    assert check_beacon(make(CLEAR)) == ()


def test_a_flat_beacon_is_named_with_its_thickness():
    warnings = check_beacon(make([[0, 0, 0], [0.1, 0.01, 0], [0.02, 0.13, 0], [0.09, 0.07, 0.001]]))
    flat = next(w for w in warnings if w.kind == "coplanar")
    assert flat.value_m < 0.002  # one LED 1 mm off the plane of the others
    assert "mm thick" in flat.text


def test_a_regular_tetrahedron_is_symmetric():
    regular = 0.05 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    kinds = {w.kind for w in check_beacon(make(regular))}
    assert kinds == {"symmetric", "mirrored"}
    residual, labeling = relabeling_residual_m(make(regular), mirrored=False)
    assert residual < 1e-8  # it fits exactly; the difference of squares keeps half of the digits
    assert labeling != (0, 1, 2, 3)


def test_a_beacon_with_a_mirror_plane_is_mirrored_but_not_symmetric():
    kite = [[0.06, 0.0, 0.0], [-0.06, 0.0, 0.0], [0.0, 0.09, 0.01], [0.0, -0.02, -0.06]]
    assert {w.kind for w in check_beacon(make(kite))} == {"mirrored"}


def test_coincident_leds_are_refused_by_name():
    with pytest.raises(ConfigError, match=r"l0 and l1 are 0\.500 mm apart"):
        check_beacon(make([[0, 0, 0], [0.0005, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]))


def test_leds_on_a_line_are_refused():
    with pytest.raises(ConfigError, match="one line"):
        check_beacon(make([[0, 0, 0], [0.03, 0, 0], [0.07, 0, 0], [0.11, 0, 0]]))


def test_thickness_is_that_of_the_best_plane_not_of_an_axis():
    tilted = np.array([[0, 0, 0], [0.1, 0, 0.1], [0, 0.1, 0], [0.1, 0.1, 0.1]], dtype=float)
    assert thickness_m(make(tilted)) < 1e-12  # exactly planar, to rounding
