"""SE(3) and frames.

Here: exponential, logarithm, adjoint, Jacobians (compiled), and ``Pose``, which refuses frames that do not meet.
In: arrays. Out: arrays and poses. Plug point: none.
"""

from uvgs_bench.geometry.arrays import FloatArray, read_only
from uvgs_bench.geometry.pose import Pose

__all__ = ["FloatArray", "Pose", "read_only"]
