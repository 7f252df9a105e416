"""What a procedure file means, and what it must not say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from uvgs_bench.devices.gantry.axes import Axis, Envelope
from uvgs_bench.errors import ConfigError, EnvelopeError
from uvgs_bench.sessions.planning import home_position, move_duration_s, plan
from uvgs_bench.sessions.procedure import read_procedure

GRID = """
schema = 1
name = "small"
pattern = "grid"
feed_mm_min = 600.0
captures_per_station = 2
register = "corners"
[grid]
lower = { X_mm = -100.0, Y_mm = -50.0, Z_mm = -30.0 }
upper = { X_mm = -80.0, Y_mm = -30.0, Z_mm = -30.0 }
counts = { X = 3, Y = 2, Z = 1 }
[limits]
position_rms_mm = 1.5
availability_percent = 99.0
"""


def linear(name: str, column: int, lower: float = -0.2, backlash: float = 0.0) -> Axis:
    return Axis(name, "linear", np.eye(3)[column], lower, 0.0, 0.05, 0.2, backlash)


AXES = (linear("X", 0), linear("Y", 1), linear("Z", 2))
ENVELOPE = Envelope(AXES)


def write(folder: Path, text: str) -> Path:
    path = folder / "p.toml"
    path.write_text(text)
    return path


def test_a_grid_is_visited_in_a_serpentine_and_its_corners_register(tmp_path: Path) -> None:
    made = plan(read_procedure(write(tmp_path, GRID)), ENVELOPE)
    targets_mm = [tuple(np.round(1000.0 * s.target, 9)) for s in made.stations]
    assert targets_mm == [
        (-100, -50, -30), (-100, -30, -30), (-90, -30, -30), (-90, -50, -30), (-80, -50, -30), (-80, -30, -30),
    ]  # fmt: skip
    assert [s.role for s in made.stations] == ["register", "register", "judge", "judge", "register", "register"]
    assert made.capture_count == 12
    assert {(x.quantity, x.bound, x.value) for x in made.procedure.limits} == {
        ("position_rms_mm", "max", 1.5), ("availability_percent", "min", 99.0),
    }  # fmt: skip


def test_distance_and_duration_follow_from_the_trapezoid(tmp_path: Path) -> None:
    text = """
schema = 1
name = "two"
pattern = "line"
feed_mm_min = 600.0
settle_s = 1.5
register = [0]
[line]
start = { X_mm = 0.0, Y_mm = 0.0, Z_mm = 0.0 }
end = { X_mm = -100.0, Y_mm = 0.0, Z_mm = 0.0 }
count = 2
"""
    procedure = read_procedure(write(tmp_path, text))
    made = plan(procedure, ENVELOPE)
    assert made.distance_m == pytest.approx(0.1, abs=1e-12)  # m; home is at 0, so one move of 100 mm
    # 10 mm/s reached after 0.05 s at 200 mm/s^2: 0.1 m / 0.01 m/s + 0.01 / 0.2; two settles and captures of 1/30 s.
    assert made.duration_s == pytest.approx(10.05 + 2 * (1.5 + 1 / 30), abs=1e-9)  # s
    short = move_duration_s(AXES, np.zeros(3), np.array([-1e-4, 0.0, 0.0]), procedure)
    assert short == pytest.approx(2 * np.sqrt(1e-4 / 0.2), abs=1e-12)  # s; never reaches the feed


def test_a_diagonal_move_is_held_back_by_its_slowest_axis(tmp_path: Path) -> None:
    slow = (linear("X", 0), Axis("Y", "linear", np.eye(3)[1], -0.2, 0.0, 0.001, 0.2), linear("Z", 2))
    procedure = read_procedure(write(tmp_path, GRID))
    duration = move_duration_s(slow, np.zeros(3), np.array([-0.05, -0.05, 0.0]), procedure)
    assert duration > 50.0  # s: 50 mm of Y at 1 mm/s


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("schema = 1", "schema = 2", "schema: missing or unknown, expected 1"),
        ("feed_mm_min = 600.0", "feed_mps = 0.01", "feed_mps: unknown key"),
        ("feed_mm_min = 600.0", "feed_mm_min = 0.0", "feed_mm_min: must be positive"),
        ('pattern = "grid"', 'pattern = "gird"', "did you mean 'grid'"),
        ('pattern = "grid"', 'pattern = "line"', "grid: this table belongs to another pattern"),
        ("[grid]", "[gird]", "gird: unknown key"),
        ("X_mm = -100.0", "X_deg = -100.0", "grid.lower.X_deg: unknown axis or unit"),
        ("X_mm = -100.0, ", "", "grid.lower.X_mm: this axis is required"),
        ("X_mm = -100.0", "X_mm = nan", "grid.lower.X_mm: must be finite"),
        ("X = 3", "X = 0", "grid.counts.X: must be 1 to"),
        ("X = 3", "X = 3.5", "grid.counts.X"),
        ("X = 3", "B = 3", "grid.counts.B: unknown axis"),
        ("position_rms_mm", "position_rsm_mm", "limits.position_rsm_mm: unknown quantity, did you mean"),
        ('register = "corners"', 'register = "all"', "register"),
        ('register = "corners"', "register = [9]", "register: waypoint 9 does not exist, there are 0 to 5"),
        ('register = "corners"', "register = []", "no waypoint is left to fit the registration"),
        ('register = "corners"', "register = [0,1,2,3,4,5]", "no waypoint is left to judge"),
        ('register = "corners"', "register = 1.5", "register: as a fraction must lie between 0 and 1"),
        ("captures_per_station = 2", "captures_per_station = 0", "captures_per_station: must be 1 to 200"),
        ('name = "small"', 'name = "../small"', "name: must be usable as a file name"),
    ],
)
def test_what_cannot_be_meant_is_named_with_file_and_key(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in GRID
    path = write(tmp_path, GRID.replace(old, new))
    with pytest.raises(ConfigError) as caught:
        plan(read_procedure(path), ENVELOPE)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_waypoint_outside_is_named_with_axis_and_value(tmp_path: Path) -> None:
    path = write(tmp_path, GRID.replace("X_mm = -80.0", "X_mm = 20.0"))
    with pytest.raises(EnvelopeError, match=r"waypoint 4: axis X at 20\.000 mm is outside") as caught:
        plan(read_procedure(path), ENVELOPE)
    assert caught.value.axis == "X"


def test_an_approach_outside_is_refused_although_the_waypoint_is_inside(tmp_path: Path) -> None:
    inside = GRID.replace("Z_mm = -30.0", "Z_mm = -0.5")
    plan(read_procedure(write(tmp_path, inside)), ENVELOPE)
    path = write(tmp_path, inside + '[approach]\nkind = "from_above"\n')
    with pytest.raises(EnvelopeError, match="the approach to waypoint 0: axis Z"):
        plan(read_procedure(path), ENVELOPE)


def test_a_path_through_a_keep_out_box_is_refused_although_both_ends_are_outside_it(tmp_path: Path) -> None:
    post = np.array([[-0.0899, -0.041, -0.2], [-0.0801, -0.039, 0.0]])  # between waypoints 3 and 4 and others
    with pytest.raises(EnvelopeError, match=r"from .* to waypoint \d: the path touches a keep-out box"):
        plan(read_procedure(write(tmp_path, GRID.replace("serpentine", "as_written"))), Envelope(AXES, (post,)))


def test_the_approach_overshoots_by_more_than_the_backlash(tmp_path: Path) -> None:
    axes = (linear("X", 0, backlash=0.003), linear("Y", 1), linear("Z", 2))
    made = plan(read_procedure(write(tmp_path, GRID + '[approach]\nkind = "from_below"\n')), Envelope(axes))
    for station in made.stations:
        assert station.via is not None
        # m: twice 3 mm of backlash, 1 mm by default; arriving upwards begins below.
        assert np.allclose(station.target - station.via, [0.006, 0.001, 0.001], atol=1e-12)
        assert station.path[-1] is station.target
    path = write(tmp_path, GRID + '[approach]\nkind = "from_below"\novershoot = { X_mm = 2.0 }\n')
    with pytest.raises(ConfigError, match=r"approach\.overshoot\.X_mm: must be more than the backlash"):
        plan(read_procedure(path), Envelope(axes))


def test_repeats_and_revisits_keep_the_role_of_their_waypoint(tmp_path: Path) -> None:
    text = GRID.replace("captures_per_station = 2", "repeats = 2\nreference_every = 4\norder = 'shuffled'\nseed = 3")
    made = plan(read_procedure(write(tmp_path, text)), ENVELOPE)
    first = made.stations[0].waypoint
    assert [i for i, s in enumerate(made.stations) if i % 5 == 0 and s.waypoint != first] == []
    assert len(made.stations) == 2 * 6 + 2
    roles: dict[int, set[str]] = {}
    for station in made.stations:
        roles.setdefault(station.waypoint, set()).add(station.role)
        assert station.repeat == sum(s.waypoint == station.waypoint for s in made.stations[: station.index])
    assert all(len(role) == 1 for role in roles.values())


def test_a_rotary_axis_is_in_degrees(tmp_path: Path) -> None:
    axes = (*AXES, Axis("A", "rotary", np.array([0.0, 1.0, 0.0]), -1.0, 1.0, 0.5, 1.0))
    text = """
schema = 1
name = "turn"
pattern = "waypoints"
feed_mm_min = 600.0
feed_deg_min = 1800.0
register = [0]
settle_s = 0.0
[waypoints]
at = [ { X_mm = 0.0, Y_mm = 0.0, Z_mm = 0.0, A_deg = 0.0 }, { X_mm = 0.0, Y_mm = 0.0, Z_mm = 0.0, A_deg = 30.0 } ]
"""
    procedure = read_procedure(write(tmp_path, text))
    made = plan(procedure, Envelope(axes))
    assert made.stations[1].target[3] == pytest.approx(np.pi / 6, abs=1e-12)  # rad
    assert made.distance_m == 0.0
    # 30 deg/s is above the axis' 0.5 rad/s: pi/6 rad at 0.5 rad/s and 1 rad/s^2.
    duration = move_duration_s(axes, home_position(Envelope(axes)), made.stations[1].target, procedure)
    assert duration == pytest.approx(np.pi / 6 / 0.5 + 0.5, abs=1e-9)  # s


def test_the_plan_hash_tells_what_changes_the_captures_and_nothing_else(tmp_path: Path) -> None:
    base = plan(read_procedure(write(tmp_path, GRID)), ENVELOPE).plan_hash
    same = plan(read_procedure(write(tmp_path, GRID.replace('name = "small"', 'name = "other"'))), ENVELOPE).plan_hash
    assert base == same
    for old, new in (("600.0", "601.0"), ("= 2\n", "= 3\n"), ("X_mm = -80.0", "X_mm = -80.001")):
        assert plan(read_procedure(write(tmp_path, GRID.replace(old, new))), ENVELOPE).plan_hash != base


def test_a_third_registers_without_falling_in_line_with_the_rows(tmp_path: Path) -> None:
    text = GRID.replace("X = 3, Y = 2", "X = 5, Y = 3").replace('"corners"', '"every_third"')
    made = plan(read_procedure(write(tmp_path, text)), ENVELOPE)
    registering = np.array([s.target for s in made.stations if s.role == "register"])
    assert len(registering) == 5
    assert np.ptp(registering[:, 1]) > 0.0
