"""A gantry as follower: where its axes should be by the sensor, and short pieces of motion that take it there.

What rides the carriage keeps its place before the other part. Which way each axis moves what the camera sees is found
by small moves first. A pose together with where the carriage was at that instant says where the axes should have been;
that place does not depend on the gantry's own motion, so that latency delays it but cannot make the loop unstable.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uvgs_bench.devices.gantry.axes import Axis, Envelope
from uvgs_bench.devices.gantry.gantry import MotionStream, StampedPosition
from uvgs_bench.errors import EnvelopeError, RegistrationError
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.navigation.follower import FollowCommand, FollowerConfig, follow_step, rest_command
from uvgs_bench.navigation.pose_filter import (
    PoseFilterConfig,
    PoseMemory,
    RelativePose,
    SmoothedPose,
    smoothed,
    take_pose,
)
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.units import mm_from_m, ns_from_s, s_from_ns

# Length of a piece, s, and how far ahead pieces are told: what is told can be braked within it.
PIECE_S = 0.05
AHEAD_S = 0.2
# The carriage keeps this far from the ends of its envelope, m.
_KEEP_OFF_M = 1e-3
# An axis that moves the beacon by another share of what it says is refused; so are axes that nearly coincide.
_MOVES_ALIKE = (0.8, 1.25)
_LEAST_SINE = 0.5
# A controller keeps up with short pieces only while it has some speed and acceleration to spare.
_SPARE = 0.5
_SHORT_M = 1e-6
# A carriage slower than this has no lag worth knowing, m/s; a new lag counts by a share, and up to a most, s.
_SLOW_MPS, _LAG_SHARE, _MOST_LAG_S = 2e-3, 0.1, 0.5
_KEPT_PIECES = 64


@dataclass(frozen=True, slots=True, eq=False)
class AxisView:
    """How the camera sees the linear axes move.

    Args:
        linear: Numbers of the linear axes.
        camera_per_axis: Move of the beacon before the camera for a move of each linear axis, shape (3, k).
        axis_per_camera: The other way, by least squares, shape (k, 3).
        station_m: Place of the beacon before the camera that is to be kept, shape (3,), m.
    """

    linear: tuple[int, ...]
    camera_per_axis: FloatArray
    axis_per_camera: FloatArray
    station_m: FloatArray

    @classmethod
    def of(
        cls, axes: Sequence[Axis], steps: Sequence[tuple[int, FloatArray, FloatArray]], station_m: FloatArray
    ) -> AxisView:
        """From a small move of each linear axis.

        Args:
            axes: The gantry's axes.
            steps: For each: number of the axis, its move, shape (A,), m; the beacon's move, camera axes, shape (3,), m.
            station_m: Place of the beacon that is to be kept, shape (3,), m.

        Returns:
            The view.

        Raises:
            RegistrationError: An axis moves the beacon otherwise than it says, or two axes move it alike.
        """
        columns = []
        for number, moved, seen in steps:
            column = seen / float(moved[number])
            size = float(np.linalg.norm(column))
            if not _MOVES_ALIKE[0] <= size <= _MOVES_ALIKE[1]:
                raise RegistrationError(
                    f"axis {axes[number].name} moved by {mm_from_m(float(moved[number])):.1f} mm and the beacon by "
                    f"{mm_from_m(float(np.linalg.norm(seen))):.1f} mm before the camera: they must be alike"
                )
            columns.append(column / size)
        J = np.array(columns).T
        if float(np.linalg.svd(J, compute_uv=False)[-1]) < _LEAST_SINE:
            raise RegistrationError("two axes move the beacon nearly alike before the camera")
        return cls(
            tuple(number for number, _, _ in steps),
            read_only(J),
            read_only(np.linalg.pinv(J)),
            read_only(station_m, (3,)),
        )

    def wanted(self, estimate: PoseEstimate, position: FloatArray) -> FloatArray:
        """Where the linear axes should have been when a capture was taken.

        Args:
            estimate: The sensor's pose.
            position: Where the axes were, shape (A,), m or rad.

        Returns:
            Positions of the linear axes, shape (k,), m.
        """
        off = estimate.camera_from_beacon.t_m - self.station_m
        result: FloatArray = position[list(self.linear)] - self.axis_per_camera @ off
        return result

    def covariance(self, estimate: PoseEstimate) -> FloatArray:
        """Covariance of ``wanted``, shape (k, k), m^2."""
        result: FloatArray = self.axis_per_camera @ estimate.position_covariance_m2 @ self.axis_per_camera.T
        return result


class GantryFollower:
    """The told end of the carriage's path, led by the follower law.

    Args:
        view: How the camera sees the axes.
        envelope: What may be reached.
        start: Where the carriage stands, shape (A,), m or rad.
        t_ns: Now, ns.
        law: The law; its limits are lowered to what the axes can.
        filtering: The filter of the places where the axes should be.
    """

    def __init__(
        self,
        view: AxisView,
        envelope: Envelope,
        start: FloatArray,
        t_ns: int,
        law: FollowerConfig,
        filtering: PoseFilterConfig,
    ) -> None:
        self.view = view
        self._envelope = envelope
        self.law = law_for(law, [envelope.axes[i] for i in view.linear])
        self._filtering = filtering
        self.end = np.array(start)
        self._path: deque[tuple[int, FloatArray]] = deque([(t_ns, self.end)], maxlen=_KEPT_PIECES)
        self._lag_s = 0.0
        self._memory = PoseMemory()
        self._is_fresh = False
        self.command: FollowCommand = rest_command(t_ns, self.law)
        self._station = Pose.identity("beacon", "body")

    def take(self, estimate: PoseEstimate, position: FloatArray) -> bool:
        """Take a pose in, with where the axes were at its instant.

        Args:
            estimate: The sensor's pose.
            position: Axis positions at its instant, shape (A,), m or rad.

        Returns:
            Whether it was believed.
        """
        k = len(self.view.linear)
        place, covariance = np.zeros(3), np.eye(6) * 1e-12
        place[:k] = self.view.wanted(estimate, position)
        covariance[3 : 3 + k, 3 : 3 + k] = self.view.covariance(estimate)
        pose = RelativePose(estimate.t_ns, Pose(np.eye(3), place, "beacon", "body"), covariance)
        self._memory, accepted = take_pose(self._memory, pose, self._filtering)
        self._is_fresh |= accepted
        return accepted

    def see(self, stamp: StampedPosition) -> None:
        """Learn from a report how late the carriage is on its told path; the path is then led by as much."""
        times = np.array([t_ns for t_ns, _ in self._path], dtype=np.float64)
        i = int(np.searchsorted(times, stamp.t_ns))
        late_s = 0.0
        if 0 < i < len(times):
            (before_ns, before), (after_ns, after) = self._path[i - 1], self._path[i]
            span_s = s_from_ns(after_ns - before_ns)
            velocity = (after - before) / span_s
            square = float(velocity @ velocity)
            if square > _SLOW_MPS * _SLOW_MPS:
                told = before + s_from_ns(stamp.t_ns - before_ns) * velocity
                late_s = float((told - stamp.position) @ velocity) / square
        self._lag_s += _LAG_SHARE * (min(max(late_s, 0.0), _MOST_LAG_S) - self._lag_s)

    def next_piece(self, t_ns: int) -> FloatArray:
        """Where the next piece ends: of the length the law allows, within the envelope.

        Args:
            t_ns: When it begins, ns.

        Returns:
            Axis positions, shape (A,), m or rad; the last ones where it should stand.
        """
        line = smoothed(self._memory, self._filtering)
        self.command = follow_step(
            self.command,
            None if line is None else self._relative(line, t_ns),
            self._is_fresh,
            t_ns,
            self._station,
            self.law,
        )
        self._is_fresh = False
        step = (self.command.velocity_mps + 0.5 * PIECE_S * self.command.acceleration_mps2) * PIECE_S
        target = self.end.copy()
        for i, number in enumerate(self.view.linear):
            axis = self._envelope.axes[number]
            low, high = axis.lower + _KEEP_OFF_M, axis.upper - _KEEP_OFF_M
            # One that begins beyond the edge may come back, never go further.
            target[number] = np.clip(target[number] + step[i], min(low, self.end[number]), max(high, self.end[number]))
        return target

    def told(self, target: FloatArray) -> None:
        """The piece is under way. What the envelope took of it is no velocity the next one may build on."""
        k = len(self.view.linear)
        moved = (target - self.end)[list(self.view.linear)]
        step = (self.command.velocity_mps + 0.5 * PIECE_S * self.command.acceleration_mps2)[:k] * PIECE_S
        is_cut = np.abs(moved - step) > _SHORT_M
        if is_cut.any():
            velocity, push = np.array(self.command.velocity_mps), np.array(self.command.acceleration_mps2)
            velocity[:k][is_cut], push[:k][is_cut] = moved[is_cut] / PIECE_S, 0.0
            c = self.command
            self.command = FollowCommand(
                c.t_ns, velocity, push, c.rate_radps, c.angular_acceleration_radps2, c.valid_s, c.mode, c.age_s,
                c.error_m, c.error_rad,
            )  # fmt: skip
        self.end = target
        self._path.append((self.command.t_ns + ns_from_s(PIECE_S), target))

    def _relative(self, line: SmoothedPose, t_ns: int) -> SmoothedPose:
        """The told end seen from where the axes should be when it is reached, the leader going on as it went."""
        ahead_s = s_from_ns(t_ns - line.t_ns) + self._lag_s
        wanted = line.leader_from_body.t_m + ahead_s * line.velocity_mps
        k = len(self.view.linear)
        here = np.zeros(3)
        here[:k] = self.end[list(self.view.linear)]
        velocity, _ = self.command.twist_at(t_ns)
        return SmoothedPose(
            line.t_ns,
            Pose(np.eye(3), here - wanted, "beacon", "body"),
            read_only(velocity - line.velocity_mps),
            np.zeros(3),
            line.count,
            line.velocity_delay_s,
            line.position_sigma_m,
        )


def law_for(law: FollowerConfig, axes: Sequence[Axis]) -> FollowerConfig:
    """The law with the limits the slowest of some linear axes can keep, told in pieces."""
    acceleration = min(law.acceleration_mps2, _SPARE * min(axis.acceleration for axis in axes))
    # What is told ahead must be long enough to brake in.
    brakes = 2.0 * min(axis.acceleration for axis in axes) * AHEAD_S
    speed = min(law.speed_mps, 0.9 * min(axis.max_speed for axis in axes), 0.75 * brakes)
    return replace(
        law, acceleration_mps2=acceleration, speed_mps=speed, closing_mps=min(law.closing_mps, speed), valid_s=PIECE_S
    )


def tell_piece(stream: MotionStream, follower: GantryFollower, t_ns: int) -> str:
    """Tell the next piece.

    Args:
        stream: The motion under way.
        follower: Who leads it.
        t_ns: When the piece begins, ns.

    Returns:
        Why it was not told, or empty: a piece through a keep-out box is left out, and the carriage stands.

    Raises:
        GantryError: The controller refused, fell silent, or raised an alarm.
    """
    target = follower.next_piece(t_ns)
    length = float(np.linalg.norm(target - stream.end))
    try:
        if length > _SHORT_M:
            stream.order(target, length / PIECE_S)
    except EnvelopeError as error:
        follower.told(follower.end)
        return str(error)
    follower.told(target)
    return ""


def position_at(stamps: Sequence[StampedPosition], t_ns: int) -> FloatArray | None:
    """Where the axes were at an instant, by the reports around it.

    Args:
        stamps: Reports in order of time.
        t_ns: The instant, ns.

    Returns:
        Positions, shape (A,), m or rad; None when no two reports enclose it.
    """
    for before, after in zip(reversed(stamps[:-1]), reversed(stamps[1:]), strict=False):
        if before.t_ns <= t_ns <= after.t_ns:
            share = (t_ns - before.t_ns) / max(after.t_ns - before.t_ns, 1)
            return read_only(before.position + share * (after.position - before.position))
    return None
