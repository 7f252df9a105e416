"""The numbered settings of a mock GRBL 1.1: factory values, how they print, which values are refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from uvgs_bench.devices.gantry.axes import Axis, AxisKind
from uvgs_bench.devices.sim.grbl_gcode import Refused
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.units import S_PER_MIN, deg_from_rad, m_from_mm, mm_from_m, rad_from_deg

_FACTORY: dict[int, float] = {
    0: 10, 1: 25, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0, 10: 1, 11: 0.010, 12: 0.002, 13: 0, 20: 0, 21: 0, 22: 0, 23: 0,
    24: 25.0, 25: 500.0, 26: 250, 27: 1.0, 30: 1000, 31: 0, 32: 0,
}  # fmt: skip
_FACTORY_AXIS = {100: 250.0, 110: 500.0, 120: 10.0, 130: 200.0}
_DECIMAL = {11, 12, 24, 25, 27}
_SWITCHES = {4, 5, 6, 13, 20, 21, 22, 32}


def factory_settings(axis_count: int) -> dict[int, float]:
    """What a new controller holds.

    Args:
        axis_count: Number of axes.

    Returns:
        Values by number, in the controller's units.
    """
    settings = dict(_FACTORY)
    for base, value in _FACTORY_AXIS.items():
        settings.update({base + i: value for i in range(axis_count)})
    return settings


def metrology_settings(axis_count: int = 3) -> dict[int, float]:
    """Settings of a controller set up for a small metrology gantry: homing, soft limits, motors always held.

    Args:
        axis_count: Number of axes.

    Returns:
        Values by number, in the controller's units.
    """
    settings = factory_settings(axis_count)
    settings.update({1: 255, 10: 3, 20: 1, 22: 1, 24: 100.0, 25: 1500.0, 26: 25})
    for base, value in {100: 400.0, 110: 3000.0, 120: 200.0}.items():
        settings.update({base + i: value for i in range(axis_count)})
    return settings


def settings_for_axes(axes: Sequence[Axis]) -> dict[int, float]:
    """The metrology settings with the travel, speed and acceleration of given axes.

    Args:
        axes: The axes. One whose upper bound is above 0 has no switch and no soft limit (travel 0), since the machine
            space of the controller is negative.

    Returns:
        Values by number, in the controller's units.
    """
    settings = metrology_settings(len(axes))
    to_unit = [mm_from_m if axis.kind == "linear" else deg_from_rad for axis in axes]
    for i, (axis, convert) in enumerate(zip(axes, to_unit, strict=True)):
        settings[110 + i] = convert(axis.max_speed) * S_PER_MIN
        settings[120 + i] = convert(axis.acceleration)
        settings[130 + i] = 0.0 if axis.upper > 0.0 else convert(-axis.lower)
    settings[25] = min(settings[25], *(settings[110 + i] for i in range(len(axes))))
    return settings


def printed(number: int, value: float) -> str:
    """A setting as ``$$`` prints it."""
    text = f"{value:.3f}" if number >= 100 or number in _DECIMAL else f"{value:.0f}"
    return f"${number}={text}"


def changed(settings: Mapping[int, float], text: str) -> dict[int, float]:
    """The settings after a line ``$number=value``.

    Args:
        settings: Before.
        text: The line without its dollar.

    Returns:
        After.

    Raises:
        Refused: 2 not a number, 3 no such setting, 4 negative, 6 step pulse too short, 10 soft limits without homing.
    """
    name, _, value_text = text.partition("=")
    try:
        number, value = int(name), float(value_text)
    except ValueError:
        raise Refused(2 if name.isdigit() else 3) from None
    if number not in settings:
        raise Refused(3)
    if value < 0.0:
        raise Refused(4)
    if number == 0 and value < 3.0:
        raise Refused(6)
    if number == 20 and value and not settings[22]:
        raise Refused(10)
    after = dict(settings)
    after[number] = float(bool(value)) if number in _SWITCHES else value
    if number == 22 and not value:
        after[20] = 0.0
    return after


def si_positions(kinds: Sequence[AxisKind], values: FloatArray) -> FloatArray:
    """Axis values in m or rad from the controller's mm or deg, shape (A,)."""
    return read_only(
        [
            m_from_mm(float(value)) if kind == "linear" else rad_from_deg(float(value))
            for value, kind in zip(values, kinds, strict=True)
        ]
    )
