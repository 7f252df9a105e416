"""Several beacons that stand together: one is looked at, and its pose is said as the pose of the group.

The group's frame is that of the bench's own beacon; where the others stand in it is surveyed, with a doubt. So poses of
different beacons can be compared, a hand-over shows as a step no larger than the doubts allow, and the last valid pose
can be held over it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from uvgs_bench.accuracy.observations import Mount
from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.devices.bench import Bench
from uvgs_bench.devices.gantry.axes import Axis, gantry_from_carriage
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import rotation_angle
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.handover import HandoverPolicy, HandoverState, Held, hand_over
from uvgs_bench.sensor.outcome import Miss, Outcome, PoseEstimate
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.sessions.pattern_trajectory import Motion
from uvgs_bench.sessions.planning import Plan
from uvgs_bench.units import deg_from_rad, mm_from_m, ns_from_s, rad_from_deg, s_from_ns

# A beacon farther than this from where it should be seen is another one of the same hue, m and rad.
_ELSEWHERE_M, _ELSEWHERE_RAD = 0.1, rad_from_deg(30.0)


@dataclass(frozen=True, slots=True, eq=False)
class Member:
    """One beacon of a group.

    Args:
        sensor: The sensor that looks for it.
        group_from_beacon: Where it stands, as surveyed; both frames are called beacon.
        covariance: Doubt of that as a left tangent (omega, v) in the group's axes, shape (6, 6), rad and m.
    """

    sensor: Uvgs
    group_from_beacon: Pose
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """What one capture showed.

    Args:
        outcome: The pose of the group, or why there is none.
        active: Name of the beacon that was looked at; empty where there is only one.
        switched: Why another beacon became active in this capture; empty when none did.
        held: The last valid pose that stands in for a miss, in the group's frame; None when nothing is held.
        held_age_s: Its age, s; None when nothing is held.
    """

    outcome: Outcome
    active: str = ""
    switched: str = ""
    held: PoseEstimate | None = None
    held_age_s: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class AsBuilt:
    """Roughly how camera and group stand to the gantry: enough to know which beacon is before the camera.

    Args:
        axes: The axes.
        mount: Which part rides the carriage.
        mounted: What rides, on the carriage: carriage_from_beacon, or camera_from_carriage.
        standing: What stands, before the gantry: camera_from_gantry, or gantry_from_beacon.
    """

    axes: tuple[Axis, ...]
    mount: Mount
    mounted: Pose
    standing: Pose

    def camera_from_group(self, position: FloatArray) -> Pose:
        """Where the group is before the camera for axis positions, shape (A,), m or rad."""
        moving = gantry_from_carriage(self.axes, position)
        if self.mount == "beacon_on_carriage":
            return self.standing @ moving @ self.mounted
        return self.mounted @ moving.inverse() @ self.standing

    def axis_step(self, position: FloatArray, step_m: FloatArray) -> FloatArray:
        """What the axes must add for the group to move by so much before the camera.

        Args:
            position: Axis positions, shape (A,), m or rad.
            step_m: Wanted step in camera axes, shape (3,), m.

        Returns:
            Shape (A,), m; 0 for rotary axes.
        """
        moving = gantry_from_carriage(self.axes, position)
        is_carried = self.mount == "beacon_on_carriage"
        R = self.standing.R if is_carried else -self.mounted.R @ moving.R.T
        directions = np.array([axis.direction if axis.kind == "linear" else np.zeros(3) for axis in self.axes])
        return np.asarray(np.linalg.pinv(directions.T) @ R.T @ step_m)


class GroupSensor:
    """A sensor for one group of beacons; it remembers which is active, and the last valid pose to hold.

    Only the beacon that is looked at is searched: lights of the others are ignored, as their hue is. A pose of it must
    lie near where the beacon should be seen, so that another of the same hue is never taken for it.

    Args:
        members: The beacons by name.
        policy: How long the last pose is held; the mode must be ``command``.
        as_built: Roughly how everything stands.
        where: Axis positions now, shape (A,), m or rad; asked when a capture comes without.

    Raises:
        ConfigError: No beacon, or a policy of another mode.
    """

    def __init__(
        self,
        members: Mapping[str, Member],
        policy: HandoverPolicy,
        as_built: AsBuilt,
        where: Callable[[], FloatArray],
    ) -> None:
        if not members or policy.mode != "command":
            raise ConfigError("a group needs beacons, and a policy that obeys commands", key="handover")
        self.members = dict(members)
        self._policy = policy
        self._as_built = as_built
        self._where = where
        self._state = HandoverState()
        self._last: PoseEstimate | None = None

    def warm_up(self) -> None:
        """Compile what the sensors need."""
        for member in self.members.values():
            member.sensor.warm_up()

    def solve(self, capture: Capture, prior: PoseEstimate | None = None) -> Outcome:
        """The pose of the group by the beacon before the camera."""
        return self.look(capture, self._where()).outcome

    def look(self, capture: Capture, position: FloatArray, wanted: str | None = None) -> Sight:
        """Look at one beacon.

        Args:
            capture: The picture.
            position: Axis positions at that instant, about, shape (A,), m or rad.
            wanted: Name of the beacon; the one nearest to the middle of the view when None.

        Returns:
            What was seen; a miss says which beacon was looked for.

        Raises:
            ConfigError: There is no beacon of this name.
        """
        name = self.nearest(position) if wanted is None else wanted
        if name not in self.members:
            raise ConfigError(f"unknown beacon '{name}', expected one of: {', '.join(self.members)}", key="beacons")
        fresh = self._in_group(name, self.members[name].sensor.solve(capture), position)
        ignored: dict[str, Outcome] = {
            other: Miss("validate", "not_looked_at", "another beacon is active", capture.t_ns, other)
            for other in self.members
        }
        handed = hand_over(ignored | {name: fresh}, self._state, self._policy, capture.t_ns, name)
        self._state = handed.state
        if isinstance(fresh, PoseEstimate):
            self._last = fresh
            return Sight(fresh, name, handed.switched)
        # Poses of the group are in one frame, so that the last one outlives a change of the beacon.
        held = handed.answer.last if isinstance(handed.answer, Held) else self._last
        age_ns = None if held is None else capture.t_ns - held.t_ns
        if held is None or age_ns is None or not 0 <= age_ns <= ns_from_s(self._policy.hold_s):
            return Sight(fresh, name, handed.switched)
        return Sight(fresh, name, handed.switched, held, s_from_ns(age_ns))

    def nearest(self, position: FloatArray) -> str:
        """The beacon that should be nearest to the middle of the view, for axis positions of shape (A,), m or rad."""
        camera_from_group = self._as_built.camera_from_group(position)

        def off_axis(name: str) -> float:
            t_m = camera_from_group.apply(self.members[name].group_from_beacon.t_m)
            return float(np.hypot(t_m[0], t_m[1]))

        return min(self.members, key=off_axis)

    def correction(self, poses: Sequence[PoseEstimate], position: FloatArray) -> FloatArray:
        """How far the axes must go on for the camera to see a beacon where the plan means it to.

        Args:
            poses: Poses of the group read at one place, at least one.
            position: The planned axis positions, shape (A,), m or rad.

        Returns:
            To be added to the axis positions, shape (A,), m; 0 for rotary axes.
        """
        expected = self._as_built.camera_from_group(position)
        steps = []
        for pose in poses:
            # At the beacon itself, so that a doubt of the attitude is not multiplied by the way to the group's origin.
            place_m = self.members[pose.beacon].group_from_beacon.t_m
            steps.append(expected.apply(place_m) - pose.camera_from_beacon.apply(place_m))
        return self._as_built.axis_step(position, np.mean(steps, axis=0))

    def _in_group(self, name: str, outcome: Outcome, position: FloatArray) -> Outcome:
        """A pose of one beacon as one of the group, with the doubt of where it stands; refused where it cannot be."""
        if isinstance(outcome, Miss):
            return outcome
        member = self.members[name]
        group_from_beacon = member.group_from_beacon
        camera_from_group = outcome.camera_from_beacon @ group_from_beacon.inverse()
        expected = self._as_built.camera_from_group(position) @ group_from_beacon
        off_m = float(np.linalg.norm(outcome.camera_from_beacon.t_m - expected.t_m))
        off_rad = rotation_angle(outcome.camera_from_beacon.R @ expected.R.T)
        if off_m > _ELSEWHERE_M or off_rad > _ELSEWHERE_RAD:
            return Miss(
                "validate",
                "not_this_beacon",
                f"seen {mm_from_m(off_m):.0f} mm and {deg_from_rad(off_rad):.0f} deg from where {name} should be: "
                "another beacon of this hue, or the bench file is wrong",
                outcome.t_ns,
                outcome.beacon,
                outcome.blob_count,
                outcome.stage_s,
            )
        adjoint = camera_from_group.adjoint()
        doubt = adjoint @ member.covariance @ adjoint.T
        systematic = doubt if outcome.beacon_covariance is None else outcome.beacon_covariance + doubt
        runner_up = outcome.runner_up
        return replace(
            outcome,
            camera_from_beacon=camera_from_group,
            covariance=outcome.covariance + doubt,
            beacon_covariance=systematic,
            runner_up=None if runner_up is None else runner_up @ group_from_beacon.inverse(),
        )


def check_group(bench: Bench, plan: Plan, beacons: Sequence[Beacon], path: str) -> None:
    """Refuse a plan whose beacons the bench does not have, and a group whose places are not roughly known.

    Args:
        bench: The bench.
        plan: The plan.
        beacons: The bench's own beacon and the others.
        path: The procedure's file, for messages.

    Raises:
        ConfigError: A name twice or unknown, or ``[mounted]`` or ``[standing]`` is missing from the bench file.
    """
    names = [beacon.name for beacon in beacons]
    if len(set(names)) != len(names):
        raise ConfigError(f"beacons need different names, got {', '.join(names)}", bench.path, "others")
    motion = plan.motion
    for name in () if motion is None else motion.beacons:
        if name not in names:
            raise ConfigError(
                f"no beacon '{name}' on this bench, it has {', '.join(names)}", path, "trajectory.beacons"
            )
    needs_places = len(names) > 1 or (motion is not None and motion.correction_limit_m is not None)
    for key, pose in (("mounted", bench.mounted), ("standing", bench.standing)):
        if needs_places and pose is None:
            raise ConfigError("required: with several beacons, or to correct a path", bench.path, key)


def group_sensor(
    bench: Bench, sensors: Sequence[Uvgs], motion: Motion | None, where: Callable[[], FloatArray]
) -> GroupSensor:
    """The sensor of a bench with several beacons.

    Args:
        bench: The bench, checked by ``check_group``.
        sensors: For its own beacon and the others, in its order.
        motion: Says how long a pose is held, or None.
        where: Axis positions now, shape (A,), m or rad.

    Returns:
        The sensor.
    """
    assert bench.mounted is not None
    assert bench.standing is not None
    own = Member(sensors[0], Pose.identity("beacon", "beacon"), np.zeros((6, 6)))
    members = {sensors[0].beacon.name: own}
    for sensor, other in zip(sensors[1:], bench.others, strict=True):
        members[sensor.beacon.name] = Member(sensor, other.beacon_from_other, other.covariance)
    policy = HandoverPolicy(mode="command", hold_s=0.0 if motion is None else motion.hold_s)
    as_built = AsBuilt(bench.envelope.axes, bench.mount, bench.mounted, bench.standing)
    return GroupSensor(members, policy, as_built, where)
