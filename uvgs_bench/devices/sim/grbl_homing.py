"""The homing cycle of a mock GRBL 1.1: Z first, then X with Y, then the others; seek fast, pull off, locate slowly."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from math import inf

import numpy as np

from uvgs_bench.devices.sim.grbl_motion import path_limits, run_into, trapezoid
from uvgs_bench.devices.sim.grbl_motors import Motors
from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import S_PER_MIN, s_from_ms

_SEARCH = 1.5
_LOCATE_PULL_OFFS = 5.0


class SwitchNotFound(Exception):
    """An axis ran its search distance without closing its switch."""


class Homing:
    """One homing cycle.

    Args:
        letters: Axis letters.
        settings: Numbered settings.
        switches: Motor position at which each switch closes, shape (A,), mm or deg; infinite for an axis without.
        motors: What moves.
        now_s: Bench time, s.
    """

    def __init__(
        self,
        letters: str,
        settings: Mapping[int, float],
        switches: FloatArray,
        motors: Motors,
        now_s: Callable[[], float],
    ) -> None:
        count = len(letters)
        self._letters = letters
        self._switches = switches
        self._motors = motors
        self._now_s = now_s
        self._senses = homing_senses(settings, count)
        self._travel = np.array([settings[130 + i] for i in range(count)])
        self._acceleration = np.array([settings[120 + i] for i in range(count)])
        self._locate, self._seek_speed = settings[24] / S_PER_MIN, settings[25] / S_PER_MIN
        self._debounce_s = s_from_ms(settings[26])
        self._pull_off = settings[27]

    def run(self) -> Iterator[float]:
        """Go through the cycle, yielding until when to wait, s. Raises SwitchNotFound."""
        others = "".join(letter for letter in self._letters if letter not in "XYZ")
        for group in ("Z", "XY", others):
            axes = [i for i, letter in enumerate(self._letters) if letter in group and np.isfinite(self._switches[i])]
            if axes:
                yield from self._approach(axes, self._seek_speed, _SEARCH * self._travel)
                yield from self._back_off(axes)
                reach = np.full(len(self._letters), _LOCATE_PULL_OFFS * self._pull_off)
                yield from self._approach(axes, self._locate, reach)
                yield from self._back_off(axes)

    def machine_position(self) -> FloatArray:
        """What the controller calls the place where a finished cycle ends, shape (A,), mm or deg."""
        machine = np.where(self._senses > 0.0, -self._pull_off, self._pull_off - self._travel)
        return np.where(np.isfinite(self._switches), machine, 0.0)

    def _approach(self, axes: Sequence[int], speed: float, reach: FloatArray) -> Iterator[float]:
        """Run axes towards their switches together; each stops at its own."""
        here = self._motors.position(self._now_s())
        ways = {i: max(0.0, float(self._senses[i] * (self._switches[i] - here[i]))) for i in axes}
        limit = min(float(reach[i]) for i in axes)
        done, acceleration = 0.0, float(np.min(self._acceleration[list(axes)]))
        for way in sorted({min(way, limit) for way in ways.values()} - {0.0}):
            going = [i for i in axes if ways[i] > done]
            start = self._motors.position(self._now_s())
            end = start.copy()
            end[going] += self._senses[going] * (way - done)
            share = float(np.sqrt(len(going)))
            self._motors.begin(run_into(start, end, self._now_s(), speed * share, acceleration * share))
            yield from self._until_rest()
            done, acceleration = way, inf
        if any(way > limit for way in ways.values()):
            raise SwitchNotFound
        yield from self._wait_debounced()

    def _back_off(self, axes: Sequence[int]) -> Iterator[float]:
        start = self._motors.position(self._now_s())
        end = start.copy()
        end[list(axes)] -= self._senses[list(axes)] * self._pull_off
        _, acceleration = path_limits(end - start, self._acceleration, self._acceleration)
        self._motors.begin(trapezoid(start, end, self._now_s(), self._seek_speed, acceleration))
        yield from self._until_rest()
        yield from self._wait_debounced()

    def _until_rest(self) -> Iterator[float]:
        while self._motors.moving is not None:
            yield inf

    def _wait_debounced(self) -> Iterator[float]:
        until_s = self._now_s() + self._debounce_s
        while self._now_s() < until_s:
            yield until_s


def homing_senses(settings: Mapping[int, float], axis_count: int) -> FloatArray:
    """On which side each axis has its switch by setting 23: +1 or -1, shape (A,)."""
    mask = int(settings[23])
    return np.array([-1.0 if mask >> i & 1 else 1.0 for i in range(axis_count)])
