"""A mock GRBL 1.1 controller: a state machine in bench time that answers bytes with bytes and moves motors.

It has no thread and no clock: the caller says what time it is, and time never runs backwards. The firmware's main loop
is a generator that yields until when it sleeps; real-time bytes act at once, whatever the main loop does. Simplified
against the real one: motions stop between blocks; switches close without bounce; hard limits, overrides, the door,
probing, startup lines and work offsets are absent.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import inf
from typing import Self

import numpy as np

from uvgs_bench.devices.gantry.axes import Axis, AxisKind
from uvgs_bench.devices.sim.grbl_gcode import OVERLONG, Action, LineReader, Modal, Refused, read_line
from uvgs_bench.devices.sim.grbl_homing import Homing, SwitchNotFound, homing_senses
from uvgs_bench.devices.sim.grbl_motion import path_limits, trapezoid
from uvgs_bench.devices.sim.grbl_motors import Motors
from uvgs_bench.devices.sim.grbl_reports import Reporter
from uvgs_bench.devices.sim.grbl_settings import changed, factory_settings, printed, settings_for_axes
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.units import (
    S_PER_MIN,
    deg_from_rad,
    m_from_mm,
    mm_from_m,
    ns_from_s,
    rad_from_deg,
    s_from_ns,
)

PLANNER_BLOCKS = 15
RX_BYTES = 128
_BYTE_S = 10 / 115200
# The recording of real grbl 1.1h shows: a hold or jog cancel bites ~50 ms after its byte (prepared steps are run first,
# and FS shows their speed), a resume starts ~0.17 s after it, an alarm is followed by 0.5 s of silence.
_PREPARED_S = 0.05
_RESUME_S = 0.17
_ALARM_SILENCE_S = 0.5
_RESTART_S = 0.02

Program = Iterator[float]


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    target: FloatArray
    feed_mm_min: float | None
    is_jog: bool


class GrblDevice:
    """The controller with its motors and limit switches.

    Positions inside are motor positions in mm or deg, in a coordinate in which nothing ever jumps; the controller's
    machine position is this less an origin that power-up and homing set. For a device made by ``for_axes`` the two are
    equal once it is homed.

    Args:
        letters: Axis letters.
        kinds: Kind of each axis.
        settings: Numbered settings; the factory's when absent.
        switches_mm: Motor position at which each axis' limit switch closes (deg for rotary), or infinite for none.
        start_mm: Motor positions at power-up (deg for rotary).
        boot_s: Time from power-up to the welcome, s.
        version: What ``$I`` says.
    """

    def __init__(
        self,
        letters: str = "XYZ",
        kinds: Sequence[AxisKind] | None = None,
        settings: dict[int, float] | None = None,
        switches_mm: Sequence[float] = (12.0, 8.0, 4.0),
        start_mm: Sequence[float] | None = None,
        boot_s: float = 0.5,
        version: str = "1.1h.20190830",
    ) -> None:
        self.letters = letters
        self.kinds: Sequence[AxisKind] = kinds or ["linear"] * len(letters)
        self.settings = settings or factory_settings(len(letters))
        self._switches = np.array(switches_mm, dtype=np.float64)
        self._boot_s = boot_s
        self._version = version
        self._now_s = 0.0
        self._output: deque[tuple[float, bytes]] = deque()
        self._wire_free_s = 0.0
        start = np.zeros(len(letters)) if start_mm is None else np.array(start_mm, dtype=np.float64)
        self._motors = Motors(start)
        self._power_up()

    @classmethod
    def for_axes(cls, axes: Sequence[Axis], *, boot_s: float = 0.5) -> Self:
        """A controller set up for a gantry, standing a quarter of its travel below the switches.

        Args:
            axes: The axes.
            boot_s: Time from power-up to the welcome, s.

        Returns:
            The device; after homing its motor positions are the machine positions.
        """
        units = [mm_from_m if axis.kind == "linear" else deg_from_rad for axis in axes]
        return cls(
            letters="".join(axis.name for axis in axes),
            kinds=[axis.kind for axis in axes],
            settings=settings_for_axes(axes),
            switches_mm=[inf if axis.upper > 0.0 else 0.0 for axis in axes],
            start_mm=[
                0.0 if axis.upper > 0.0 else unit(0.25 * axis.lower) for axis, unit in zip(axes, units, strict=True)
            ],
            boot_s=boot_s,
        )

    # --- what the bench sees ---------------------------------------------------------------------------------------

    @property
    def steps_per_mm(self) -> FloatArray:
        """Steps per mm (deg for rotary), shape (A,)."""
        return self._axis_settings(100)

    def position_at(self, t_ns: int) -> FloatArray:
        """Where the motors are at an instant, now or before.

        Args:
            t_ns: Bench time, ns.

        Returns:
            Motor positions, shape (A,), m or rad.
        """
        return self._to_si(self._motors.position(self._advance(s_from_ns(t_ns))))

    def velocity_at(self, t_ns: int) -> FloatArray:
        """How fast the motors turn at an instant, shape (A,), m/s or rad/s."""
        return self._to_si(self._motors.velocity(self._advance(s_from_ns(t_ns))))

    def last_direction(self, t_ns: int) -> FloatArray:
        """The sense in which each axis moves, or moved last before an instant: +1, -1, or 0 for never; shape (A,)."""
        return self._motors.last_direction(self._advance(s_from_ns(t_ns)))

    def stops_count(self, t_ns: int) -> int:
        """How many motions have come to rest by an instant since the device was made."""
        return self._motors.stops_count(self._advance(s_from_ns(t_ns)))

    # --- the wire --------------------------------------------------------------------------------------------------

    def power_cycle(self, t_ns: int) -> None:
        """Reset as opening the port does: the motors stand still where they are, the position is forgotten."""
        self._advance(s_from_ns(t_ns))
        self._halt()
        self._output.clear()
        self._power_up()

    def receive(self, byte: int, t_ns: int) -> None:
        """Take one byte from the host.

        Args:
            byte: 0 to 255.
            t_ns: Bench time, ns.
        """
        self._advance(s_from_ns(t_ns))
        if byte == 0x18:
            self._soft_reset()
        elif byte in (0x3F, 0x21, 0x7E, 0x85):
            if not self._is_deaf:
                self._real_time(byte)
        elif byte < 0x80 and len(self._rx) < RX_BYTES:
            self._rx.append(byte)
        self._step_program()

    def take_output(self, t_ns: int) -> bytes:
        """The bytes sent to the host until an instant and not taken before."""
        t_s = s_from_ns(t_ns)
        self._advance(t_s)
        taken = bytearray()
        while self._output and self._output[0][0] <= t_s:
            taken += self._output.popleft()[1]
        return bytes(taken)

    def next_event_ns(self) -> int | None:
        """When something happens next without a byte from the host, bench time ns, or None for never."""
        event_s = min(self._output[0][0] if self._output else inf, self._next_event_s())
        return None if event_s == inf else ns_from_s(event_s)

    # --- time ------------------------------------------------------------------------------------------------------

    def _advance(self, t_s: float) -> float:
        while (event_s := self._next_event_s()) <= t_s:
            self._now_s = max(self._now_s, event_s)
            if self._motors.moving is not None and self._motors.moving.end_s <= self._now_s:
                self._finish_motion()
            self._step_program()
        self._now_s = max(self._now_s, t_s)
        return t_s

    def _next_event_s(self) -> float:
        moving = self._motors.moving
        return min(self._wake_s, moving.end_s if moving is not None else inf)

    def _step_program(self) -> None:
        program = None
        while program is not self._program:  # a line may restart the firmware
            program = self._program
            self._wake_s = next(program)

    # --- start and reset -------------------------------------------------------------------------------------------

    def _power_up(self) -> None:
        self._origin = self._here()
        self.state = "Alarm" if self.settings[22] else "Idle"
        self._forget()
        self._is_in_line = False
        self._program = self._restart(self._boot_s, None, has_stale_ok=False)
        self._step_program()

    def _forget(self) -> None:
        self._is_brake = False
        self._queue: deque[_Block] = deque()
        self._rx = bytearray()
        self._line = LineReader()
        self._modal = Modal()
        self._reporter = Reporter()
        self._is_deaf = True
        self._is_report_due = False
        self._wake_s = inf
        self._planned = self._machine()

    def _soft_reset(self) -> None:
        if self.state == "Boot":
            return
        alarm = None
        if self.state == "Home":
            alarm = 6
        elif self._motors.moving is not None:
            alarm = 3
        has_stale_ok, self._is_in_line = self._is_in_line, False
        self._halt()
        self.state = "Alarm" if alarm is not None or self.state in ("Alarm", "Sleep") else "Idle"
        self._forget()
        self._program = self._restart(_RESTART_S, alarm, has_stale_ok)

    def _restart(self, delay_s: float, alarm: int | None, has_stale_ok: bool) -> Program:
        after, self.state = self.state, "Boot"
        if alarm is not None:
            self._send(f"ALARM:{alarm}")
            yield from self._wait(_ALARM_SILENCE_S)
        if has_stale_ok:
            self._send("ok")
        yield from self._wait(delay_s)
        self.state = after
        self._rx.clear()
        self._is_deaf = False
        self._send("")
        self._send("Grbl 1.1h ['$' for help]")
        if self.state == "Alarm":
            self._send("[MSG:'$H'|'$X' to unlock]")
        yield from self._main()

    def _halt(self) -> None:
        if self._motors.moving is not None:
            self._motors.halt(self._now_s, self._machine() + self._origin)

    # --- main loop -------------------------------------------------------------------------------------------------

    def _wait(self, duration_s: float) -> Program:
        until_s = self._now_s + duration_s
        while self._now_s < until_s:
            yield until_s

    def _wait_until(self, is_met: Callable[[], bool]) -> Program:
        while not is_met():
            yield inf

    def _main(self) -> Program:
        while True:
            line = self._next_line()
            if line is None:
                yield inf
                continue
            self._is_in_line = True
            try:
                yield from self._run_line(line)
            except Refused as refusal:
                self._send(f"error:{refusal.code}")
            self._is_in_line = False

    def _next_line(self) -> str | None:
        while self._rx:
            line = self._line.push(self._rx.pop(0))
            if line is not None:
                return line
        return None

    def _run_line(self, line: str) -> Program:
        if line == OVERLONG:
            raise Refused(11)
        if line.startswith("$"):
            yield from self._system(line[1:])
            return
        if line:
            if self.state in ("Alarm", "Jog"):
                raise Refused(9)
            yield from self._gcode(line)
        self._send("ok")

    def _gcode(self, line: str) -> Program:
        action = read_line(line, self._modal, self.letters, self._planned)
        if action.modal.output_rpm != self._modal.output_rpm or action.modal.spindle != self._modal.spindle:
            if self.state != "Check":
                yield from self._wait_until(self._is_planner_empty)
            self._reporter.tell_overrides_next()
        self._modal = action.modal
        if self.state == "Check":
            return
        if action.dwell_s is not None:
            yield from self._wait_until(self._is_planner_empty)
            yield from self._wait(action.dwell_s)
        if action.target is not None:
            if self._is_beyond_travel(action.target):
                yield from self._soft_limit_alarm()
            yield from self._wait_until(lambda: len(self._queue) < PLANNER_BLOCKS)
            self._plan(action, is_jog=False)

    def _soft_limit_alarm(self) -> Program:
        if self.state == "Run":
            self._hold()
            yield from self._wait_until(lambda: self._motors.moving is None)
        self.state = "Alarm"
        self._is_deaf = True
        self._send("ALARM:2")
        yield from self._wait(_ALARM_SILENCE_S)
        self._send("[MSG:Reset to continue]")
        while True:
            yield inf

    # --- dollar lines ----------------------------------------------------------------------------------------------

    def _system(self, text: str) -> Program:
        if text.startswith("J="):
            yield from self._jog(text[2:])
            return
        if text == "G":
            self._send(self._modal.report())
        elif text == "":
            self._send("[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]")
        elif text == "C":
            self._toggle_check()
            return
        elif text == "X":
            if self.state == "Alarm":
                self.state = "Idle"
                self._send("[MSG:Caution: Unlocked]")
        elif self.state not in ("Idle", "Alarm"):
            raise Refused(8)
        elif text == "SLP":
            self._send("ok")
            self._send("[MSG:Sleeping]")
            self.state, self._is_in_line = "Sleep", False
            self._reporter.tell_overrides_next()
            while True:
                yield inf
        elif text == "H":
            yield from self._home()
        else:
            self._answer_query(text)
        self._send("ok")

    def _answer_query(self, text: str) -> None:
        zero = ",".join("0.000" for _ in self.letters)
        if text == "$":
            for number in sorted(self.settings):
                self._send(printed(number, self.settings[number]))
        elif text == "I":
            self._send(f"[VER:{self._version}:]")
            self._send(f"[OPT:V,{PLANNER_BLOCKS},{RX_BYTES}]")
        elif text == "N":
            self._send("$N0=")
            self._send("$N1=")
        elif text == "#":
            for name in ("G54", "G55", "G56", "G57", "G58", "G59", "G28", "G30", "G92"):
                self._send(f"[{name}:{zero}]")
            self._send("[TLO:0.000]")
            self._send(f"[PRB:{zero}:0]")
        elif "=" in text:
            self.settings = changed(self.settings, text)
        else:
            raise Refused(3)

    def _toggle_check(self) -> None:
        if self.state == "Check":
            self._send("[MSG:Disabled]")
            self._send("ok")
            self._is_in_line = False
            self.state = "Idle"
            self._forget()
            self._program = self._restart(_RESTART_S, None, has_stale_ok=False)
            return
        if self.state != "Idle":
            raise Refused(8)
        self.state = "Check"
        self._send("[MSG:Enabled]")
        self._send("ok")

    def _jog(self, text: str) -> Program:
        if self.state not in ("Idle", "Jog"):
            raise Refused(8)
        action = read_line(text, self._modal, self.letters, self._planned, is_jog=True)
        assert action.target is not None
        if self._is_beyond_travel(action.target):
            raise Refused(15)
        yield from self._wait_until(lambda: len(self._queue) < PLANNER_BLOCKS)
        self._plan(action, is_jog=True)
        self._send("ok")

    # --- motion ----------------------------------------------------------------------------------------------------

    def _is_planner_empty(self) -> bool:
        return not self._queue

    def _is_beyond_travel(self, target: FloatArray) -> bool:
        travel = self._axis_settings(130)
        limited = travel > 0.0
        # Half a step: the real one compares single-precision numbers it has rounded itself.
        slack = 0.5 / self.steps_per_mm
        return bool(self.settings[20] and np.any(limited & ((target > slack) | (target < -travel - slack))))

    def _plan(self, action: Action, *, is_jog: bool) -> None:
        assert action.target is not None
        target = self._on_step(action.target)
        if np.array_equal(target, self._on_step(self._planned)):
            return
        self._planned = target
        self._queue.append(_Block(read_only(target), action.feed_mm_min, is_jog))
        if self._motors.moving is None and self.state in ("Idle", "Run", "Jog"):
            self._start_block(self._now_s)

    def _start_block(self, start_s: float) -> None:
        block = self._queue[0]
        start, end = self._here(), block.target + self._origin
        speed, acceleration = path_limits(end - start, self._axis_settings(110) / S_PER_MIN, self._axis_settings(120))
        if block.feed_mm_min is not None:
            speed = min(speed, block.feed_mm_min / S_PER_MIN)
        self.state = "Jog" if block.is_jog else "Run"
        self._motors.begin(trapezoid(start, end, start_s, speed, acceleration))

    def _finish_motion(self) -> None:
        self._motors.finish()
        if self.state == "Home":
            return
        was_braked, self._is_brake = self._is_brake, False
        if self.state == "Jog" and was_braked:
            self._queue.clear()
        elif not was_braked:
            self._queue.popleft()
        if self.state == "Hold":
            return
        if self._queue:
            self._start_block(self._now_s)
        else:
            self._planned = self._machine()
            self.state = "Idle"

    def _hold(self) -> None:
        self.state = "Hold"
        self._brake()

    def _brake(self) -> None:
        if self._motors.moving is None or self._is_brake:
            return
        bite_s = self._now_s + _PREPARED_S
        if bite_s < self._motors.moving.end_s:
            braked = self._motors.moving.braked(bite_s)
            self._motors.amend(braked.ending_at(self._on_step(braked.end)))
            self._is_brake = True

    def _real_time(self, byte: int) -> None:
        if byte == 0x3F:
            if self.state == "Home":
                self._is_report_due = True
            else:
                self._send(self._report())
        elif byte == 0x85 or (byte == 0x21 and self.state == "Jog"):
            if self.state == "Jog":
                while len(self._queue) > 1:
                    self._queue.pop()
                self._brake()
        elif byte == 0x21:
            if self.state in ("Idle", "Run"):
                self._hold()
        elif self.state == "Hold" and self._motors.moving is None:
            self.state = "Idle"
            if self._queue:
                self._start_block(self._now_s + _RESUME_S)

    def _home(self) -> Program:
        if not self.settings[22]:
            raise Refused(5)
        self.state = "Home"
        homing = Homing(self.letters, self.settings, self._switches, self._motors, lambda: self._now_s)
        try:
            yield from homing.run()
        except SwitchNotFound:
            self.state = "Alarm"
            self._forget()
            self._is_in_line = False
            self._program = self._restart(_RESTART_S, 9, has_stale_ok=True)
            yield inf
        self._origin = self._here() - homing.machine_position()
        self._planned = self._machine()
        if self._is_report_due:
            self._send(self._report())
            self._is_report_due = False
        self.state = "Idle"
        self._reporter.tell_overrides_next()

    # --- reports ---------------------------------------------------------------------------------------------------

    def _report(self) -> str:
        state, moving = self.state, self._motors.moving
        if state == "Hold":
            state = "Hold:1" if moving is not None else "Hold:0"
        senses = homing_senses(self.settings, len(self.letters))
        closed = senses * (self._here() - self._switches) >= 0.0
        speed = 0.0 if moving is None else moving.along_path(self._now_s + _PREPARED_S)[1]
        return self._reporter.write(
            state,
            self._machine(),
            mask=int(self.settings[10]),
            buffers=(PLANNER_BLOCKS - len(self._queue), RX_BYTES - len(self._rx)),
            feed_mm_min=speed * S_PER_MIN,
            modal=self._modal,
            pins="".join(letter for letter, is_closed in zip(self.letters, closed, strict=True) if is_closed),
        )

    def _send(self, line: str) -> None:
        data = line.encode("ascii") + b"\r\n"
        self._wire_free_s = max(self._wire_free_s, self._now_s) + len(data) * _BYTE_S
        self._output.append((self._wire_free_s, data))

    # --- positions -------------------------------------------------------------------------------------------------

    def _axis_settings(self, base: int) -> FloatArray:
        return np.array([self.settings[base + i] for i in range(len(self.letters))])

    def _here(self) -> FloatArray:
        return self._motors.position(self._now_s)

    def _machine(self) -> FloatArray:
        return self._on_step(self._here() - self._origin)

    def _on_step(self, position: FloatArray) -> FloatArray:
        steps = self.steps_per_mm
        return np.round(position * steps) / steps

    def _to_si(self, values: FloatArray) -> FloatArray:
        return read_only(
            [
                m_from_mm(float(value)) if kind == "linear" else rad_from_deg(float(value))
                for value, kind in zip(values, self.kinds, strict=True)
            ]
        )
