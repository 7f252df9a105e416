"""The gantry: axes and envelope, and drivers that move it.

Here: axes, what they may reach, the GRBL driver. In: a port spec and target positions. Out: ``GantryState``.
Plug point: ``GANTRIES`` in ``registry.py``.
"""

from uvgs_bench.devices.gantry.axes import Axis, Envelope, gantry_from_carriage
from uvgs_bench.devices.gantry.gantry import ControllerInfo, Gantry, GantryState, WireLog
from uvgs_bench.devices.gantry.registry import open_gantry

__all__ = [
    "Axis",
    "ControllerInfo",
    "Envelope",
    "Gantry",
    "GantryState",
    "WireLog",
    "gantry_from_carriage",
    "open_gantry",
]
