"""Laws every waypoint pattern and every plan keeps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from uvgs_bench.devices.gantry.axes import Axis, Envelope
from uvgs_bench.errors import EnvelopeError
from uvgs_bench.sessions.patterns import PATTERNS, Grid, Ladder, Line, RandomVolume, Square, Waypoints, pattern_class
from uvgs_bench.sessions.planning import home_position, plan
from uvgs_bench.sessions.procedure import Procedure

AXES = tuple(
    Axis(name, "linear", np.eye(3)[i], lower, 0.0, 0.05, 0.2, 1e-4)
    for i, (name, lower) in enumerate((("X", -0.3), ("Y", -0.2), ("Z", -0.25)))
)
KEEP_OUT = np.array([[-0.12, -0.12, -0.12], [-0.1, -0.1, -0.1]])
ENVELOPE = Envelope(AXES, (KEEP_OUT,))

place = st.fixed_dictionaries({f"{a.name}_mm": st.floats(1000.0 * a.lower - 10.0, 10.0) for a in AXES})
small = st.integers(1, 4)
counts = st.fixed_dictionaries({"X": st.integers(2, 4), "Y": small, "Z": small})
patterns = st.one_of(
    st.builds(Waypoints, at=st.lists(place, min_size=2, max_size=6)),
    st.builds(Line, start=place, end=place, count=st.integers(2, 6)),
    st.builds(Grid, lower=place, upper=place, counts=counts),
    st.builds(Square, centre=place, side_mm=st.floats(1.0, 300.0), plane=st.sampled_from([("X", "Y"), ("Z", "X")]),
              points_per_side=small),
    st.builds(Ladder, start=place, end=place, count=st.integers(2, 5),
              across=st.sampled_from([{}, {"Y_mm": 20.0}]), spacing=st.sampled_from(["even", "widening"])),
    st.builds(RandomVolume, lower=place, upper=place, count=st.integers(2, 8)),
)  # fmt: skip
procedures = st.builds(
    Procedure,
    name=st.just("law"),
    pattern=patterns,
    feed_mps=st.floats(0.001, 0.1),
    captures_per_station=st.integers(1, 3),
    repeats=st.integers(1, 3),
    origin=st.sampled_from(["machine", "centre"]),
    order=st.sampled_from(["as_written", "serpentine", "shuffled"]),
    register=st.sampled_from(["every_third", 0.5, (0,)]),
    reference_every=st.integers(0, 3),
    seed=st.integers(0, 5),
    approach=st.sampled_from(["none", "from_below", "from_above"]),
)


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(procedures)
def test_a_plan_stays_inside_or_is_refused(procedure: Procedure) -> None:
    try:
        made = plan(procedure, ENVELOPE)
    except EnvelopeError:
        return
    here = home_position(ENVELOPE)
    for station in made.stations:
        for position in station.path:
            assert all(a.lower - 1e-6 <= q <= a.upper + 1e-6 for a, q in zip(AXES, position, strict=True))
            # Independent of the check's own method: no point of the path lies inside the box.
            line = here + np.linspace(0.0, 1.0, 200)[:, None] * (position - here)
            assert not ((line > KEEP_OUT[0]) & (line < KEEP_OUT[1])).all(axis=1).any()
            here = position


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(procedures)
def test_every_waypoint_is_visited_as_often_as_asked_and_plans_repeat(procedure: Procedure) -> None:
    wide = Envelope(tuple(Axis(a.name, a.kind, a.direction, -9.0, 9.0, a.max_speed, a.acceleration) for a in AXES))
    made, again = plan(procedure, wide), plan(procedure, wide)
    assert made.plan_hash == again.plan_hash
    visits = np.bincount([s.waypoint for s in made.stations], minlength=made.waypoint_count)
    first = made.stations[0].waypoint
    assert all(n == procedure.repeats for w, n in enumerate(visits) if w != first)
    assert visits[first] >= procedure.repeats
    assert [s.index for s in made.stations] == list(range(len(made.stations)))
    assert made.distance_m >= 0.0
    assert made.duration_s >= made.capture_count / 30.0 + len(made.stations) * procedure.settle_s - 1e-9


@pytest.mark.parametrize("name", PATTERNS)
def test_every_pattern_of_the_table_can_be_loaded(name: str) -> None:
    assert hasattr(pattern_class(name), "points")
    assert hasattr(pattern_class(name), "__dataclass_fields__")
