"""What fusion works on (readings of an inertial unit, poses, the truth) and what a method said."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.navigation.error_state_filter import UpdateRecord
from uvgs_bench.navigation.imu import STANDARD_GRAVITY_MPS2, ImuNoise, ImuSamples
from uvgs_bench.navigation.rigid import RigidState
from uvgs_bench.navigation.states import NavigationState, PoseMeasurement, SensedPose, body_measurement

Method = Literal["filter", "graph", "ar_swap"]
METHODS: tuple[Method, ...] = ("filter", "graph", "ar_swap")

BOTH = ("uvgs", "native")
"""Whose poses there are."""


@dataclass(frozen=True, slots=True, eq=False)
class FusionInput:
    """Everything one mission gives to fusion, in ascending time.

    Args:
        name: Name of the mission or file.
        words: What it is, one sentence.
        imu: Readings of the inertial unit.
        sensed: Poses of the sensor.
        native: Poses of the other localiser; may be empty.
        world_from_beacon: Where the beacon stands.
        body_from_camera: How the camera sits on the body; the body's axes are those of the inertial unit.
        leds_m: LED positions in the beacon frame, shape (n, 3), m.
        focal_px: Focal length of the camera, px.
        lens: The camera's lens, or None when only poses are known.
        noise: Noise of the unit as stated.
        gravity_mps2: Gravity in world axes, shape (3,), m/s^2.
        rest_s: How long the body stands still from the first reading on, s.
        misses_ns: Instants of captures without a pose, with the reason.
        starved_ns: Instants at which the native localiser had too few landmarks, with how many.
        truth: The body at an instant, ns, or None when it is not known.
        is_simulated: Whether anything in it is simulated.
        sigma_floor_m: Deviation added to the sensor's positions, m.
        sigma_floor_rad: Deviation added to the sensor's rotations, rad.
        remarks: What a reader must know.
    """

    name: str
    words: str
    imu: ImuSamples
    sensed: tuple[SensedPose, ...]
    native: tuple[PoseMeasurement, ...]
    world_from_beacon: Pose
    body_from_camera: Pose
    leds_m: FloatArray
    focal_px: float
    lens: Lens | None = None
    noise: ImuNoise = field(default_factory=ImuNoise)
    gravity_mps2: FloatArray = field(default_factory=lambda: read_only([0.0, 0.0, -STANDARD_GRAVITY_MPS2]))
    rest_s: float = 0.0
    misses_ns: tuple[tuple[int, str], ...] = ()
    starved_ns: tuple[tuple[int, int], ...] = ()
    truth: Callable[[int], RigidState] | None = None
    is_simulated: bool = False
    sigma_floor_m: float = 0.0
    sigma_floor_rad: float = 0.0
    remarks: tuple[str, ...] = ()

    def measured(self, sensed: SensedPose) -> PoseMeasurement:
        """What a pose of the sensor says about the body."""
        return body_measurement(
            sensed,
            self.world_from_beacon,
            self.body_from_camera,
            sigma_floor_m=self.sigma_floor_m,
            sigma_floor_rad=self.sigma_floor_rad,
        )

    def measurements(self, sources: tuple[str, ...]) -> tuple[PoseMeasurement, ...]:
        """Measured poses of the body by these sources (``uvgs``, ``native``), in the order they became known."""
        out = [self.measured(s) for s in self.sensed] if "uvgs" in sources else []
        out += list(self.native) if "native" in sources else []
        return tuple(sorted(out, key=lambda m: (m.t_ns + m.delay_ns, m.source)))


@dataclass(frozen=True, slots=True)
class FalsePoses:
    """False poses mixed into those of the sensor.

    Args:
        share: Share of poses that are false, 0 to 1.
        size_m: How far off they are, in a random direction, m.
        seed: Seed.
    """

    share: float
    size_m: float
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0.0 <= self.share <= 1.0 or not 0.0 < self.size_m < np.inf:
            raise ValueError("expected a share from 0 to 1 and a positive size")


def with_false_poses(source: FusionInput, false: FalsePoses) -> tuple[FusionInput, frozenset[int]]:
    """Make some poses of the sensor false, as reflections do; they keep the covariance they came with.

    Args:
        source: The input.
        false: How many and how far off.

    Returns:
        The spoilt input and the instants of its false poses, ns.
    """
    rng = np.random.default_rng((false.seed, 21))
    spoilt, instants = [], set()
    for pose in source.sensed:
        is_false = rng.random() < false.share
        direction = rng.standard_normal(3)
        if is_false:
            shift = np.concatenate((np.zeros(3), false.size_m * direction / np.linalg.norm(direction)))
            moved = pose.camera_from_beacon.perturbed(shift)
            # Its LEDs stand where such a pose puts them: a reflection does not betray itself.
            pose = replace(pose, camera_from_beacon=moved, led_px=None)
            instants.add(pose.t_ns)
        spoilt.append(pose)
    words = f"{100.0 * false.share:g} % of the sensor's poses were made false by {false.size_m:g} m"
    return replace(source, sensed=tuple(spoilt), remarks=(*source.remarks, words)), frozenset(instants)


@dataclass(frozen=True, slots=True, eq=False)
class FusionResult:
    """What a method said.

    Args:
        method: The method.
        sources: Whose poses it got.
        states: What it knew at evenly spread instants, without looking ahead.
        updates: What became of each measured pose.
        update_us: Processor time of each update by a measured pose, us.
        gaps_s: Pauses of the inertial unit: when they began (ns) and how long they were (s).
        lost_ns: Instants at which it had nothing to say.
        is_smoothed: Whether the states look ahead after all.
    """

    method: Method
    sources: tuple[str, ...]
    states: tuple[NavigationState, ...]
    updates: tuple[UpdateRecord, ...]
    update_us: FloatArray
    gaps_s: tuple[tuple[int, float], ...] = ()
    lost_ns: tuple[int, ...] = ()
    is_smoothed: bool = False
