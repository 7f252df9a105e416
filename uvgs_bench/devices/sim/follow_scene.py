"""What a follower's camera sees: the leader's beacon on its trajectory, from wherever the follower is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.clock import Clock
from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.devices.sim.bench import SimulatedBench, displaced_beacon, true_lens
from uvgs_bench.devices.sim.truth import Occlusion, SimulatedTruth
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.navigation.rigid import RigidState, rigid_state
from uvgs_bench.navigation.trajectory import Trajectory
from uvgs_bench.units import s_from_ns


class FollowScene:
    """A scene for the simulated camera: leader and follower move, the beacon may change its hue or be hidden.

    Args:
        truth: What is true of camera and beacon; gantry and carriage play no part.
        beacon: The beacon as its file says.
        leader: Its six coordinates in the world over the time of the scene.
        follower: ``world_from_body`` of the follower at an instant in ns.
        body_from_camera: How the camera sits on the follower.
        hues: Hue of the beacon from each place of the trajectory on, the last for all further; empty: as its file says.
        hidden_ns: Spans in which the beacon is out of sight: begin and end, ns.
        seed: Seed of the noise in place of the truth's.

    Raises:
        ConfigError: The truth does not fit the beacon, or its lens is impossible.
    """

    def __init__(
        self,
        truth: SimulatedTruth,
        beacon: Beacon,
        leader: Trajectory,
        follower: Callable[[int], Pose],
        body_from_camera: Pose,
        *,
        hues: Sequence[str] = (),
        hidden_ns: Sequence[tuple[int, int]] = (),
        seed: int | None = None,
    ) -> None:
        self.seed = truth.seed if seed is None else seed
        self.companions: tuple[tuple[Pose, Beacon], ...] = ()
        self.truth = self._lit = truth
        self._lens = true_lens(truth)
        self._beacon = displaced_beacon(truth, beacon)
        self._leader = leader
        self._follower = follower
        self._camera_from_body = body_from_camera.inverse()
        self._hues = tuple(hues)
        self._hidden_ns = tuple(hidden_ns)
        self._dark = replace(truth, occlusion=Occlusion(leds=beacon.led_names))
        self._now_ns = 0

    def look(self, t_ns: int) -> None:
        """Let it be this instant for hue and sight; where things are is asked for by instant."""
        self._now_ns = t_ns
        self.truth = self._dark if self.is_hidden(t_ns) else self._lit

    @property
    def true_lens(self) -> Lens:
        """The true lens."""
        return self._lens

    @property
    def true_beacon(self) -> Beacon:
        """The beacon in the hue it has now, its LEDs where they truly are."""
        hue = self.hue_at(self._now_ns)
        return self._beacon if hue == self._beacon.hue else replace(self._beacon, hue=hue)

    def hue_at(self, t_ns: int) -> str | tuple[float, float]:
        """Hue of the beacon at an instant."""
        if not self._hues:
            return self._beacon.hue
        place = self._leader.state_at(s_from_ns(t_ns)).place
        return self._hues[min(place, len(self._hues) - 1)]

    def is_hidden(self, t_ns: int) -> bool:
        """Whether the beacon is out of sight at an instant."""
        return any(begin <= t_ns < end for begin, end in self._hidden_ns)

    def leader_at(self, t_ns: int) -> RigidState:
        """The leader at an instant: ``world_from_beacon`` and its motion."""
        return rigid_state(self._leader.state_at(s_from_ns(t_ns)), "world", "beacon")

    def true_camera_from_beacon(self, t_ns: int) -> Pose:
        """Where the beacon truly is before the camera at an instant."""
        return self._camera_from_body @ self._follower(t_ns).inverse() @ self.leader_at(t_ns).pose

    def true_camera_from(self, frame: str, t_ns: int) -> Pose:
        """Where the camera itself is, or for any other frame the world, whose axes the leader's start has."""
        if frame == "camera":
            return Pose.identity("camera", "camera")
        seen = self._camera_from_body @ self._follower(t_ns).inverse()
        return Pose(seen.R, seen.t_m, "camera", frame)


class LedBench(SimulatedBench):
    """A simulated bench on which what does not ride the carriage moves: the leader that the gantry is to follow.

    Args:
        truth: What is true.
        beacon: The beacon as its file says.
        axes: The nominal axes.
        mount: Which part rides the carriage; the other one is the leader.
        clock: Bench time in place of one that runs by itself.
        seed: Seed in place of the truth's.

    Raises:
        ConfigError: As ``SimulatedBench``.
    """

    def __init__(
        self,
        truth: SimulatedTruth,
        beacon: Beacon,
        axes: tuple[Axis, ...],
        mount: str,
        *,
        clock: Clock | None = None,
        seed: int | None = None,
    ) -> None:
        super().__init__(truth, beacon, axes, mount, seed=seed)
        if clock is not None:
            self.clock = clock
        self._path: Trajectory | None = None
        self._begun_ns = 0

    def lead(self, path: Trajectory, begun_ns: int) -> None:
        """Let the leader go.

        Args:
            path: Its path; x, y, z come first, m, in the axes of what is seen from the camera (x right, y down,
                z forward); where it begins is where the leader stands now, and turns are left out.
            begun_ns: When it sets out, bench time, ns.
        """
        self._path, self._begun_ns = path, begun_ns

    def displacement_at(self, t_ns: int) -> FloatArray:
        """How far the leader is from where it stood, gantry axes, shape (3,), m."""
        if self._path is None:
            return np.zeros(3)
        moved = self._path.state_at(s_from_ns(t_ns - self._begun_ns)).position - self._path.state_at(-1.0).position
        in_gantry: FloatArray = self._outer.R.T @ moved[:3]
        return in_gantry

    def true_camera_from_beacon(self, t_ns: int) -> Pose:
        """Where the beacon truly is before the camera at an instant."""
        carriage = self.true_gantry_from_carriage(t_ns)
        moved = self.displacement_at(t_ns)
        if self.mount == "beacon_on_carriage":
            return self._outer @ Pose(carriage.R, carriage.t_m - moved, "gantry", "carriage") @ self._inner
        return self._outer @ carriage.inverse() @ Pose(np.eye(3), moved, "gantry", "gantry") @ self._inner
