"""A conversation with a GRBL controller: one line with one reply, reports, resets, alarms, unexpected restarts."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeGuard

import numpy as np

from uvgs_bench.devices.clock import Clock
from uvgs_bench.devices.gantry import grbl_protocol as protocol
from uvgs_bench.devices.gantry.grbl_codes import BAD_CHECKSUM, Dialect, find_dialect
from uvgs_bench.devices.gantry.grbl_wire import GrblWire
from uvgs_bench.errors import GantryAlarm, GantryError, GantryLost, GantryRefused, GantryTimeout
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.units import ns_from_s

WELCOME_S = 3.0
_REPORT_S = 1.0
_QUIET_S = 0.2
_PLACE_TRIES = 3
_BYTE_S = 10 / 115200
# Our firmware may stop when it hears nothing for so long as its user said ($202); half a second is little for that.
_BEAT_S = 0.25
# A line whose reply takes longer is not repeated: homing, or a wait for the end of a move.
_REPEAT_BELOW_S = 5.0
# The offset is in every 30th report at least, and is heard twice.
_REPORTS_TO_OFFSET = 80
_CHANGES_STEPS = re.compile(r"\$(10\d=|RST)")


@dataclass(frozen=True, slots=True)
class Exchange:
    """One question to the controller's clock.

    Args:
        asked_ns: Bench time when the question was sent, ns.
        heard_ns: Bench time when the first byte of the answer came, ns.
        controller_us: The controller's time when it got the question, us since its start.
    """

    asked_ns: int
    heard_ns: int
    controller_us: float


class GrblLink:
    """The conversation. Whatever is received passes through one place, so that no alarm or restart goes unnoticed.

    Attributes:
        dialect: How the controller's numbers read.
        epoch: Counts the controller's starts and alarms; a position known in one epoch means nothing in the next.
        line_under_way: The line whose reply has not come, or empty.
        exchange: Question and answer of the last report that told the controller's own time; None when it had none.
        steps: Steps per mm or deg, shape (A,), of a controller whose reports are exact; None asks for plain reports.

    Args:
        wire: The open line.
        clock: Bench time.
    """

    def __init__(self, wire: GrblWire, clock: Clock) -> None:
        self.wire = wire
        self.dialect: Dialect = find_dialect({})
        self.epoch = 0
        self.line_under_way = ""
        self.exchange: Exchange | None = None
        self.steps: FloatArray | None = None
        self._boot: int | None = None
        self._clock = clock
        self._reports_due = self._places_due = 0
        self._number = 1
        self._offset: FloatArray | None = None
        self._offset_heard: FloatArray | None = None

    @property
    def port(self) -> str:
        """The port as the user named it."""
        return self.wire.address

    def start(self) -> None:
        """Wait for the welcome that opening the port brings, or reset the controller for one.

        Raises:
            GantryTimeout: Nothing answers.
            GantryError: What answers is no GRBL controller.
        """
        heard = self.await_welcome()
        if heard is None:
            return
        # Not every controller greets when its port is opened; all do after a reset.
        self.wire.send_byte(protocol.RESET)
        more = self.await_welcome()
        if more is None:
            self._await_quiet()
            return
        heard += more
        if heard:
            expected = "a line like \"Grbl 1.1h ['$' for help]\""
            raise GantryError(
                f"what answers is no GRBL controller: expected {expected}, got {heard[0][:60]!r}", self.port
            )
        raise GantryTimeout(
            "nothing answers: expected the welcome of a GRBL controller at 115200 baud, also after a reset", self.port
        )

    def command(self, line: str, timeout_s: float) -> list[protocol.Received]:
        """Send a line and wait for its reply.

        Args:
            line: The line.
            timeout_s: Longest wait, s.

        Returns:
            What came before the reply.

        Raises:
            GantryRefused: The reply is an error.
            GantryTimeout: No reply; the line stays under way.
            GantryAlarm: An alarm came.
            GantryLost: The port vanished or the controller restarted.
            GantryError: Another line is still under way.
        """
        if self.line_under_way:
            raise GantryError(f"{self.line_under_way!r} is still unanswered: stop the gantry first", self.port)
        self.line_under_way = line
        if not self.dialect.has_checksums:
            self.wire.send_line(line)
            return self._await_reply(line, timeout_s)
        if _CHANGES_STEPS.match(line):
            self.steps = None
        sealed = protocol.sealed(self._number, line)
        self._number += 1
        for is_last in (False, False, True):
            self.line_under_way = line
            self.wire.send_line(sealed)
            try:
                return self._await_reply(line, timeout_s)
            except GantryRefused as refusal:
                # Not run; and a line that was run is answered again and not run twice.
                if is_last or refusal.code != BAD_CHECKSUM:
                    raise
            except GantryTimeout:
                if is_last or timeout_s > _REPEAT_BELOW_S:
                    raise
        raise AssertionError

    def _await_reply(self, line: str, timeout_s: float) -> list[protocol.Received]:
        deadline_ns = self._clock.now_ns() + ns_from_s(timeout_s)
        received: list[protocol.Received] = []
        while (item := self._receive_beating(deadline_ns)) is not None:
            if _is_place(item):
                continue
            if not isinstance(item, protocol.Reply):
                received.append(item)
            elif item.code:
                meaning = self.dialect.meaning("error", item.code)
                raise GantryRefused(f"refused {line!r} with error:{item.code}, {meaning}", self.port, item.code, line)
            else:
                return received
        raise GantryTimeout(f"no reply to {line!r} within {timeout_s:g} s", self.port)

    def ask_report(self, axis_count: int) -> tuple[protocol.Report, FloatArray]:
        """Ask for a status report until one gives the machine position.

        Args:
            axis_count: Number of axes it must have.

        Returns:
            The report and the machine position, shape (A,), mm or deg.

        Raises:
            GantryTimeout: No report comes.
            GantryError: The axes differ, or a work position comes without its offset.
            GantryAlarm: An alarm came.
            GantryLost: The port vanished or the controller restarted.
        """
        if self.steps is not None:
            place, self.exchange = self.ask_place()
            if len(place.steps) != axis_count:
                raise GantryError(
                    f"the controller reports {len(place.steps)} axes, the bench has {axis_count}", self.port
                )
            exact = read_only(place.steps / self.steps)
            fields = {"Time": f"{place.controller_us:.0f}", "Homed": place.homed, "Flags": place.flags}
            return protocol.Report(place.activity, place.substate, exact, None, None, fields), exact
        silences, self.exchange = 0, None
        for _ in range(_REPORTS_TO_OFFSET):
            self.wire.send_byte(protocol.STATUS)
            self._reports_due += 1
            deadline_ns = self._clock.now_ns() + ns_from_s(_REPORT_S)
            report = None
            while self._reports_due and (item := self._receive(deadline_ns)) is not None:
                report = item if isinstance(item, protocol.Report) else report
            self._reports_due = 0
            if report is None:
                silences += 1
                if silences == 2:
                    raise GantryTimeout(f"no status report within {_REPORT_S:g} s", self.port)
            elif (machine := self._machine_position(report)) is not None:
                if machine.shape != (axis_count,):
                    raise GantryError(
                        f"the controller reports {machine.size} axes, the bench has {axis_count}", self.port
                    )
                return report, machine
        raise GantryError("the controller reports work positions and never their offset (WCO)", self.port)

    def ask_place(self) -> tuple[protocol.Place, Exchange]:
        """Ask our firmware for its exact position; damaged answers are asked for again.

        Returns:
            The position, and when it was asked and heard: the first byte of the answer counts, its length on the wire
            is no part of the way.

        Raises:
            GantryTimeout: No whole answer comes.
            GantryAlarm: An alarm came.
            GantryLost: The port vanished or the controller restarted, also when its welcome was missed.
        """
        for _ in range(_PLACE_TRIES):
            asked_ns = self._clock.now_ns()
            self.wire.send_byte(protocol.POSITION)
            self._places_due += 1
            while (item := self._receive(asked_ns + ns_from_s(_REPORT_S))) is not None:
                # An answer to an earlier question is where it was, not where it is.
                if not _is_place(item) or self._places_due:
                    continue
                heard_ns = self._clock.now_ns() - ns_from_s(_BYTE_S * (len(protocol.shown(item)) + 1))
                place = protocol.read_place(item)
                if place is None:
                    break
                self._check_boot(place.boot)
                return place, Exchange(asked_ns, max(asked_ns, heard_ns), place.controller_us)
            self._places_due = 0
        raise GantryTimeout(f"no position report within {_REPORT_S:g} s", self.port)

    def _check_boot(self, boot: int) -> None:
        before, self._boot = self._boot, boot
        if before is not None and boot != before:
            self._begin_epoch()
            raise GantryLost("the controller has restarted unheard; the position is lost, home again", self.port)

    def received_until(self, deadline_ns: int) -> Iterator[protocol.Received]:
        """What comes until an instant, bench time ns. Raises GantryAlarm and GantryLost."""
        while (item := self._receive(deadline_ns)) is not None:
            yield item

    def listen(self, duration_s: float) -> None:
        """Take in what comes for a while. Raises GantryAlarm and GantryLost."""
        deadline_ns = self._clock.now_ns() + ns_from_s(duration_s)
        while self._clock.now_ns() < deadline_ns:
            self._receive(deadline_ns)

    def reset(self) -> None:
        """Reset the controller and wait until it has started and is quiet; what came before is forgotten.

        Raises:
            GantryTimeout: No welcome.
            GantryLost: The port vanished.
        """
        self._begin_epoch()
        self.wire.send_byte(protocol.RESET)
        heard = self.await_welcome()
        self._begin_epoch()
        if heard is not None:
            raise GantryTimeout(f"no welcome within {WELCOME_S:g} s after a reset", self.port)
        self._await_quiet()

    def await_welcome(self) -> list[str] | None:
        """None when the welcome came, otherwise the lines that came instead. Raises GantryLost."""
        heard: list[str] = []
        deadline_ns = self._clock.now_ns() + ns_from_s(WELCOME_S)
        while (line := self.wire.read_line(deadline_ns)) is not None:
            if isinstance(protocol.read_received(line), protocol.Welcome):
                return None
            heard.append(line)
            if self._clock.now_ns() >= deadline_ns:
                break
        return heard

    def _await_quiet(self) -> None:
        """Discard until nothing comes: a controller that also restarted by itself says its welcome twice."""
        while self.wire.read_line(self._clock.now_ns() + ns_from_s(_QUIET_S)) is not None:
            pass

    def _begin_epoch(self) -> None:
        self.epoch += 1
        self.line_under_way, self._reports_due, self._places_due, self._number = "", 0, 0, 1
        self._offset = self._offset_heard = None

    def _receive_beating(self, deadline_ns: int) -> protocol.Received | None:
        """As ``_receive``; meanwhile our firmware, which may listen for its host, is asked now and then."""
        if not self.dialect.has_checksums:
            return self._receive(deadline_ns)
        while (next_ns := self._clock.now_ns() + ns_from_s(_BEAT_S)) < deadline_ns:
            item = self._receive(next_ns)
            if item is not None:
                return item
            self.wire.send_byte(protocol.POSITION)
            self._places_due += 1
        return self._receive(deadline_ns)

    def _receive(self, deadline_ns: int) -> protocol.Received | None:
        line = self.wire.read_line(deadline_ns)
        if line is None:
            return None
        item = protocol.read_received(line)
        if isinstance(item, protocol.Reply):
            if not self.line_under_way:
                self.wire.remark(f"a reply nobody waits for: {line}")
            self.line_under_way = ""
        elif isinstance(item, protocol.Alarm):
            self._raise_alarm(item.code)
        elif isinstance(item, protocol.Welcome):
            self._begin_epoch()
            raise GantryLost("the controller restarted by itself; the position is lost, home again", self.port)
        elif _is_place(item):
            self._places_due = max(0, self._places_due - 1)
        elif isinstance(item, protocol.Report):
            self._reports_due = max(0, self._reports_due - 1)
            if item.offset is not None:
                self._hear_offset(item.offset)
        return item

    def _hear_offset(self, offset: FloatArray) -> None:
        """Believe an offset that is told twice alike: it is told seldom, and a damaged one would shift everything."""
        if self._offset_heard is not None and np.array_equal(self._offset_heard, offset):
            self._offset = offset
        self._offset_heard = offset

    def _raise_alarm(self, code: int) -> None:
        self.wire.remark(f"alarm {code}: reset, and everything until the welcome is discarded")
        try:
            self.reset()
        except GantryTimeout:
            self.wire.remark("no welcome after the alarm")
        meaning = self.dialect.meaning("alarm", code)
        raise GantryAlarm(f"alarm {code}: {meaning}; home again", self.port, code)

    def _machine_position(self, report: protocol.Report) -> FloatArray | None:
        offset, work = self._offset, report.work
        if report.machine is None and offset is not None and work is not None and work.shape == offset.shape:
            return work + offset
        return report.machine


def _is_place(item: protocol.Received) -> TypeGuard[protocol.Message]:
    return isinstance(item, protocol.Message) and item.name == "POS"
