"""The driver for gantries whose controller speaks GRBL 1.1.

Rules it keeps: opening a port resets the controller, so the position is unknown until homed; one line is under way at
a time and has exactly one reply; ``ok`` does not mean arrived; an alarm or an unexpected welcome loses the position;
a target is checked against the envelope before a byte is sent; positions are trusted only at rest.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import Literal, Self

import numpy as np

from uvgs_bench.devices.clock import Clock
from uvgs_bench.devices.gantry import grbl_protocol as protocol
from uvgs_bench.devices.gantry.axes import Axis, Envelope
from uvgs_bench.devices.gantry.controller_clock import PositionRecord
from uvgs_bench.devices.gantry.gantry import ControllerInfo, GantryState, StampedPosition, WireLog
from uvgs_bench.devices.gantry.grbl_arrival import LATE_S, WATCH_S, Way, await_arrival, come_to_rest
from uvgs_bench.devices.gantry.grbl_codes import MALFORMED
from uvgs_bench.devices.gantry.grbl_identity import identify
from uvgs_bench.devices.gantry.grbl_link import Exchange, GrblLink
from uvgs_bench.devices.gantry.grbl_settings import ControllerSettings
from uvgs_bench.devices.gantry.grbl_stream import GrblStream, StreamDoor
from uvgs_bench.devices.gantry.grbl_wire import GrblWire
from uvgs_bench.errors import ConfigError, GantryError, GantryLost, GantryRefused, GantryTimeout
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.units import ns_from_s

_REPLY_S = 5.0
_RECORD_S = 0.02
_NEVER = -1
_BARRIER = "G4P0.01"


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
        self._link = GrblLink(wire, clock)
        self._envelope = envelope
        self._clock = clock
        self._homing_timeout_s = homing_timeout_s
        self._is_open = True
        self._homed_epoch = _NEVER
        self._is_homing = False
        self._may_move = False
        self._last_state: GantryState | None = None
        self._record: PositionRecord | None = None
        self._info = ControllerInfo("", "", "", {})
        self._settings = ControllerSettings(read_only(np.ones(len(envelope.axes))), False, envelope.axes)

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
            return gantry._link.await_welcome() is None
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
        """Run the homing cycle of all axes and wait for its end; nothing is sent meanwhile, since homing starves it.

        Raises:
            GantryRefused: Homing is off in the controller, or it is busy.
            GantryError: The controller would accelerate or home faster than the bench file allows.
            GantryAlarm: The cycle failed.
            GantryTimeout: It did not end in time; the controller was reset.
            GantryLost: The port vanished or the controller restarted.
        """
        self._check_open()
        if not self._settings.has_homing:
            raise GantryRefused(
                "homing is switched off in the controller ($22=0): its position cannot be known", self.port, 5, "$H"
            )
        self._check_limits()
        self._homed_epoch = _NEVER
        self._is_homing = self._may_move = True
        try:
            answers = self._link.command("$H", self._homing_timeout_s)
            if not all(protocol.may_follow_homing(answer) for answer in answers):
                self._link.reset()
                raise GantryError("the answer to $H is not that of a homing cycle; home again", self.port)
        except GantryTimeout:
            self._link.reset()
            self._is_homing = self._may_move = False
            raise GantryTimeout(f"homing did not end within {self._homing_timeout_s:g} s", self.port) from None
        except GantryError:
            self._is_homing = self._may_move = False
            raise
        # A failed cycle is also followed by an ok; only an idle controller without alarm is homed.
        state = self._ask_state()
        if state.activity != "Idle":
            raise GantryError(f"after homing the controller is in state {state.activity} instead of Idle", self.port)
        self._is_homing = self._may_move = False
        self._homed_epoch = self._link.epoch
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
        self._check_limits()
        start = self._state_at_rest()
        if not start.is_trusted:
            raise GantryError(f"the controller is in state {start.activity}; a move starts at rest", self.port)
        lower, upper = [a.lower for a in self.axes], [a.upper for a in self.axes]
        target = np.clip(np.asarray(position, dtype=np.float64), lower, upper)
        self._envelope.check_path(start.position, target)
        way = Way(self.axes, self._settings.steps, start.position, target, self.port)
        if way.is_at_end(start.position):
            return start
        plan = protocol.plan_path(self._settings.axes, target - start.position, speed)
        style: Literal["jog", "line"] = "jog" if self._link.dialect.has_jog else "line"
        try:
            line = protocol.write_move(self.axes, target, plan.feed_per_min, style=style)
        except ValueError as error:
            raise GantryError(str(error), self.port) from None
        self._may_move = True
        self._last_state = None
        begun_ns = self._clock.now_ns()
        try:
            self._order(line)
            if style == "line":
                self._link.command(_BARRIER, plan.duration_s + LATE_S)
            state = self._await_arrival(way, begun_ns, plan.duration_s)
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
            self._link.reset()
            self._is_homing = self._may_move = False
            return self._ask_state()
        self._wire.send_byte(protocol.JOG_CANCEL)
        state = come_to_rest(self._link, self._clock, self._ask_state)
        if state.activity == "Hold" or self._link.line_under_way:
            # At rest a reset keeps the position; it clears a held move, and a line that was cut in two.
            is_homed = self._is_homed
            self._link.reset()
            self._homed_epoch = self._link.epoch if is_homed else _NEVER
            state = self._ask_state()
        self._may_move = False
        return state

    @contextmanager
    def recording(self) -> Iterator[list[StampedPosition]]:
        """Within this, every position the controller reports is kept with its time, and moves are watched closely.

        Yields:
            The positions so far, in the order of time, at the end with the times of a controller that has a clock.
            On an 8-bit controller with plain reports one may be torn while it moves.
        """
        record = self._record = PositionRecord()
        try:
            yield record.positions
        finally:
            self._record = None
            record.finish()

    @contextmanager
    def streaming(self) -> Iterator[GrblStream]:
        """Move along a path that is told piece by piece; its end is awaited, and leaving early stops the motion first.

        Raises:
            GantryError: Not homed or not at rest, or as ``GrblStream``.
        """
        self._check_open()
        start = self._state_at_rest()
        if not start.is_trusted:
            raise GantryError(f"a motion starts homed and at rest; the state is {start.activity}", self.port)
        self._check_limits()
        door = StreamDoor(
            self._settings, self._envelope, self._link, self._clock, self._order, self._ask_state, self._brake
        )
        self._may_move, self._last_state = True, None
        try:
            stream = GrblStream(door, start.position)
            yield stream
            stream.finish()
        except BaseException:
            self._stop_quietly()
            raise
        self._may_move = False

    def exchange(self) -> Exchange | None:
        """Ask the controller's own clock what time it is; None where it has none. Raises GantryTimeout, GantryLost."""
        self._check_open()
        return self._link.ask_place()[1] if self._link.dialect.has_checksums else None

    def ask(self, line: str) -> list[str]:
        """Send a line that moves nothing, and return the lines that answer it; ``?`` is answered by a report.

        Raises:
            ConfigError: The line could move something; nothing was sent.
            GantryError: Refused, alarm, lost, or no answer.
        """
        self._check_open()
        if line == "?":
            return [protocol.shown(self._link.ask_report(len(self.axes))[0])]
        if not protocol.is_harmless(line):
            raise ConfigError(f"{line!r} is not sent: it may move something; use move, jog, home or stop")
        return [*map(protocol.shown, self._link.command(line, _REPLY_S)), "ok"]

    def reread(self) -> ControllerInfo:
        """Read identity and settings anew, after one was changed. Raises GantryError."""
        self._check_open()
        self._info, self._settings = identify(self._link, self.axes)
        return self._info

    def reset(self) -> GantryState:
        """Stop hard: steps cease at once, and the position is lost. Raises GantryTimeout, GantryLost."""
        self._check_open()
        self._homed_epoch = _NEVER
        self._link.reset()
        self._is_homing = self._may_move = False
        return self._ask_state()

    def close(self) -> None:
        """Stop any motion and release the port. Safe to call twice; an interruption meanwhile stops it hard."""
        if not self._is_open:
            return
        try:
            self._stop_quietly()
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

    def _stop_quietly(self) -> None:
        """Stop what may move; a failure is only remarked, and an interruption meanwhile stops it hard."""
        try:
            if self._may_move and not self._wire.is_lost:
                self.stop()
        except GantryError as error:
            self._wire.remark(f"while stopping: {error}")
        except BaseException:
            self._wire.send_byte(protocol.RESET)
            raise

    # --- start -----------------------------------------------------------------------------------------------------

    def _start(self) -> None:
        self._link.start()
        self._info, self._settings = identify(self._link, self.axes)
        self._ask_state()

    # --- reports and motion ----------------------------------------------------------------------------------------

    @property
    def _is_homed(self) -> bool:
        return self._homed_epoch == self._link.epoch

    def _ask_state(self) -> GantryState:
        asked_ns = self._clock.now_ns()
        report, machine = self._link.ask_report(len(self.axes))
        position = protocol.si_from_controller(self.axes, machine)
        if self._record is not None:
            self._record.add(asked_ns, self._clock.now_ns(), position, self._link.exchange)
        if report.activity in ("Alarm", "Sleep"):
            self._homed_epoch = _NEVER
        fields = dict(report.fields)
        if report.substate:
            fields["substate"] = report.substate
        self._last_state = GantryState(
            t_ns=self._clock.now_ns(),
            activity=report.activity,
            position=position,
            is_homed=self._is_homed,
            is_trusted=self._is_homed and report.activity == "Idle",
            details=fields,
        )
        return self._last_state

    def _state_at_rest(self) -> GantryState:
        """The last state, when it was trusted, is young, and nothing was said since; otherwise asked anew."""
        last = self._last_state
        if last is None or not last.is_trusted or self._homed_epoch != self._link.epoch or self._wire.has_input:
            return self._ask_state()
        return last if self._clock.now_ns() - last.t_ns < ns_from_s(WATCH_S) else self._ask_state()

    def _await_arrival(self, way: Way, begun_ns: int, duration_s: float) -> GantryState:
        every_s = WATCH_S if self._record is None else _RECORD_S
        return await_arrival(way, self._link, self._clock, self._ask_state, self._brake, begun_ns, duration_s, every_s)

    def _order(self, line: str) -> None:
        """Send a move; one that was refused for how it reads was damaged on the way, did nothing, and is said again."""
        try:
            self._link.command(line, _REPLY_S)
        except GantryRefused as refusal:
            if refusal.code not in MALFORMED:
                raise
            self._wire.remark("refused for how it reads, so damaged on the way: said again")
            self._link.command(line, _REPLY_S)

    def _brake(self) -> None:
        """Tell the motion to stop, whatever it is, without waiting for anything."""
        try:
            self._wire.send_byte(protocol.JOG_CANCEL)
            self._wire.send_byte(protocol.HOLD)
        except GantryLost as error:
            self._wire.remark(f"cannot brake: {error}")

    def _check_limits(self) -> None:
        if self._settings.excess:
            raise GantryError("; ".join(self._settings.excess), self.port)

    def _check_open(self) -> None:
        if not self._is_open:
            raise GantryError("the gantry is closed", self.port)
        if self._wire.is_lost:
            raise GantryLost("the port vanished; open it again and home", self.port)
