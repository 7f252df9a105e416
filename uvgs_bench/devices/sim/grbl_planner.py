"""The moving half of a mock GRBL 1.1: queued blocks become motions, which are held, cancelled, resumed and cut off.

Blocks follow each other without a stop, as fast through a corner as the junction deviation ($11) allows and no faster
than what is queued can be braked.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf, sqrt

import numpy as np

from uvgs_bench.devices.sim.grbl_gcode import Action
from uvgs_bench.devices.sim.grbl_motion import path_limits, through
from uvgs_bench.devices.sim.grbl_motors import Motors
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.units import S_PER_MIN

PLANNER_BLOCKS = 15
# The recording of real grbl 1.1h shows: a hold or jog cancel bites ~50 ms after its byte (prepared steps are run first,
# and FS shows their speed), and a resume starts ~0.17 s after it.
_PREPARED_S = 0.05
_RESUME_S = 0.17


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """A planned move: machine positions, unit vector, and what is allowed along it, per s and per s^2."""

    start: FloatArray
    target: FloatArray
    feed_mm_min: float | None
    is_jog: bool
    unit: FloatArray
    length: float
    speed: float
    acceleration: float


class Planner:
    """Blocks, motors and the state of motion. Positions in mm or deg.

    Attributes:
        state: The controller's state word.
        now_s: Bench time, s; set by the owner, never backwards.
        settings: Numbered settings.
        motors: What moves.
        target: Machine position where all that is planned will end, shape (A,).

    Args:
        axis_count: Number of axes.
        settings: Numbered settings.
        start: Motor positions, shape (A,).
    """

    def __init__(self, axis_count: int, settings: Mapping[int, float], start: Sequence[float]) -> None:
        self.state = "Idle"
        self.now_s = 0.0
        self.settings = dict(settings)
        self.motors = Motors(np.array(start, dtype=np.float64))
        self._count = axis_count
        self._origin = self.here()
        self.forget()

    def forget(self) -> None:
        """Drop all blocks."""
        self._queue: deque[_Block] = deque()
        self._is_braking = False
        self.target = self.position()

    def halt(self) -> None:
        """Stand still at once, on a whole step, as when the step pulses cease."""
        if self.motors.moving is not None:
            self.motors.halt(self.now_s, self.position() + self._origin)

    # --- where it is -----------------------------------------------------------------------------------------------

    def axis_settings(self, base: int) -> FloatArray:
        """One setting for every axis, shape (A,)."""
        return np.array([self.settings[base + i] for i in range(self._count)])

    def here(self) -> FloatArray:
        """Motor positions now, shape (A,)."""
        return self.motors.position(self.now_s)

    def position(self) -> FloatArray:
        """Machine position now, in whole steps, shape (A,)."""
        return self._on_step(self.here() - self._origin)

    def call_here(self, machine: FloatArray) -> None:
        """Give the place where the motors are a machine position, shape (A,)."""
        self._origin = self.here() - machine
        self.target = self.position()

    def prepared_speed(self) -> float:
        """Speed along the path of the steps that are prepared now, per s."""
        moving = self.motors.moving
        return 0.0 if moving is None else moving.along_path(self.now_s + _PREPARED_S)[1]

    def is_beyond_travel(self, target: FloatArray) -> bool:
        """Whether soft limits are on and a machine position lies outside them; travel 0 means none."""
        travel = self.axis_settings(130)
        # Half a step: the real one compares single-precision numbers it has rounded itself.
        slack = 0.5 / self.axis_settings(100)
        is_outside = (target > slack) | (target < -travel - slack)
        return bool(self.settings[20] and np.any((travel > 0.0) & is_outside))

    def _on_step(self, position: FloatArray) -> FloatArray:
        steps = self.axis_settings(100)
        return np.round(position * steps) / steps

    # --- what it does ----------------------------------------------------------------------------------------------

    @property
    def free_blocks(self) -> int:
        """How many more blocks fit; the one being executed counts as well."""
        return PLANNER_BLOCKS - len(self._queue)

    def is_empty(self) -> bool:
        """Whether nothing is planned or moves."""
        return not self._queue

    def has_room(self) -> bool:
        """Whether one more block fits."""
        return self.free_blocks > 0

    def add(self, action: Action, *, is_jog: bool) -> None:
        """Plan a move, and begin it when nothing moves and nothing is held; no block for a move of no length."""
        assert action.target is not None
        target = self._on_step(action.target)
        start = self._on_step(self.target)
        if np.array_equal(target, start):
            return
        self.target = target
        self._queue.append(self._block(start, target, action.feed_mm_min, is_jog))
        if self.motors.moving is None and self.state in ("Idle", "Run", "Jog"):
            self._begin_block(self.now_s)
        elif self.motors.moving is not None and self.state in ("Run", "Jog") and not self._is_braking:
            block = self._queue[0]
            self.motors.amend(self.motors.moving.going_on(self.now_s, block.speed, self._exit_speed()))

    def finish_motion(self) -> None:
        """The motion under way has ended: begin the next block, or rest."""
        ended = self.motors.moving
        self.motors.finish()
        if self.state == "Home":
            return
        if ended is not None and ended.exit_speed > 0.0 and len(self._queue) > 1:
            self._queue.popleft()
            self._begin_block(ended.end_s, ended.exit_speed)
            return
        was_braked, self._is_braking = self._is_braking, False
        if self.state == "Jog" and was_braked:
            self._queue.clear()
        elif not was_braked:
            self._queue.popleft()
        if self.state == "Hold":
            return
        if self._queue:
            self._begin_block(self.now_s)
        else:
            self.target = self.position()
            self.state = "Idle"

    def hold(self) -> None:
        """Decelerate and keep what is planned; a jog is cancelled instead."""
        if self.state == "Jog":
            self.cancel_jog()
        elif self.state in ("Idle", "Run"):
            self.state = "Hold"
            self._brake()

    def cancel_jog(self) -> None:
        """Decelerate and drop all jogs; nothing in any other state."""
        if self.state == "Jog":
            self._brake()
            while not self._is_braking and len(self._queue) > 1:
                self._queue.pop()

    def resume(self) -> None:
        """Go on after a hold; nothing while it still decelerates."""
        if self.state == "Hold" and self.motors.moving is None:
            self.state = "Idle"
            if self._queue:
                self._begin_block(self.now_s + _RESUME_S)

    def _block(self, start: FloatArray, target: FloatArray, feed_mm_min: float | None, is_jog: bool) -> _Block:
        speed, acceleration = path_limits(target - start, self.axis_settings(110) / S_PER_MIN, self.axis_settings(120))
        if feed_mm_min is not None:
            speed = min(speed, feed_mm_min / S_PER_MIN)
        length = float(np.linalg.norm(target - start))
        unit = (target - start) / length if length > 0.0 else np.zeros_like(target)
        return _Block(
            read_only(start), read_only(target), feed_mm_min, is_jog, read_only(unit), length, speed, acceleration
        )

    def _begin_block(self, start_s: float, entry_speed: float = 0.0) -> None:
        old = self._queue[0]
        start, end = self.here(), old.target + self._origin
        # A block that was held begins anew where it stands.
        block = self._queue[0] = self._block(start - self._origin, old.target, old.feed_mm_min, old.is_jog)
        self.state = "Hold" if self.state == "Hold" else "Jog" if block.is_jog else "Run"
        leaving = 0.0 if self._is_braking else self._exit_speed()
        motion = through(start, end, start_s, entry_speed, leaving, block.speed, block.acceleration)
        if self._is_braking:
            motion = motion.braked(start_s)
            if motion.exit_speed == 0.0:
                motion = motion.ending_at(self._on_step(motion.end - self._origin) + self._origin)
        self.motors.begin(motion)

    def _exit_speed(self) -> float:
        """Speed at which the first block may hand over to the second, such that all that is queued can be braked."""
        speed = 0.0
        blocks = list(self._queue)
        for before, block in zip(reversed(blocks[:-1]), reversed(blocks[1:]), strict=True):
            reach = sqrt(speed * speed + 2.0 * block.acceleration * block.length)
            speed = min(reach, before.speed, block.speed, self._junction_speed(before, block))
        return speed

    def _junction_speed(self, before: _Block, after: _Block) -> float:
        """Speed at which a circle of the junction deviation beside the corner keeps the acceleration."""
        cosine = -float(before.unit @ after.unit)
        if cosine > 0.999999:
            return 0.0
        if cosine < -0.999999:
            return inf
        half_sine = sqrt(0.5 * (1.0 - cosine))
        deviation = self.settings[11]
        return sqrt(min(before.acceleration, after.acceleration) * deviation * half_sine / (1.0 - half_sine))

    def _brake(self) -> None:
        moving, bite_s = self.motors.moving, self.now_s + _PREPARED_S
        if moving is None or self._is_braking:
            return
        if bite_s < moving.end_s:
            braked = moving.braked(bite_s)
            if braked.exit_speed == 0.0:
                on_step = self._on_step(braked.end - self._origin) + self._origin
                braked = braked.ending_at(on_step)
            self.motors.amend(braked)
            self._is_braking = True
        elif moving.exit_speed > 0.0:
            self._is_braking = True
