"""The LEDs and how sure we are of them.

Here: ``Beacon``, its checks. In: positions. Out: ``Beacon`` and warnings with numbers. Plug point: none.
"""

from uvgs_bench.beacon.geometry import Beacon, Led

__all__ = ["Beacon", "Led"]
