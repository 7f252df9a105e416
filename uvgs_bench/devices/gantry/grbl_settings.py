"""What the driver needs to know from a controller's ``$$``, and which settings it refuses to work with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.errors import GantryError
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.units import S_PER_MIN, deg_from_rad, m_from_mm, mm_from_m, rad_from_deg

_CORRUPT = 255.0


@dataclass(frozen=True, slots=True, eq=False)
class ControllerSettings:
    """Settings that matter to the driver.

    Args:
        steps: Steps per mm or deg, shape (A,).
        has_homing: Whether the homing cycle is switched on.
        axes: The axes, no faster than both the bench and the controller allow, with the controller's acceleration.
    """

    steps: FloatArray
    has_homing: bool
    axes: tuple[Axis, ...]


def read_settings(settings: Mapping[str, str], axes: Sequence[Axis], port: str) -> ControllerSettings:
    """Check a controller's settings against the bench.

    Args:
        settings: Values by number, as text.
        axes: The axes in the controller's order.
        port: For messages.

    Returns:
        What the driver needs.

    Raises:
        GantryError: Settings are missing or corrupt, reports are in inches, or the travel is shorter than the envelope.
    """
    values: dict[int, float] = {}
    for number, text in settings.items():
        try:
            values[int(number)] = float(text)
        except ValueError:
            continue
    if not values:
        raise GantryError("the controller tells no settings; expected lines like $100=250.000", port)
    if sum(values.get(number) == _CORRUPT for number in (0, 2, 3, 10, 26, 100)) >= 3:
        raise GantryError("the controller's settings are corrupt (255 everywhere); restore them with $RST=$", port)
    if values.get(13, 0.0):
        raise GantryError("the controller reports in inches ($13=1); the driver needs $13=0", port)
    steps = np.array([values.get(100 + i, 0.0) for i in range(len(axes))])
    for i, axis in enumerate(axes):
        if not (np.isfinite(steps[i]) and steps[i] > 0.0):
            raise GantryError(f"axis {axis.name}: the controller has no steps per unit (${100 + i})", port)
        travel = values.get(130 + i, 0.0)
        wanted = axis.upper - axis.lower
        wanted = mm_from_m(wanted) if axis.kind == "linear" else deg_from_rad(wanted)
        if 0.0 < travel < wanted - 0.001:
            unit = "mm" if axis.kind == "linear" else "deg"
            raise GantryError(
                f"axis {axis.name}: the controller's travel (${130 + i}={travel:g} {unit}) is shorter than "
                f"the envelope of the bench ({wanted:g} {unit})",
                port,
            )
    paced = tuple(_paced(axis, values.get(110 + i, 0.0), values.get(120 + i, 0.0)) for i, axis in enumerate(axes))
    return ControllerSettings(read_only(steps), bool(values.get(22, 0.0)), paced)


def _paced(axis: Axis, speed_per_min: float, acceleration: float) -> Axis:
    convert = m_from_mm if axis.kind == "linear" else rad_from_deg
    speed = convert(speed_per_min / S_PER_MIN)
    return replace(
        axis,
        max_speed=min(axis.max_speed, speed) if speed > 0.0 else axis.max_speed,
        acceleration=convert(acceleration) if acceleration > 0.0 else axis.acceleration,
    )
