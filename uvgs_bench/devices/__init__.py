"""What has a plug: cameras, gantries, and their simulated twins.

In: spec strings and the bench document. Out: captures and gantry states on one clock. Plug points: the tables
``CAMERAS`` and ``GANTRIES``.
"""

from uvgs_bench.devices.bench import Bench
from uvgs_bench.devices.clock import Clock, RealClock, ScaledClock

__all__ = ["Bench", "Clock", "RealClock", "ScaledClock"]
