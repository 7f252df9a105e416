"""Axes of the gantry, what they can reach, and where the carriage is for given axis positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from uvgs_bench.errors import EnvelopeError
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.units import deg_from_rad, mm_from_m

AxisKind = Literal["linear", "rotary"]

# A controller reports three decimals of a millimetre; a target on the border must not be refused for its rounding.
_BORDER = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Axis:
    """One axis. Quantities are in m, m/s, m/s^2 for a linear axis and rad, rad/s, rad/s^2 for a rotary one.

    Args:
        name: The controller's letter, for example ``X``.
        kind: ``linear`` or ``rotary``.
        direction: Unit vector in gantry axes, shape (3,): travel direction, or axis of rotation.
        lower: Smallest allowed machine position.
        upper: Largest allowed machine position.
        max_speed: Largest speed.
        acceleration: Largest acceleration.
        backlash: Known reversal, >= 0; the approach overshoots by more than this.
        scale: True travel per reported travel, > 0, as measured; 1 is as declared.
    """

    name: str
    kind: AxisKind
    direction: FloatArray
    lower: float
    upper: float
    max_speed: float
    acceleration: float
    backlash: float = 0.0
    scale: float = 1.0

    def __post_init__(self) -> None:
        direction = np.asarray(self.direction, dtype=np.float64)
        norm = float(np.linalg.norm(direction))
        if direction.shape != (3,) or not norm > 0.0:
            raise ValueError(f"axis {self.name}: direction must be a vector of 3 that is not zero")
        if not self.lower < self.upper:
            raise ValueError(f"axis {self.name}: lower bound must be below the upper bound")
        if not (self.max_speed > 0.0 and self.acceleration > 0.0 and self.backlash >= 0.0):
            raise ValueError(f"axis {self.name}: speed and acceleration must be positive, backlash not negative")
        if not 0.5 < self.scale < 2.0:
            raise ValueError(f"axis {self.name}: the scale must be near 1, got {self.scale:g}")
        object.__setattr__(self, "direction", read_only(direction / norm, (3,)))

    def described(self, value: float) -> str:
        """A position in the unit people use: ``12.000 mm`` or ``30.000 deg``."""
        if self.kind == "linear":
            return f"{mm_from_m(value):.3f} mm"
        return f"{deg_from_rad(value):.3f} deg"


@dataclass(frozen=True, slots=True, eq=False)
class Envelope:
    """Everything the carriage may reach: the box of the axes, less keep-out boxes.

    Args:
        axes: The axes in the controller's order.
        keep_out: Boxes in axis positions, each (2, A): lower and upper corner, that no move may touch.
    """

    axes: tuple[Axis, ...]
    keep_out: tuple[FloatArray, ...] = field(default=())

    def check_point(self, position: Sequence[float] | FloatArray) -> None:
        """Refuse a target outside the envelope.

        Args:
            position: Axis positions, length A, m or rad.

        Raises:
            EnvelopeError: Wrong length, not finite, outside an axis' bounds, or inside a keep-out box.
        """
        q = np.asarray(position, dtype=np.float64)
        if q.shape != (len(self.axes),):
            raise EnvelopeError(f"a target needs {len(self.axes)} axis positions, got {q.shape}")
        for axis, value in zip(self.axes, q, strict=True):
            if not np.isfinite(value) or value < axis.lower - _BORDER or value > axis.upper + _BORDER:
                raise EnvelopeError(
                    f"axis {axis.name} at {axis.described(float(value))} is outside its envelope "
                    f"{axis.described(axis.lower)} to {axis.described(axis.upper)}",
                    axis.name,
                )
        self.check_path(q, q)

    def check_path(self, start: Sequence[float] | FloatArray, end: Sequence[float] | FloatArray) -> None:
        """Refuse a straight path that touches a keep-out box; the box of the axes is convex, so ends suffice for it.

        Args:
            start: Axis positions, length A, m or rad.
            end: Axis positions, length A, m or rad.

        Raises:
            EnvelopeError: The path touches a keep-out box.
        """
        p, q = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        for box in self.keep_out:
            if _segment_meets_box(p, q, box[0], box[1]):
                raise EnvelopeError("the path touches a keep-out box " + self._described_box(box))

    def _described_box(self, box: FloatArray) -> str:
        return " x ".join(
            f"{axis.name} {axis.described(float(lo))}..{axis.described(float(hi))}"
            for axis, lo, hi in zip(self.axes, box[0], box[1], strict=True)
        )


def _segment_meets_box(p: FloatArray, q: FloatArray, lower: FloatArray, upper: FloatArray) -> bool:
    """Whether a segment meets a closed box, by the slab method."""
    enter, leave = 0.0, 1.0
    for i in range(len(p)):
        step = q[i] - p[i]
        if abs(step) < 1e-15:
            if p[i] < lower[i] or p[i] > upper[i]:
                return False
            continue
        a, b = (lower[i] - p[i]) / step, (upper[i] - p[i]) / step
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
        if enter > leave:
            return False
    return True


def gantry_from_carriage(axes: Sequence[Axis], position: Sequence[float] | FloatArray) -> Pose:
    """Where the carriage is, for axes as declared, or as measured where they carry a scale and a measured direction.

    Args:
        axes: The axes, applied in this order.
        position: Axis positions, length A, m or rad.

    Returns:
        ``gantry_from_carriage``; the identity at position 0.
    """
    pose = Pose.identity("gantry", "carriage")
    for axis, value in zip(axes, position, strict=True):
        if axis.kind == "linear":
            step = Pose(np.eye(3), axis.direction * (axis.scale * float(value)), "carriage", "carriage")
        else:
            step = Pose(so3_exp(axis.direction * (axis.scale * float(value))), np.zeros(3), "carriage", "carriage")
        pose = pose @ step
    return pose
