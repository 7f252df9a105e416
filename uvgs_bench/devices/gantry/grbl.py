"""The driver for gantries whose controller speaks GRBL 1.1.

Rules it keeps: opening a port resets the controller, so the position is unknown until homed; one line is under way at
a time and has exactly one reply; ``ok`` does not mean arrived; an alarm or an unexpected welcome loses the position;
a target is checked against the envelope before a byte is sent; positions are trusted only at rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Literal, Self

import numpy as np

from uvgs_bench.devices.clock import Clock
from uvgs_bench.devices.gantry import grbl_protocol as protocol
from uvgs_bench.devices.gantry.axes import Axis, Envelope
from uvgs_bench.devices.gantry.gantry import ControllerInfo, GantryState, WireLog
from uvgs_bench.devices.gantry.grbl_codes import Dialect, find_dialect
from uvgs_bench.devices.gantry.grbl_settings import ControllerSettings, read_settings
from uvgs_bench.devices.gantry.grbl_wire import GrblWire
from uvgs_bench.errors import GantryAlarm, GantryError, GantryLost, GantryRefused, GantryTimeout
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.units import ns_from_s

_WELCOME_S = 3.0
_REPLY_S = 5.0
_REPORT_S = 1.0
_QUIET_S = 0.2
_POLL_S = 0.1
_WATCH_S = 0.25
_MARGIN_S = 0.015
_LATE_S = 5.0
_SETTLED_ELSEWHERE_S = 0.5
_STOP_S = 10.0
_BARRIER = "G4P0.01"
# The offset is in every 30th report at least.
_REPORTS_TO_OFFSET = 40


class GrblGantry:
    """An open gantry behind a GRBL controller; made by ``open``.

    An interruption (Ctrl-C) at any point leaves it able to ``stop``.

    Args:
        wire: The open line.
        envelope: What may be reached.
        clock: Bench time.
        homing_timeout_s: Longest time a homing cycle may take, s.
    """

    def __init__(self, wire: GrblWire, envelope: Envelope, *, clock: Clock, homing_timeout_s: float) -> None:
        self._wire = wire
        self._envelope = envelope
        self._clock = clock
        self._homing_timeout_s = homing_timeout_s
        self._is_open = True
        self._is_homed = False
        self._is_homing = False
        self._may_move = False
        self._line_under_way = ""
        self._reports_due = 0
        self._offset: FloatArray | None = None
        self._dialect: Dialect = find_dialect({})
        self._info = ControllerInfo("", "", "", {})
        self._settings = ControllerSettings(read_only(np.ones(len(envelope.axes))), has_homing=False)

    @classmethod
    def open(
        cls, port: str, envelope: Envelope, *, clock: Clock, log: WireLog, homing_timeout_s: float = 120.0
    ) -> Self:
        """Open a port, wait for the controller's start, identify it and check its settings.

        Args:
            port: A device file or a pyserial URL.
            envelope: What may be reached.
            clock: Bench time.
            log: Called for everything on the wire.
            homing_timeout_s: Longest time a homing cycle may take, s.

        Returns:
            The gantry, unhomed.

        Raises:
            GantryError: The port cannot be opened, the answer is no GRBL, or a setting makes it unusable.
            GantryTimeout: Nothing answers.
        """
        gantry = cls(GrblWire(port, clock=clock, log=log), envelope, clock=clock, homing_timeout_s=homing_timeout_s)
        try:
            gantry._start()
        except BaseException:
            gantry._wire.close()
            raise
        return gantry

    @classmethod
    def halt(cls, port: str, *, clock: Clock, log: WireLog) -> bool:
        """Stop whatever moves behind a port, before anything else is asked; the position is lost.

        Args:
            port: A device file or a pyserial URL.
            clock: Bench time.
            log: Called for everything on the wire.

        Returns:
            Whether a controller answered with its welcome.

        Raises:
            GantryError: The port cannot be opened.
            GantryLost: The port vanished.
        """
        gantry = cls(GrblWire(port, clock=clock, log=log), Envelope(()), clock=clock, homing_timeout_s=0.0)
        try:
            for byte in (protocol.JOG_CANCEL, protocol.HOLD, protocol.RESET):
                gantry._wire.send_byte(byte)
            return gantry._await_welcome(_WELCOME_S) is None
        finally:
            gantry._wire.close()

    @property
    def port(self) -> str:
        """The port as the user named it."""
        return self._wire.address

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The axes in the controller's order."""
        return self._envelope.axes

    @property
    def envelope(self) -> Envelope:
        """What may be reached."""
        return self._envelope

    @property
    def info(self) -> ControllerInfo:
        """Who answered, and its settings as read at connection."""
        return self._info

    # --- what a gantry does ----------------------------------------------------------------------------------------

    def state(self) -> GantryState:
        """Ask the controller where it is. Raises GantryLost, GantryTimeout, GantryAlarm."""
        self._check_open()
        return self._ask_state()

    def home(self) -> GantryState:
        """Run the homing cycle and wait for its end; nothing is sent meanwhile, since homing starves it.

        Raises:
            GantryRefused: Homing is off in the controller, or it is busy.
            GantryAlarm: The cycle failed.
            GantryTimeout: It did not end in time; the controller was reset.
            GantryLost: The port vanished or the controller restarted.
        """
        self._check_open()
        if not self._settings.has_homing:
            raise GantryRefused(
                "homing is switched off in the controller ($22=0): its position cannot be known", self.port, 5, "$H"
            )
        self._is_homed = False
        self._is_homing = self._may_move = True
        try:
            self._command("$H", self._homing_timeout_s)
        except GantryTimeout:
            self._reset()
            raise GantryTimeout(f"homing did not end within {self._homing_timeout_s:g} s", self.port) from None
        except GantryRefused:
            self._is_homing = self._may_move = False
            raise
        # A failed cycle is also followed by an ok; only an idle controller without alarm is homed.
        state = self._ask_state()
        if state.activity != "Idle":
            raise GantryError(f"after homing the controller is in state {state.activity} instead of Idle", self.port)
        self._is_homing = self._may_move = False
        self._is_homed = True
        return self._ask_state()

    def move_to(self, position: Sequence[float] | FloatArray, speed: float) -> GantryState:
        """Move in a straight line to machine axis positions and return when truly arrived and at rest.

        Args:
            position: Machine axis positions, length A, m or rad.
            speed: Speed along the path, m/s (rad/s for a purely rotary move); lowered where an axis would be too fast.

        Returns:
            The state at rest.

        Raises:
            EnvelopeError: Target or path outside the envelope; no move was sent.
            GantryRefused: The controller refused the line; nothing moved.
            GantryError: Not homed, not at rest, or at rest somewhere else.
            GantryAlarm: An alarm; unhomed now.
            GantryTimeout: Not arrived in time; the motion was told to stop.
            GantryLost: The port vanished or the controller restarted.
        """
        self._check_open()
        if not (np.isfinite(speed) and speed > 0.0):
            raise GantryError(f"a speed must be positive, got {speed}", self.port)
        self._envelope.check_point(position)
        if not self._is_homed:
            raise GantryError("not homed: the position is unknown, so no move is made", self.port)
        start = self._ask_state()
        if not start.is_trusted:
            raise GantryError(f"the controller is in state {start.activity}; a move starts at rest", self.port)
        lower, upper = [a.lower for a in self.axes], [a.upper for a in self.axes]
        target = np.clip(np.asarray(position, dtype=np.float64), lower, upper)
        self._envelope.check_path(start.position, target)
        if self._is_at(start.position, target):
            return start
        plan = protocol.plan_path(self.axes, target - start.position, speed)
        style: Literal["jog", "line"] = "jog" if self._dialect.has_jog else "line"
        try:
            line = protocol.write_move(self.axes, target, plan.feed_per_min, style=style)
        except ValueError as error:
            raise GantryError(str(error), self.port) from None
        self._may_move = True
        begun_ns = self._clock.now_ns()
        try:
            self._command(line, _REPLY_S)
            if style == "line":
                self._command(_BARRIER, plan.duration_s + _LATE_S)
            state = self._await_arrival(target, begun_ns, plan.duration_s)
        except GantryTimeout:
            self._brake()
            raise
        except GantryRefused:
            self._may_move = False
            raise
        self._may_move = False
        return state

    def jog(self, offset: Sequence[float] | FloatArray, speed: float) -> GantryState:
        """Move by an offset; the same rules as ``move_to``."""
        self._check_open()
        step = np.asarray(offset, dtype=np.float64)
        start = self._ask_state()
        if step.shape != start.position.shape:
            raise GantryError(f"an offset needs {len(self.axes)} axes, got {step.size}", self.port)
        return self.move_to(start.position + step, speed)

    def stop(self) -> GantryState:
        """Stop the motion now, controlled, so that the position stays known; a homing cycle is aborted and loses it.

        Raises:
            GantryTimeout: The controller does not come to rest or does not answer.
            GantryAlarm: An alarm.
            GantryLost: The port vanished or the controller restarted.
        """
        self._check_open()
        if self._is_homing:
            self._is_homing = self._is_homed = False
            self._reset()
            self._may_move = False
            return self._ask_state()
        self._wire.send_byte(protocol.JOG_CANCEL)
        state = self._come_to_rest()
        if state.activity == "Hold" or self._line_under_way:
            # At rest a reset keeps the position; it clears a held move, and a line that was cut in two.
            is_homed = self._is_homed
            self._reset()
            self._is_homed = is_homed
            state = self._ask_state()
        self._may_move = False
        return state

    def close(self) -> None:
        """Stop any motion and release the port. Safe to call twice."""
        if not self._is_open:
            return
        try:
            if self._may_move and not self._wire.is_lost:
                self.stop()
        except GantryError as error:
            self._wire.remark(f"while closing: {error}")
        finally:
            self._is_open = False
            self._wire.close()

    def __enter__(self) -> Self:
        """Enter a context that closes the gantry."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()

    # --- start -----------------------------------------------------------------------------------------------------

    def _start(self) -> None:
        heard = self._await_welcome(_WELCOME_S)
        if heard is not None:
            # Not every controller greets when its port is opened; all do after a reset.
            self._wire.send_byte(protocol.RESET)
            more = self._await_welcome(_WELCOME_S)
            if more is not None:
                self._refuse_start([*heard, *more])
            self._await_quiet()
        identity = {
            message.name: message.text for message in self._query("$I") if isinstance(message, protocol.Message)
        }
        settings = {m.number: m.value for m in self._query("$$") if isinstance(m, protocol.Setting)}
        self._dialect = find_dialect(identity)
        version = identity.get("VER", "").rstrip(":")
        self._info = ControllerInfo(self._dialect.name, version, identity.get("OPT", ""), settings)
        self._settings = read_settings(settings, self.axes, self.port)
        self._ask_state()

    def _refuse_start(self, heard: list[str]) -> None:
        if heard:
            raise GantryError(
                f"what answers is no GRBL controller: expected a line like \"Grbl 1.1h ['$' for help]\", "
                f"got {heard[0][:60]!r}",
                self.port,
            )
        raise GantryTimeout(
            "nothing answers: expected the welcome of a GRBL controller at 115200 baud, also after a reset", self.port
        )

    def _query(self, line: str) -> list[protocol.Received]:
        received: list[protocol.Received] = []
        self._command(line, _REPLY_S, received)
        return received

    # --- one line, one reply ---------------------------------------------------------------------------------------

    def _command(self, line: str, timeout_s: float, received: list[protocol.Received] | None = None) -> None:
        if self._line_under_way:
            raise GantryError(f"{self._line_under_way!r} is still unanswered: stop the gantry first", self.port)
        self._line_under_way = line
        self._wire.send_line(line)
        deadline_ns = self._clock.now_ns() + ns_from_s(timeout_s)
        while True:
            item = self._receive(deadline_ns)
            if item is None:
                raise GantryTimeout(f"no reply to {line!r} within {timeout_s:g} s", self.port)
            if isinstance(item, protocol.Reply):
                break
            if received is not None:
                received.append(item)
        if item.code:
            meaning = self._dialect.meaning("error", item.code)
            raise GantryRefused(f"refused {line!r} with error:{item.code}, {meaning}", self.port, item.code, line)

    def _receive(self, deadline_ns: int) -> protocol.Received | None:
        """The next line's meaning; keeps the ledger; an alarm or an unexpected welcome is raised."""
        line = self._wire.read_line(deadline_ns)
        if line is None:
            return None
        item = protocol.read_received(line)
        if isinstance(item, protocol.Reply):
            if not self._line_under_way:
                self._wire.remark(f"a reply nobody waits for: {line}")
            self._line_under_way = ""
        elif isinstance(item, protocol.Alarm):
            self._raise_alarm(item.code)
        elif isinstance(item, protocol.Welcome):
            self._lose_position()
            self._line_under_way = ""
            raise GantryLost("the controller restarted by itself; the position is lost, home again", self.port)
        elif isinstance(item, protocol.Report):
            self._reports_due = max(0, self._reports_due - 1)
            if item.offset is not None:
                self._offset = item.offset
        return item

    def _raise_alarm(self, code: int) -> None:
        self._lose_position()
        self._wire.remark(f"alarm {code}: reset, and everything until the welcome is discarded")
        meaning = self._dialect.meaning("alarm", code)
        try:
            self._reset()
        except GantryTimeout:
            self._wire.remark("no welcome after the alarm")
        raise GantryAlarm(f"alarm {code}: {meaning}; home again", self.port, code)

    def _lose_position(self) -> None:
        self._is_homed = self._is_homing = self._may_move = False

    def _reset(self) -> None:
        """Reset the controller and wait until it has started and is quiet; replies of before are forgotten."""
        self._is_homed, self._offset = False, None
        self._wire.send_byte(protocol.RESET)
        heard = self._await_welcome(_WELCOME_S)
        self._line_under_way, self._reports_due = "", 0
        if heard is not None:
            raise GantryTimeout(f"no welcome within {_WELCOME_S:g} s after a reset", self.port)
        self._await_quiet()

    def _await_quiet(self) -> None:
        """Discard until nothing comes: a controller that also restarted by itself says its welcome twice."""
        while self._wire.read_line(self._clock.now_ns() + ns_from_s(_QUIET_S)) is not None:
            pass

    def _await_welcome(self, timeout_s: float) -> list[str] | None:
        """None when the welcome came, otherwise the lines that came instead."""
        heard: list[str] = []
        deadline_ns = self._clock.now_ns() + ns_from_s(timeout_s)
        while (line := self._wire.read_line(deadline_ns)) is not None:
            if isinstance(protocol.read_received(line), protocol.Welcome):
                return None
            heard.append(line)
            if self._clock.now_ns() >= deadline_ns:
                break
        return heard

    # --- reports and motion ----------------------------------------------------------------------------------------

    def _ask_state(self, timeout_s: float = _REPORT_S) -> GantryState:
        silences = 0
        for _ in range(_REPORTS_TO_OFFSET):
            self._wire.send_byte(protocol.STATUS)
            self._reports_due += 1
            deadline_ns = self._clock.now_ns() + ns_from_s(timeout_s)
            report = None
            while self._reports_due and (item := self._receive(deadline_ns)) is not None:
                report = item if isinstance(item, protocol.Report) else report
            self._reports_due = 0
            if report is None:
                silences += 1
                if silences == 2:
                    raise GantryTimeout(f"no status report within {timeout_s:g} s", self.port)
            elif (machine := self._machine_position(report)) is not None:
                return self._state_of(report, machine)
        raise GantryError("the controller reports work positions and never their offset (WCO)", self.port)

    def _machine_position(self, report: protocol.Report) -> FloatArray | None:
        machine = report.machine
        offset, work = self._offset, report.work
        if machine is None and offset is not None and work is not None and work.shape == offset.shape:
            machine = work + offset
        if machine is not None and machine.shape != (len(self.axes),):
            raise GantryError(f"the controller reports {machine.size} axes, the bench has {len(self.axes)}", self.port)
        return machine

    def _state_of(self, report: protocol.Report, machine: FloatArray) -> GantryState:
        if report.activity in ("Alarm", "Sleep"):
            self._is_homed = False
        fields = dict(report.fields)
        if report.substate:
            fields["substate"] = report.substate
        return GantryState(
            t_ns=self._clock.now_ns(),
            activity=report.activity,
            position=protocol.si_from_controller(self.axes, machine),
            is_homed=self._is_homed,
            is_trusted=self._is_homed and report.activity == "Idle",
            details=fields,
        )

    def _is_at(self, position: FloatArray, target: FloatArray) -> bool:
        off = np.abs(protocol.controller_from_si(self.axes, read_only(position - target)))
        return bool(np.all(off <= 0.5 / self._settings.steps + 1.5 * protocol.REPORT_STEP))

    def _await_arrival(self, target: FloatArray, begun_ns: int, duration_s: float) -> GantryState:
        """Watch until Idle at the target. One Idle is not enough: the controller may not have begun to move."""
        expected_ns = begun_ns + ns_from_s(duration_s + _MARGIN_S)
        deadline_ns = expected_ns + ns_from_s(0.5 * duration_s + _LATE_S)
        idle_since_ns: int | None = None
        while True:
            now_ns = self._clock.now_ns()
            is_late = now_ns >= expected_ns
            self._listen_until(
                now_ns + ns_from_s(_POLL_S) if is_late else min(now_ns + ns_from_s(_WATCH_S), expected_ns)
            )
            state = self._ask_state()
            if state.activity == "Idle":
                if self._is_at(state.position, target):
                    return state
                idle_since_ns = state.t_ns if idle_since_ns is None else idle_since_ns
                if state.t_ns - idle_since_ns > ns_from_s(_SETTLED_ELSEWHERE_S):
                    raise GantryError(
                        f"came to rest at {self._described(state.position)} instead of {self._described(target)}",
                        self.port,
                    )
            elif state.activity in ("Jog", "Run"):
                idle_since_ns = None
            else:
                raise GantryError(f"the move was broken off: the controller is in state {state.activity}", self.port)
            if state.t_ns > deadline_ns:
                raise GantryTimeout(f"not arrived {_LATE_S:g} s after the expected time", self.port)

    def _listen_until(self, deadline_ns: int) -> None:
        while self._clock.now_ns() < deadline_ns:
            self._receive(deadline_ns)

    def _come_to_rest(self) -> GantryState:
        deadline_ns = self._clock.now_ns() + ns_from_s(_STOP_S)
        while True:
            state = self._ask_state()
            if state.activity == "Jog":
                self._wire.send_byte(protocol.JOG_CANCEL)
            elif state.activity == "Run":
                self._wire.send_byte(protocol.HOLD)
            elif not (state.activity == "Hold" and state.details.get("substate") == "1"):
                # At rest; a line still under way may yet begin to move, so its reply is waited for.
                if not self._line_under_way:
                    return state
                self._listen_until(self._clock.now_ns() + ns_from_s(_QUIET_S))
                again = self._ask_state()
                if again.activity not in ("Jog", "Run"):
                    return again
            if self._clock.now_ns() > deadline_ns:
                raise GantryTimeout(f"not at rest {_STOP_S:g} s after the stop", self.port)
            self._listen_until(self._clock.now_ns() + ns_from_s(0.5 * _POLL_S))

    def _brake(self) -> None:
        """Tell the motion to stop, whatever it is, without waiting for anything."""
        try:
            self._wire.send_byte(protocol.JOG_CANCEL)
            self._wire.send_byte(protocol.HOLD)
        except GantryLost as error:
            self._wire.remark(f"cannot brake: {error}")

    def _described(self, position: FloatArray) -> str:
        return " ".join(
            f"{axis.name} {axis.described(float(value))}" for axis, value in zip(self.axes, position, strict=True)
        )

    def _check_open(self) -> None:
        if not self._is_open:
            raise GantryError("the gantry is closed", self.port)
        if self._wire.is_lost:
            raise GantryLost("the port vanished; open it again and home", self.port)
