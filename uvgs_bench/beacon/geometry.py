"""The beacon: named LEDs at known places, how sure we are of them, and whether four of them can tell one pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.geometry import FloatArray, read_only


@dataclass(frozen=True, slots=True, eq=False)
class Led:
    """One physical light.

    Args:
        name: Its name, unique in the beacon.
        position_m: Emission centre in the beacon frame, shape (3,), m.
        axis: Unit vector of strongest emission in the beacon frame, shape (3,), or None when it shines everywhere.
        half_angle_rad: Angle from the axis beyond which it cannot be seen, rad, or None.
        diameter_m: Diameter of the emitting area, m, or None when unknown.
    """

    name: str
    position_m: FloatArray
    axis: FloatArray | None = None
    half_angle_rad: float | None = None
    diameter_m: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "position_m", read_only(self.position_m, (3,)))
        if self.axis is not None:
            axis = np.asarray(self.axis, dtype=np.float64)
            norm = float(np.linalg.norm(axis))
            if not norm > 0.0:
                raise ValueError(f"LED {self.name}: the axis must not be zero")
            object.__setattr__(self, "axis", read_only(axis / norm, (3,)))


@dataclass(frozen=True, slots=True, eq=False)
class Beacon:
    """Four or more LEDs in one rigid frame.

    Args:
        name: Its name.
        leds: The LEDs in the order of the file.
        hue: ``any``, ``red``, ``green``, ``blue``, ``white``, or a range in degrees as ``(low, high)`` (may wrap).
        covariance_m2: Covariance of all positions, LED by LED, x y z, shape (3n, 3n), m^2, or None when not measured.

    Raises:
        ValueError: Fewer than four LEDs, names not unique, or a covariance of another size.
    """

    name: str
    leds: tuple[Led, ...]
    hue: str | tuple[float, float] = "any"
    covariance_m2: FloatArray | None = None

    def __post_init__(self) -> None:
        if len(self.leds) < 4:
            raise ValueError(f"a beacon needs at least 4 LEDs, got {len(self.leds)}")
        names = [led.name for led in self.leds]
        if len(set(names)) != len(names):
            raise ValueError(f"LED names must be unique, got {', '.join(names)}")
        if self.covariance_m2 is not None:
            n = 3 * len(self.leds)
            object.__setattr__(self, "covariance_m2", read_only(self.covariance_m2, (n, n)))

    @property
    def positions_m(self) -> FloatArray:
        """LED positions, shape (n, 3), m, beacon frame."""
        return read_only(np.array([led.position_m for led in self.leds]))

    @property
    def led_names(self) -> tuple[str, ...]:
        """Names in the order of the file."""
        return tuple(led.name for led in self.leds)
