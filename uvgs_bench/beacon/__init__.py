"""The LEDs and how sure we are of them.

Here: ``Beacon``, its checks. In: positions. Out: ``Beacon`` and warnings with numbers. Plug point: none.
"""

from uvgs_bench.beacon.checks import BeaconWarning, check_beacon
from uvgs_bench.beacon.geometry import Beacon, Led

__all__ = ["Beacon", "BeaconWarning", "Led", "check_beacon"]
