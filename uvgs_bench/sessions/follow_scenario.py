"""Scenarios of ``uvgs follow``: how the leader moves, where the follower is to be, and what goes wrong meanwhile."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from uvgs_bench.devices.sim.free_flyer import Environment, FlyerConfig
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import rotation_from_euler_zyx
from uvgs_bench.navigation.follower import FollowerConfig
from uvgs_bench.navigation.pose_filter import PoseFilterConfig
from uvgs_bench.navigation.trajectory import MotionLimits, PathPoint, Trajectory, plan_trajectory
from uvgs_bench.store.documents import read_document
from uvgs_bench.units import m_from_mm, ns_from_s, rad_from_deg, s_from_ms

Vector = tuple[float, float, float]

_LONGEST_S = 3600.0
_FAULT = re.compile(r"(?P<name>[a-z]+)=(?P<value>[0-9.]+)(?P<unit>ms|s)?(@(?P<at>[0-9.]+)s)?")
_FAULTS = "loss=2s@10s, latency=80ms, drop=0.05 or cpu=0.5"


@dataclass(frozen=True, slots=True)
class FollowPlace:
    """A place of the leader.

    Args:
        position_mm: Its beacon in the world (x right, y down, z forward, seen from the follower), mm.
        euler_zyx_deg: Intrinsic Z-Y-X angles, deg; at zero it faces the follower.
        dwell_s: Wait there, s.
        blend_mm: Distance at which the path leaves its leg for the next, mm; 0: it stops.
        hue: Hue of the beacon from here on; empty: unchanged.
    """

    position_mm: Vector = (0.0, 0.0, 0.0)
    euler_zyx_deg: Vector = (0.0, 0.0, 0.0)
    dwell_s: float = 0.0
    blend_mm: float = 0.0
    hue: str = ""


@dataclass(frozen=True, slots=True)
class LeaderPlan:
    """How the leader moves.

    Args:
        places: Where it goes, in order.
        speed_mm_s: Speed along its path, mm/s.
        acceleration_mm_s2: Acceleration, mm/s^2.
        turning_deg_s: Rate where it only turns, deg/s.
        turning_deg_s2: Its acceleration, deg/s^2.
    """

    places: tuple[FollowPlace, ...]
    speed_mm_s: float = 50.0
    acceleration_mm_s2: float = 30.0
    turning_deg_s: float = 5.0
    turning_deg_s2: float = 5.0

    def trajectory(self) -> Trajectory:
        """The trajectory in the world, six coordinates.

        Raises:
            ValueError: No place, or a limit that is not positive.
        """
        limits = MotionLimits.rigid(
            m_from_mm(self.speed_mm_s),
            m_from_mm(self.acceleration_mm_s2),
            rad_from_deg(self.turning_deg_s),
            rad_from_deg(self.turning_deg_s2),
        )
        points = [
            PathPoint(
                np.concatenate((m_from_mm(np.array(p.position_mm)), rad_from_deg(np.array(p.euler_zyx_deg)))),
                p.dwell_s,
                m_from_mm(p.blend_mm),
            )
            for p in self.places
        ]
        return plan_trajectory(points, limits)

    def hues(self) -> tuple[str, ...]:
        """Hue from each place on; empty when none is named."""
        found: list[str] = []
        for place in self.places:
            found.append(place.hue or (found[-1] if found else ""))
        if not any(found):
            return ()
        if not found[0]:
            raise ValueError("the first place needs a hue when a later one has one")
        return tuple(found)


@dataclass(frozen=True, slots=True)
class FollowScenario:
    """Everything a follow session is told.

    Args:
        name: Its name.
        leader: The leader's motion.
        description: For people.
        environment: Where a simulated follower lives.
        offset_mm: Where the follower's camera is to be, axes of the leader's beacon, mm.
        start_error_mm: How far off it begins, same axes, mm.
        start_error_deg: Its attitude at the beginning, intrinsic Z-Y-X angles off the wanted one, deg.
        rate_hz: Captures a second.
        exposure_ms: Exposure of the simulated camera, ms.
        tail_s: How long it goes on after the leader's last stop, s.
        tolerance_mm: Position error that counts as in tolerance, and limit of the steady error, mm.
        tolerance_deg: Attitude error that counts as in tolerance, deg.
        settle_s: The error is steady once the leader has not accelerated for so long, s.
        processing_ms: What the sensor takes for a capture when time is simulated, ms.
        law: The follower law.
        filter: The pose filter.
        flyer: The simulated follower.

    Raises:
        ValueError: A value outside its meaning.
    """

    name: str
    leader: LeaderPlan
    description: str = ""
    environment: Environment = "microgravity"
    offset_mm: Vector = (0.0, 0.0, -500.0)
    start_error_mm: Vector = (15.0, -10.0, -30.0)
    start_error_deg: Vector = (0.0, 2.0, 0.0)
    rate_hz: float = 20.0
    exposure_ms: float = 0.8
    tail_s: float = 5.0
    tolerance_mm: float = 10.0
    tolerance_deg: float = 2.0
    settle_s: float = 3.0
    processing_ms: float = 8.0
    law: FollowerConfig = field(default_factory=FollowerConfig)
    filter: PoseFilterConfig = field(default_factory=PoseFilterConfig)
    flyer: FlyerConfig = field(default_factory=FlyerConfig)

    def __post_init__(self) -> None:
        for name in ("rate_hz", "exposure_ms", "tolerance_mm", "tolerance_deg"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("tail_s", "settle_s", "processing_ms"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if not self.offset_mm[2] < 0.0:
            raise ValueError(
                f"offset_mm: the follower is before the beacon, its z must be below 0, got {self.offset_mm[2]}"
            )
        self.leader.hues()
        if self.duration_s > _LONGEST_S:
            raise ValueError(f"the scenario takes {self.duration_s:.0f} s, more than {_LONGEST_S:.0f} s")

    @property
    def duration_s(self) -> float:
        """How long it takes, s."""
        return self.leader.trajectory().duration_s + self.tail_s

    def body_from_camera(self) -> Pose:
        """How the camera sits on the follower."""
        return Pose(np.eye(3), m_from_mm(np.array(self.flyer.camera_mm)), "body", "camera")

    def station(self) -> Pose:
        """Where the follower's body is to be: ``beacon_from_body``."""
        camera = Pose(np.eye(3), m_from_mm(np.array(self.offset_mm)), "beacon", "camera")
        return camera @ self.body_from_camera().inverse()

    def start(self) -> Pose:
        """Where the follower begins: ``beacon_from_body``."""
        yaw, pitch, roll = (rad_from_deg(angle) for angle in self.start_error_deg)
        station = self.station()
        t_m = station.t_m + m_from_mm(np.array(self.start_error_mm))
        return Pose(station.R @ rotation_from_euler_zyx(yaw, pitch, roll), t_m, "beacon", "body")


@dataclass(frozen=True, slots=True)
class FollowFaults:
    """What goes wrong on purpose.

    Args:
        losses_s: Begin and length of each loss of sight, s.
        latency_s: Added between a capture and its command, s.
        drop: Share of captures that never arrive.
        cpu: Share of the processor that others take.

    Raises:
        ValueError: A value outside its meaning.
    """

    losses_s: tuple[tuple[float, float], ...] = ()
    latency_s: float = 0.0
    drop: float = 0.0
    cpu: float = 0.0

    def __post_init__(self) -> None:
        if not (0.0 <= self.drop < 1.0 and 0.0 <= self.cpu < 1.0):
            raise ValueError(f"drop and cpu must be from 0 to below 1, got {self.drop} and {self.cpu}")
        if not 0.0 <= self.latency_s <= 10.0:
            raise ValueError(f"latency must be from 0 to 10 s, got {self.latency_s}")

    def hidden_ns(self) -> tuple[tuple[int, int], ...]:
        """Spans in which the beacon is out of sight, ns."""
        return tuple((ns_from_s(begin), ns_from_s(begin + length)) for begin, length in self.losses_s)

    @property
    def text(self) -> str:
        """As it would be typed; empty for none."""
        parts = [f"loss={length:g}s@{begin:g}s" for begin, length in self.losses_s]
        parts += [f"latency={self.latency_s:g}s"] * (self.latency_s > 0.0)
        parts += [f"drop={self.drop:g}"] * (self.drop > 0.0) + [f"cpu={self.cpu:g}"] * (self.cpu > 0.0)
        return ",".join(parts)


def parse_faults(text: str) -> FollowFaults:
    """Read ``loss=2s@10s,latency=80ms,drop=0.05,cpu=0.5``; any part may be left out, losses may be several.

    Args:
        text: As typed; empty for none.

    Returns:
        The faults.

    Raises:
        ConfigError: A part that means nothing, or is given twice.
    """
    losses: list[tuple[float, float]] = []
    values: dict[str, float] = {}
    for part in filter(None, (piece.strip() for piece in text.split(","))):
        match = _FAULT.fullmatch(part)
        found = {} if match is None else match.groupdict()
        try:
            value = float(found["value"])
            value = s_from_ms(value) if found["unit"] == "ms" else value
            has_unit, has_begin = found["unit"] is not None, found["at"] is not None
            if found["name"] == "loss" and has_unit and has_begin:
                losses.append((float(found["at"]), value))
                continue
            key, wants_unit = {"latency": ("latency_s", True), "drop": ("drop", False), "cpu": ("cpu", False)}[
                found["name"]
            ]
            if has_begin or has_unit != wants_unit or key in values:
                raise KeyError(part)
            values[key] = value
        except (KeyError, ValueError):
            raise ConfigError(f"cannot read '{part}', expected parts like {_FAULTS}", key="--inject") from None
    try:
        return FollowFaults(tuple(sorted(losses)), **values)
    except ValueError as error:
        raise ConfigError(str(error), key="--inject") from None


def read_scenario(name: str) -> FollowScenario:
    """A scenario by name, or from a TOML file.

    Args:
        name: Key of ``SCENARIOS``, or a path.

    Returns:
        The scenario.

    Raises:
        UnreadableDocument: Neither is there.
        ConfigError: The file says something that cannot be meant.
    """
    if name in SCENARIOS:
        return SCENARIOS[name]
    if not name.endswith(".toml"):
        raise ConfigError(f"unknown scenario '{name}', expected one of {', '.join(SCENARIOS)}, or a .toml file")
    return read_document(Path(name), FollowScenario)


def _square(side_mm: float, axes: tuple[int, int]) -> tuple[FollowPlace, ...]:
    corners = ((0.0, 0.0), (side_mm, 0.0), (side_mm, side_mm), (0.0, side_mm), (0.0, 0.0))
    places = []
    for i, (a, b) in enumerate(corners):
        at = [0.0, 0.0, 0.0]
        at[axes[0]], at[axes[1]] = a, b
        places.append(FollowPlace((at[0], at[1], at[2]), dwell_s=6.0 if i == 0 else 1.0))
    return tuple(places)


def _targets() -> tuple[FollowPlace, ...]:
    hues = ("blue", "red", "green", "blue")
    x_mm = (0.0, 250.0, 500.0, 750.0)
    y_mm = (0.0, -100.0, 100.0, 0.0)
    turn_deg = (0.0, 0.0, 8.0, 0.0)
    return tuple(
        FollowPlace((x, y, 0.0), (0.0, turn, 0.0), dwell_s=6.0 if i == 0 else 3.0, hue=hue)
        for i, (x, y, turn, hue) in enumerate(zip(x_mm, y_mm, turn_deg, hues, strict=True))
    )


_SQUARE = FollowScenario(
    "square", LeaderPlan(_square(300.0, (0, 1))), "30 cm square in the vertical plane before the follower (2A + 2F)"
)

SCENARIOS: dict[str, FollowScenario] = {
    "square": _SQUARE,
    "granite_square": replace(
        _SQUARE,
        name="granite_square",
        leader=LeaderPlan(_square(300.0, (0, 2))),
        description="30 cm square in the plane of the table (GT-4)",
        environment="granite",
        start_error_mm=(15.0, 0.0, -30.0),
        start_error_deg=(0.0, 3.0, 0.0),
    ),
    "line": FollowScenario(
        "line",
        LeaderPlan((FollowPlace(dwell_s=6.0), FollowPlace((600.0, 0.0, 0.0)))),
        "60 cm to the right at constant speed",
    ),
    "hold": FollowScenario(
        "hold",
        LeaderPlan((FollowPlace(dwell_s=15.0),)),
        "the leader stands still",
        start_error_mm=(80.0, -60.0, -200.0),
    ),
    "slow_square": FollowScenario(
        "slow_square",
        LeaderPlan(_square(200.0, (0, 1)), speed_mm_s=25.0),
        "20 cm square in the vertical plane at 25 mm/s, for a gantry",
    ),
    "multi": FollowScenario(
        "multi", LeaderPlan(_targets()), "four targets, the beacon in the hue of the one it reached last (4)"
    ),
}
"""Scenarios by name."""
