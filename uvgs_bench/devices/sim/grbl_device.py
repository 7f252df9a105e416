"""A mock GRBL 1.1 controller: a state machine in bench time that answers bytes with bytes and moves motors.

It has no thread and no clock: the caller says what time it is, and time never runs backwards. The firmware's main loop
is a generator that yields until when it sleeps; real-time bytes act at once, whatever the main loop does. Simplified
against the real one: switches close without bounce; hard limits, overrides, the door, probing, startup lines and work
offsets are absent.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from math import inf
from typing import Self

import numpy as np

from uvgs_bench.devices.gantry.axes import Axis, AxisKind
from uvgs_bench.devices.sim.grbl_gcode import OVERLONG, LineReader, Modal, Refused, read_line
from uvgs_bench.devices.sim.grbl_homing import Homing, SwitchNotFound, homing_senses
from uvgs_bench.devices.sim.grbl_motors import Motors
from uvgs_bench.devices.sim.grbl_planner import PLANNER_BLOCKS, Planner
from uvgs_bench.devices.sim.grbl_reports import Reporter, answers
from uvgs_bench.devices.sim.grbl_settings import changed, factory_settings, settings_for_axes, si_positions
from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import (
    S_PER_MIN,
    deg_from_rad,
    mm_from_m,
    ns_from_s,
    s_from_ns,
)

RX_BYTES = 128
_BYTE_S = 10 / 115200
# Silence after an alarm, as recorded with real grbl 1.1h.
_ALARM_SILENCE_S = 0.5
_RESTART_S = 0.02

Program = Iterator[float]


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
        self._switches = np.array(switches_mm, dtype=np.float64)
        self._boot_s = boot_s
        self._version = version
        self._output: deque[tuple[float, bytes]] = deque()
        self._wire_free_s = 0.0
        start = [0.0] * len(letters) if start_mm is None else start_mm
        self._planner = Planner(len(letters), settings or factory_settings(len(letters)), start)
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

    @property
    def state(self) -> str:
        """The controller's state word."""
        return self._planner.state

    @property
    def settings(self) -> dict[int, float]:
        """Numbered settings; they outlive resets and power."""
        return self._planner.settings

    # --- what the bench sees ---------------------------------------------------------------------------------------

    @property
    def steps_per_mm(self) -> FloatArray:
        """Steps per mm (deg for rotary), shape (A,)."""
        return self._planner.axis_settings(100)

    def position_at(self, t_ns: int) -> FloatArray:
        """Where the motors are at an instant, now or before.

        Args:
            t_ns: Bench time, ns.

        Returns:
            Motor positions, shape (A,), m or rad.
        """
        return si_positions(self.kinds, self._planner.motors.position(self._advance(s_from_ns(t_ns))))

    def velocity_at(self, t_ns: int) -> FloatArray:
        """How fast the motors turn at an instant, shape (A,), m/s or rad/s."""
        return si_positions(self.kinds, self._planner.motors.velocity(self._advance(s_from_ns(t_ns))))

    def motions_until(self, t_ns: int) -> Motors:
        """The motors with the motions they made, brought forward to an instant."""
        self._advance(s_from_ns(t_ns))
        return self._planner.motors

    # --- the wire --------------------------------------------------------------------------------------------------

    def power_cycle(self, t_ns: int) -> None:
        """Reset as opening the port does: the motors stand still where they are, the position is forgotten."""
        self._advance(s_from_ns(t_ns))
        self._planner.halt()
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
            self._planner.now_s = max(self._planner.now_s, event_s)
            if self._planner.motors.moving is not None and self._planner.motors.moving.end_s <= self._planner.now_s:
                self._planner.finish_motion()
            self._step_program()
        self._planner.now_s = max(self._planner.now_s, t_s)
        return t_s

    def _next_event_s(self) -> float:
        moving = self._planner.motors.moving
        return min(self._wake_s, moving.end_s if moving is not None else inf)

    def _step_program(self) -> None:
        program = None
        while program is not self._program:  # a line may restart the firmware
            program = self._program
            self._wake_s = next(program)

    # --- start and reset -------------------------------------------------------------------------------------------

    def _power_up(self) -> None:
        self._planner.call_here(np.zeros(len(self.letters)))
        self._planner.state = "Alarm" if self.settings[22] else "Idle"
        self._forget()
        self._is_in_line = False
        self._program = self._restart(self._boot_s, None, has_stale_ok=False)
        self._step_program()

    def _forget(self) -> None:
        self._planner.forget()
        self._rx = bytearray()
        self._line = LineReader()
        self._modal = Modal()
        self._reporter = Reporter()
        self._is_deaf = True
        self._is_report_due = False
        self._wake_s = inf

    def _soft_reset(self) -> None:
        if self.state == "Boot":
            return
        alarm = None
        if self.state == "Home":
            alarm = 6
        elif self._planner.motors.moving is not None:
            alarm = 3
        has_stale_ok, self._is_in_line = self._is_in_line, False
        self._planner.halt()
        self._planner.state = "Alarm" if alarm is not None or self.state in ("Alarm", "Sleep") else "Idle"
        self._forget()
        self._program = self._restart(_RESTART_S, alarm, has_stale_ok)

    def _restart(self, delay_s: float, alarm: int | None, has_stale_ok: bool) -> Program:
        after, self._planner.state = self.state, "Boot"
        if alarm is not None:
            self._send(f"ALARM:{alarm}")
            yield from self._wait(_ALARM_SILENCE_S)
        if has_stale_ok:
            self._send("ok")
        yield from self._wait(delay_s)
        self._planner.state = after
        self._rx.clear()
        self._is_deaf = False
        self._send("")
        self._send("Grbl 1.1h ['$' for help]")
        if self.state == "Alarm":
            self._send("[MSG:'$H'|'$X' to unlock]")
        yield from self._main()

    # --- main loop -------------------------------------------------------------------------------------------------

    def _wait(self, duration_s: float) -> Program:
        until_s = self._planner.now_s + duration_s
        while self._planner.now_s < until_s:
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
        action = read_line(line, self._modal, self.letters, self._planner.target)
        if action.modal.output_rpm != self._modal.output_rpm or action.modal.spindle != self._modal.spindle:
            if self.state != "Check":
                yield from self._wait_until(self._planner.is_empty)
            self._reporter.tell_overrides_next()
        self._modal = action.modal
        if self.state == "Check":
            return
        if action.dwell_s is not None:
            yield from self._wait_until(self._planner.is_empty)
            yield from self._wait(action.dwell_s)
        if action.target is not None:
            if self._planner.is_beyond_travel(action.target):
                yield from self._soft_limit_alarm()
            yield from self._wait_until(self._planner.has_room)
            self._planner.add(action, is_jog=False)

    def _soft_limit_alarm(self) -> Program:
        if self.state == "Run":
            self._planner.hold()
            yield from self._wait_until(lambda: self._planner.motors.moving is None)
        self._planner.state = "Alarm"
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
                self._planner.state = "Idle"
                self._send("[MSG:Caution: Unlocked]")
        elif self.state not in ("Idle", "Alarm"):
            raise Refused(8)
        elif text == "SLP":
            self._send("ok")
            self._send("[MSG:Sleeping]")
            self._planner.state, self._is_in_line = "Sleep", False
            self._reporter.tell_overrides_next()
            while True:
                yield inf
        elif text == "H":
            yield from self._home()
        else:
            self._answer_query(text)
        self._send("ok")

    def _answer_query(self, text: str) -> None:
        if "=" in text:
            self._planner.settings = changed(self.settings, text)
            return
        options = f"V,{PLANNER_BLOCKS},{RX_BYTES}"
        for line in answers(text, self.settings, len(self.letters), self._version, options):
            self._send(line)

    def _toggle_check(self) -> None:
        if self.state == "Check":
            self._send("[MSG:Disabled]")
            self._send("ok")
            self._is_in_line = False
            self._planner.state = "Idle"
            self._forget()
            self._program = self._restart(_RESTART_S, None, has_stale_ok=False)
            return
        if self.state != "Idle":
            raise Refused(8)
        self._planner.state = "Check"
        self._send("[MSG:Enabled]")
        self._send("ok")

    def _jog(self, text: str) -> Program:
        if self.state not in ("Idle", "Jog"):
            raise Refused(8)
        action = read_line(text, self._modal, self.letters, self._planner.target, is_jog=True)
        assert action.target is not None
        if self._planner.is_beyond_travel(action.target):
            raise Refused(15)
        yield from self._wait_until(self._planner.has_room)
        self._planner.add(action, is_jog=True)
        self._send("ok")

    # --- real-time bytes and homing --------------------------------------------------------------------------------

    def _real_time(self, byte: int) -> None:
        if byte == 0x3F:
            if self.state == "Home":
                self._is_report_due = True
            else:
                self._send(self._report())
        elif byte == 0x85:
            self._planner.cancel_jog()
        elif byte == 0x21:
            self._planner.hold()
        else:
            self._planner.resume()

    def _home(self) -> Program:
        if not self.settings[22]:
            raise Refused(5)
        self._planner.state = "Home"
        homing = Homing(self.letters, self.settings, self._switches, self._planner.motors, lambda: self._planner.now_s)
        try:
            yield from homing.run()
        except SwitchNotFound:
            self._planner.state = "Alarm"
            self._forget()
            self._is_in_line = False
            self._program = self._restart(_RESTART_S, 9, has_stale_ok=True)
            yield inf
        self._planner.call_here(homing.machine_position())
        if self._is_report_due:
            self._send(self._report())
            self._is_report_due = False
        self._planner.state = "Idle"
        self._reporter.tell_overrides_next()

    # --- reports ---------------------------------------------------------------------------------------------------

    def _report(self) -> str:
        state, moving = self.state, self._planner.motors.moving
        if state == "Hold":
            state = "Hold:1" if moving is not None else "Hold:0"
        senses = homing_senses(self.settings, len(self.letters))
        closed = senses * (self._planner.here() - self._switches) >= 0.0
        return self._reporter.write(
            state,
            self._planner.position(),
            mask=int(self.settings[10]),
            buffers=(self._planner.free_blocks, RX_BYTES - len(self._rx)),
            feed_mm_min=self._planner.prepared_speed() * S_PER_MIN,
            modal=self._modal,
            pins="".join(letter for letter, is_closed in zip(self.letters, closed, strict=True) if is_closed),
        )

    def _send(self, line: str) -> None:
        data = line.encode("ascii") + b"\r\n"
        self._wire_free_s = max(self._wire_free_s, self._planner.now_s) + len(data) * _BYTE_S
        self._output.append((self._wire_free_s, data))
