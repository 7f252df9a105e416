"""What the driver needs to know from a controller's ``$$``, and which settings it refuses to work with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.devices.gantry.grbl_codes import Dialect
from uvgs_bench.errors import GantryError
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.units import S_PER_MIN, deg_from_rad, m_from_mm, mm_from_m, rad_from_deg

_CORRUPT = 255.0
# A controller keeps its settings with three decimals.
_ROUNDED = 1.001
# Steps per mm or deg of a belt drive, for controllers that do not tell: arrival is judged by half a step.
_COARSE_STEPS = 80.0


@dataclass(frozen=True, slots=True, eq=False)
class ControllerSettings:
    """Settings that matter to the driver.

    Args:
        steps: Steps per mm or deg, shape (A,).
        has_homing: Whether the homing cycle is switched on.
        axes: The axes, no faster than both the bench and the controller allow, with the controller's acceleration.
        excess: Where the controller would move with more than the bench file allows, one line each; then nothing moves.
    """

    steps: FloatArray
    has_homing: bool
    axes: tuple[Axis, ...]
    excess: tuple[str, ...] = ()


def read_settings(settings: Mapping[str, str], axes: Sequence[Axis], port: str, dialect: Dialect) -> ControllerSettings:
    """Check a controller's settings against the bench.

    Args:
        settings: Values by number, as text.
        axes: The axes in the controller's order.
        port: For messages.
        dialect: The firmware; one that does not list its settings is taken at the word of the bench.

    Returns:
        What the driver needs.

    Raises:
        GantryError: Settings are missing or corrupt, reports are in inches, or the travel is shorter than the envelope.
    """
    values = _numbers(settings)
    if not values and dialect.lists_settings:
        raise GantryError("the controller tells no settings; expected lines like $100=250.000", port)
    if sum(values.get(number) == _CORRUPT for number in (0, 2, 3, 10, 26, 100)) >= 3:
        raise GantryError("the controller's settings are corrupt (255 everywhere); restore them with $RST=$", port)
    if values.get(13, 0.0):
        raise GantryError("the controller reports in inches ($13=1); the driver needs $13=0", port)
    unknown_steps = 0.0 if dialect.lists_settings else _COARSE_STEPS
    steps = np.array([values.get(100 + i, unknown_steps) for i in range(len(axes))])
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
    has_homing = bool(values.get(22, 0.0 if dialect.lists_settings else 1.0))
    return ControllerSettings(read_only(steps), has_homing, paced, _excess(values, axes))


def settings_warnings(settings: Mapping[str, str], axes: Sequence[Axis]) -> tuple[str, ...]:
    """What is unwise about a controller's settings, one line each.

    Args:
        settings: Values by number, as text.
        axes: The axes in the controller's order.

    Returns:
        Nothing, when all is well or the controller does not tell.
    """
    values = _numbers(settings)
    warnings = []
    if values.get(20) == 0.0:
        warnings.append("soft limits are off ($20=0): a move damaged on the line is not refused by the controller")
    if values.get(1, _CORRUPT) != _CORRUPT:
        warnings.append(f"motors are released {values[1]:g} ms after a move ($1): use $1=255 to hold the position")
    if values.get(32):
        warnings.append("laser mode is on ($32=1): lights go out at a hold")
    warnings += _excess(values, axes)
    for i, axis in enumerate(axes):
        feed = (mm_from_m if axis.kind == "linear" else deg_from_rad)(axis.max_speed) * S_PER_MIN
        if values.get(110 + i, 0.0) > feed * _ROUNDED:
            warnings.append(
                f"axis {axis.name} can go at ${110 + i}={values[110 + i]:g}, the bench file allows {feed:g}: a feed "
                "damaged on the line would not be held back"
            )
        if values.get(130 + i) == 0.0 and axis.kind == "linear":
            warnings.append(f"axis {axis.name} has no travel (${130 + i}=0), so no soft limit")
    return tuple(warnings)


def _excess(values: Mapping[int, float], axes: Sequence[Axis]) -> tuple[str, ...]:
    """What a line of G-code cannot limit: the acceleration of every move, and the speed of homing."""
    found = []
    for i, axis in enumerate(axes):
        convert, unit = (mm_from_m, "mm") if axis.kind == "linear" else (deg_from_rad, "deg")
        allowed, feed = convert(axis.acceleration), convert(axis.max_speed) * S_PER_MIN
        if values.get(120 + i, 0.0) > allowed * _ROUNDED:
            what = f"accelerates with ${120 + i}={values[120 + i]:g} {unit}/s^2"
            found.append(_too_much(axis, what, allowed, 120 + i))
        # An axis without a travel has no switch to go to.
        is_homed = values.get(130 + i, 0.0) > 0.0
        if is_homed and min(values.get(25, 0.0), values.get(110 + i, 0.0)) > feed * _ROUNDED:
            found.append(_too_much(axis, f"homes with $25={values[25]:g} {unit}/min", feed, 25))
    return tuple(found)


def _too_much(axis: Axis, what: str, allowed: float, number: int) -> str:
    return (
        f"axis {axis.name} {what}, the bench file allows {allowed:g}: set it with `uvgs gantry settings "
        f"{number}={allowed:g}`, or allow more in the bench file"
    )


def _numbers(settings: Mapping[str, str]) -> dict[int, float]:
    values: dict[int, float] = {}
    for number, text in settings.items():
        try:
            values[int(number)] = float(text)
        except ValueError:
            continue
    return values


def _paced(axis: Axis, speed_per_min: float, acceleration: float) -> Axis:
    convert = m_from_mm if axis.kind == "linear" else rad_from_deg
    speed = convert(speed_per_min / S_PER_MIN)
    return replace(
        axis,
        max_speed=min(axis.max_speed, speed) if speed > 0.0 else axis.max_speed,
        acceleration=convert(acceleration) if acceleration > 0.0 else axis.acceleration,
    )
