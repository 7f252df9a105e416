"""The stamps of a topic of a bag: rate, gaps, drops, clocks that jump or differ; what is wrong is a line each."""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import NS_PER_S, s_from_ns

# A topic has a rate when so many of its steps lie so near to the median; events have none.
_PERIODIC_SHARE, _PERIODIC_SPREAD = 0.7, 0.5
_FEWEST_STEPS = 4
# A recorder that is this late, or a clock that moves this far against another, is worth a line, s.
_OFFSET_S = 0.5


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that is not as it should be.

    Args:
        level: ``problem`` makes poses wrong or missing; ``warning`` is worth knowing.
        topic: The topic, or the file.
        text: What it is, in one line.
    """

    level: Literal["problem", "warning"]
    topic: str
    text: str


@dataclass(frozen=True, slots=True)
class StampSummary:
    """How the stamps of a topic run.

    Args:
        messages: Messages with a stamp.
        rate_hz: One over the median step; None for topics without a steady rate.
        dropped: Messages missing by that rate; None without one.
        longest_gap_s: Longest step, s; None below two messages.
        offset_s: Median of the bag's own time less the header's, s; None without messages.
        backwards: Steps back in time.
        jumps: Steps in which header and bag disagree by more than half a second.
    """

    messages: int
    rate_hz: float | None
    dropped: int | None
    longest_gap_s: float | None
    offset_s: float | None
    backwards: int
    jumps: int


class StampWatch:
    """Collects the header stamps of a topic beside the bag's own times.

    Args:
        topic: Its name.
    """

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._header_ns = array("q")
        self._log_ns = array("q")

    def see(self, fields: Any, log_ns: int) -> None:
        """Take a message."""
        stamp = getattr(getattr(fields, "header", None), "stamp", None)
        if stamp is not None:
            self._header_ns.append(int(stamp.sec) * NS_PER_S + int(stamp.nanosec))
            self._log_ns.append(log_ns)

    def summary(self) -> StampSummary:
        """The figures."""
        steps_s, log_steps_s = self._steps_s()
        offsets_s = self._offsets_s()
        usual_s = _usual_s(steps_s)
        is_jump = np.abs(steps_s - log_steps_s) > _OFFSET_S
        dropped = None
        if usual_s is not None:
            # A stamp that is wrong once makes one step too short and the next too long: no message is missing.
            dropped = max(0, int(np.round(steps_s[~is_jump] / usual_s).sum()) - int((~is_jump).sum()))
        return StampSummary(
            len(self._header_ns),
            None if usual_s is None else 1.0 / usual_s,
            dropped,
            float(steps_s.max()) if steps_s.size else None,
            float(np.median(offsets_s)) if offsets_s.size else None,
            int((steps_s < 0.0).sum()),
            int(is_jump.sum()),
        )

    def findings(self) -> list[Finding]:
        """What is wrong with them."""
        found: list[Finding] = []

        def add(level: Literal["problem", "warning"], text: str) -> None:
            found.append(Finding(level, self._topic, text))

        steps_s, log_steps_s = self._steps_s()
        unset = sum(stamp == 0 for stamp in self._header_ns)
        if unset:
            add(
                "problem",
                f"{unset} of {len(self._header_ns)} header stamps were never set (0); ?stamps=log takes others",
            )
        back = np.flatnonzero(steps_s < 0.0)
        if back.size:
            worst = back[np.argmin(steps_s[back])]
            add(
                "problem",
                f"header stamps run backwards {back.size} times, by {-steps_s[worst]:.3f} s at message {worst + 1}",
            )
        # Only where stamps were set on both sides.
        set_ns = np.frombuffer(self._header_ns, dtype=np.int64) > 0 if len(self._header_ns) else np.zeros(0, dtype=bool)
        jumps = np.flatnonzero((np.abs(steps_s - log_steps_s) > _OFFSET_S) & (set_ns[1:] & set_ns[:-1]))
        if jumps.size:
            first = int(jumps[0])
            moved_s = steps_s[first] - log_steps_s[first]
            add(
                "problem",
                f"the header clock jumps {jumps.size} times against the bag's, by {moved_s:+.3f} s at "
                f"message {first + 1}",
            )
        same = int((steps_s == 0.0).sum()) - max(unset - 1, 0)
        if same > 0:
            add("warning", f"{same} messages carry the stamp of the one before")
        summary = self.summary()
        if summary.rate_hz is not None and summary.dropped:
            gap = int(np.argmax(steps_s))
            share = summary.dropped / (summary.dropped + summary.messages)
            add(
                "warning",
                f"{summary.dropped} messages dropped by its rate of {summary.rate_hz:.4g} Hz ({100.0 * share:.1f} %); "
                f"longest gap {steps_s[gap]:.3f} s at message {gap + 1}",
            )
        if summary.offset_s is not None and abs(summary.offset_s) > _OFFSET_S and not unset and not jumps.size:
            word = "later" if summary.offset_s > 0.0 else "earlier"
            add(
                "warning",
                f"recorded {abs(summary.offset_s):.3f} s {word} than its header stamps (median), which poses carry",
            )
        return found

    def _steps_s(self) -> tuple[FloatArray, FloatArray]:
        return _steps_s(self._header_ns), _steps_s(self._log_ns)

    def _offsets_s(self) -> FloatArray:
        offsets: FloatArray = np.array(
            [s_from_ns(log - header) for header, log in zip(self._header_ns, self._log_ns, strict=True)]
        )
        return offsets


def _steps_s(stamps_ns: array[int]) -> FloatArray:
    steps: Any = np.diff(np.array(stamps_ns, dtype=np.int64))
    result: FloatArray = steps / float(NS_PER_S)
    return result


def _usual_s(steps_s: FloatArray) -> float | None:
    """The usual step of a topic that has one."""
    if steps_s.size < _FEWEST_STEPS:
        return None
    usual_s = float(np.median(steps_s))
    near = np.abs(steps_s - usual_s) <= _PERIODIC_SPREAD * usual_s
    return usual_s if usual_s > 0.0 and float(near.mean()) >= _PERIODIC_SHARE else None
