"""A mock GRBL 1.1 controller: a state machine in bench time that answers bytes with bytes and moves motors.

It has no thread and no clock: the caller says what time it is, and time never runs backwards. The firmware's main loop
is a generator that yields until when it sleeps; real-time bytes act at once, whatever the main loop is doing. Simplified
against the real one: motions stop between blocks; switches close without bounce; hard limits, overrides, the door,
probing, startup lines and work offsets are absent.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import inf
from typing import Self

import numpy as np

from uvgs_bench.devices.gantry.axes import Axis, AxisKind
from uvgs_bench.devices.sim.grbl_gcode import Action, Modal, Refused, read_line
from uvgs_bench.devices.sim.grbl_motion import Motion, path_limits, run_into, trapezoid
from uvgs_bench.devices.sim.grbl_settings import changed, factory_settings, printed, settings_for_axes
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.units import (
    S_PER_MIN,
    deg_from_rad,
    m_from_mm,
    mm_from_m,
    ns_from_s,
    rad_from_deg,
    s_from_ms,
    s_from_ns,
)

PLANNER_BLOCKS = 15
RX_BYTES = 128
LINE_CHARACTERS = 79
_BYTE_S = 10 / 115200
# The recording of real grbl 1.1h shows: a hold or jog cancel bites ~50 ms after its byte (steps already prepared are run
# first, and FS shows their speed), a resume starts ~0.17 s after it, an alarm is followed by 0.5 s of silence.
_PREPARED_S = 0.05
_RESUME_S = 0.17
_ALARM_SILENCE_S = 0.5
_RESTART_S = 0.02
_WCO_EVERY = {False: 10, True: 30}
_OV_EVERY = {False: 10, True: 20}
_KEPT_MOTIONS = 4096

Program = Iterator[float]


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    target: FloatArray
    feed_mm_min: float | None
    is_jog: bool


class GrblDevice:
    """The controller with its motors and limit switches.

    Positions inside are motor positions in mm or deg, in a coordinate in which nothing ever jumps; the controller's machine
    position is this less an origin that power-up and homing set. For a device made by ``for_axes`` the two are equal once
    it is homed.

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
        self.kinds: tuple[AxisKind, ...] = tuple(kinds) if kinds else ("linear",) * len(letters)
        self.settings = settings or factory_settings(len(letters))
        self._switches = np.array(switches_mm, dtype=np.float64)
        self._boot_s = boot_s
        self._version = version
        self._now_s = 0.0
        self._output: deque[tuple[float, bytes]] = deque()
        self._wire_free_s = 0.0
        start = np.zeros(len(letters)) if start_mm is None else np.array(start_mm, dtype=np.float64)
        self._motions: list[Motion] = [trapezoid(start, start, 0.0, 1.0, 1.0)]
        self._directions: list[FloatArray] = [np.zeros(len(letters))]
        self._dropped_motions = 0
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
        return self._to_si(self._motion_at(t_ns)[1].position(s_from_ns(t_ns)))

    def velocity_at(self, t_ns: int) -> FloatArray:
        """How fast the motors turn at an instant, shape (A,), m/s or rad/s."""
        return self._to_si(self._motion_at(t_ns)[1].velocity(s_from_ns(t_ns)))

    def last_direction(self, t_ns: int) -> FloatArray:
        """The sense in which each axis moves, or moved last before an instant: +1, -1, or 0 for never; shape (A,)."""
        return self._directions[self._motion_at(t_ns)[0]]

    def stops_count(self, t_ns: int) -> int:
        """How many motions have come to rest by an instant since the device was made."""
        index, motion = self._motion_at(t_ns)
        return self._dropped_motions + index - (0 if s_from_ns(t_ns) >= motion.end_s else 1)

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

    def _advance(self, t_s: float) -> None:
        while (event_s := self._next_event_s()) <= t_s:
            self._now_s = max(self._now_s, event_s)
            if self._moving is not None and self._moving.end_s <= self._now_s:
                self._finish_motion()
            self._step_program()
        self._now_s = max(self._now_s, t_s)

    def _next_event_s(self) -> float:
        return min(self._wake_s, self._moving.end_s if self._moving is not None else inf)

    def _step_program(self) -> None:
        program = None
        while program is not self._program:  # a line may restart the firmware
            program = self._program
            self._wake_s = next(program)

    # --- start and reset -------------------------------------------------------------------------------------------

    def _power_up(self) -> None:
        self._origin = self._motors()
        self.state = "Alarm" if self.settings[22] else "Idle"
        self._forget()
        self._is_in_line = False
        self._program = self._restart(self._boot_s, None, has_stale_ok=False)
        self._step_program()

    def _forget(self) -> None:
        self._moving: Motion | None = None
        self._is_brake = False
        self._queue: deque[_Block] = deque()
        self._rx = bytearray()
        self._line = bytearray()
        self._is_overlong = False
        self._comment = ""
        self._modal = Modal()
        self._wco_countdown = 0
        self._ov_countdown = 0
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
        elif self._moving is not None:
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
        if self._moving is not None:
            here = self._on_step(self._moving.position(self._now_s))
            self._replace_motion(self._moving.cut(self._now_s, here))
            self._moving = None

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
        """Assemble a line as the firmware does: blanks and comments do not count, both CR and LF end it."""
        while self._rx:
            character = chr(self._rx.pop(0))
            if character in "\r\n":
                line = "\x00" if self._is_overlong else self._line.decode("ascii")
                self._line.clear()
                self._is_overlong, self._comment = False, ""
                return line
            if self._comment:
                if self._comment == "(" and character == ")":
                    self._comment = ""
            elif character in "(;":
                self._comment = character
            elif character > " " and character != "/":
                self._is_overlong = self._is_overlong or len(self._line) >= LINE_CHARACTERS
                if not self._is_overlong:
                    self._line += character.upper().encode("ascii")
        return None

    def _run_line(self, line: str) -> Program:
        if line == "\x00":
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
            self._ov_countdown = 0
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
            yield from self._wait_until(lambda: self._moving is None)
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
            self.state, self._ov_countdown, self._is_in_line = "Sleep", 0, False
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
        if self._moving is None and self.state in ("Idle", "Run", "Jog"):
            self._start_block(self._now_s)

    def _start_block(self, start_s: float) -> None:
        block = self._queue[0]
        start, end = self._motors(), block.target + self._origin
        speed, acceleration = path_limits(end - start, self._axis_settings(110) / S_PER_MIN, self._axis_settings(120))
        if block.feed_mm_min is not None:
            speed = min(speed, block.feed_mm_min / S_PER_MIN)
        self.state = "Jog" if block.is_jog else "Run"
        self._begin(trapezoid(start, end, start_s, speed, acceleration))

    def _begin(self, motion: Motion) -> None:
        self._moving = motion
        direction = np.sign(np.round(motion.unit, 9))
        self._motions.append(motion)
        self._directions.append(read_only(np.where(direction == 0.0, self._directions[-1], direction)))
        if len(self._motions) > 2 * _KEPT_MOTIONS:
            del self._motions[:_KEPT_MOTIONS], self._directions[:_KEPT_MOTIONS]
            self._dropped_motions += _KEPT_MOTIONS

    def _replace_motion(self, motion: Motion) -> None:
        self._motions[-1] = motion
        self._moving = motion

    def _finish_motion(self) -> None:
        self._moving = None
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
        if self._moving is None or self._is_brake:
            return
        bite_s = self._now_s + _PREPARED_S
        if bite_s < self._moving.end_s:
            braked = self._moving.braked(bite_s)
            self._replace_motion(braked.ending_at(self._on_step(braked.end)))
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
        elif self.state == "Hold" and self._moving is None:
            self.state = "Idle"
            if self._queue:
                self._start_block(self._now_s + _RESUME_S)

    def _home(self) -> Program:
        if not self.settings[22]:
            raise Refused(5)
        self.state = "Home"
        self._queue.clear()
        for axes in (["Z"], ["X", "Y"], [letter for letter in self.letters if letter not in "XYZ"]):
            cycle = [self.letters.index(letter) for letter in axes if letter in self.letters]
            cycle = [i for i in cycle if np.isfinite(self._switches[i])]
            if cycle:
                yield from self._home_cycle(cycle)
        pull_off, travel = self.settings[27], self._axis_settings(130)
        machine = np.where(self._homing_senses() > 0.0, -pull_off, pull_off - travel)
        machine = np.where(np.isfinite(self._switches), machine, 0.0)
        self._origin = self._motors() - machine
        self._planned = self._machine()
        if self._is_report_due:
            self._send(self._report())
            self._is_report_due = False
        self.state, self._ov_countdown = "Idle", 0

    def _home_cycle(self, cycle: Sequence[int]) -> Program:
        pull_off, debounce_s = self.settings[27], s_from_ms(self.settings[26])
        senses = self._homing_senses()
        for speed_mm_min, reach in (
            (self.settings[25], 1.5 * self._axis_settings(130)),
            (self.settings[24], np.full(len(self.letters), 5.0 * pull_off)),
        ):
            yield from self._seek(cycle, speed_mm_min / S_PER_MIN, reach)
            yield from self._wait(debounce_s)
            start = self._motors()
            end = start.copy()
            end[cycle] -= senses[cycle] * pull_off
            _, acceleration = path_limits(end - start, self._axis_settings(110), self._axis_settings(120))
            self._begin(trapezoid(start, end, self._now_s, self.settings[25] / S_PER_MIN, acceleration))
            yield from self._wait_until(lambda: self._moving is None)
            yield from self._wait(debounce_s)

    def _seek(self, cycle: Sequence[int], speed: float, reach: FloatArray) -> Program:
        """Run axes towards their switches together; each stops at its own. One that finds none raises alarm 9."""
        senses = self._homing_senses()
        start = self._motors()
        ways = {i: max(0.0, float(senses[i] * (self._switches[i] - start[i]))) for i in cycle}
        limit = min(float(reach[i]) for i in cycle)
        done, acceleration = 0.0, float(np.min(self._axis_settings(120)[list(cycle)]))
        for way in sorted({min(way, limit) for way in ways.values()}):
            going = [i for i in cycle if ways[i] > done]
            if not going or way <= done:
                continue
            end = self._motors().copy()
            end[going] += senses[going] * (way - done)
            share = float(np.sqrt(len(going)))
            self._begin(run_into(self._motors(), end, self._now_s, speed * share, acceleration * share))
            yield from self._wait_until(lambda: self._moving is None)
            done, acceleration = way, inf
        if any(way > limit for way in ways.values()):
            self.state = "Alarm"
            self._is_in_line = False
            self._forget()
            self._program = self._restart(_RESTART_S, 9, has_stale_ok=True)
            yield inf

    def _homing_senses(self) -> FloatArray:
        mask = int(self.settings[23])
        return np.array([-1.0 if mask >> i & 1 else 1.0 for i in range(len(self.letters))])

    # --- reports ---------------------------------------------------------------------------------------------------

    def _report(self) -> str:
        state = self.state
        if state == "Hold":
            state = "Hold:1" if self._moving is not None else "Hold:0"
        is_busy = state in ("Run", "Jog", "Home") or state.startswith("Hold")
        position = self._on_step(self._motors() - self._origin) + 0.0
        mask = int(self.settings[10])
        # Work offsets are always zero here, so the two positions differ in name only.
        fields = [state, ("MPos:" if mask & 1 else "WPos:") + ",".join(f"{p:.3f}" for p in position)]
        if mask & 2:
            fields.append(f"Bf:{PLANNER_BLOCKS - len(self._queue)},{RX_BYTES - len(self._rx)}")
        speed = 0.0 if self._moving is None else self._moving.along_path(self._now_s + _PREPARED_S)[1]
        fields.append(f"FS:{int(speed * S_PER_MIN)},{self._modal.output_rpm:.0f}")
        pressed = "".join(
            letter
            for letter, at, switch, sense in zip(
                self.letters, self._motors(), self._switches, self._homing_senses(), strict=True
            )
            if sense * (at - switch) >= 0.0
        )
        if pressed:
            fields.append(f"Pn:{pressed}")
        fields += self._rare_fields(is_busy)
        return "<" + "|".join(fields) + ">"

    def _rare_fields(self, is_busy: bool) -> list[str]:
        """Offset and overrides are told only now and then: the offset first, the overrides in the report after it."""
        fields = []
        if self._wco_countdown > 0:
            self._wco_countdown -= 1
        else:
            self._wco_countdown = _WCO_EVERY[is_busy] - 1
            self._ov_countdown = max(self._ov_countdown, 1)
            fields.append("WCO:" + ",".join("0.000" for _ in self.letters))
        if self._ov_countdown > 0:
            self._ov_countdown -= 1
        else:
            self._ov_countdown = _OV_EVERY[is_busy] - 1
            fields.append("Ov:100,100,100")
            accessories = {"M3": "S", "M4": "C"}.get(self._modal.spindle, "")
            accessories += "F" if self._modal.coolant == "M8" else ""
            if accessories:
                fields.append(f"A:{accessories}")
        return fields

    def _send(self, line: str) -> None:
        data = line.encode("ascii") + b"\r\n"
        self._wire_free_s = max(self._wire_free_s, self._now_s) + len(data) * _BYTE_S
        self._output.append((self._wire_free_s, data))

    # --- positions -------------------------------------------------------------------------------------------------

    def _axis_settings(self, base: int) -> FloatArray:
        return np.array([self.settings[base + i] for i in range(len(self.letters))])

    def _motors(self) -> FloatArray:
        return self._motions[-1].position(self._now_s)

    def _machine(self) -> FloatArray:
        return self._on_step(self._motors() - self._origin)

    def _on_step(self, position: FloatArray) -> FloatArray:
        steps = self.steps_per_mm
        return np.round(position * steps) / steps

    def _motion_at(self, t_ns: int) -> tuple[int, Motion]:
        t_s = s_from_ns(t_ns)
        self._advance(t_s)
        index = max(0, bisect_right(self._motions, t_s, key=lambda motion: motion.start_s) - 1)
        return index, self._motions[index]

    def _to_si(self, values: FloatArray) -> FloatArray:
        return read_only(
            [
                m_from_mm(float(value)) if kind == "linear" else rad_from_deg(float(value))
                for value, kind in zip(values, self.kinds, strict=True)
            ]
        )
