"""A plug into a running ROS: topics in and out as serialised messages, parameters that change at run time.

In: topic names, bytes of messages. Out: bytes of messages. To add another middleware: a class with the methods of
``RosDoor`` in a file of its own, and one line in ``DOORS``.
"""

from uvgs_bench.devices.ros.door import DOORS, ParameterValue, RosDoor, open_ros
from uvgs_bench.devices.ros.messages import RosMessages

__all__ = ["DOORS", "ParameterValue", "RosDoor", "RosMessages", "open_ros"]
