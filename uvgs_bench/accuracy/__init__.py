"""How good the sensor is, against a gantry.

Here: registration of the frames with what cannot be seen, errors in camera axes, statistics with intervals that respect
stations, verdicts against limits. In: ``Observations`` of one run and limits. Out: ``Judgement``. Plug point: none.
"""

from uvgs_bench.accuracy.judgement import Judgement, Limit
from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.pose_error import ErrorTable
from uvgs_bench.accuracy.registration import Registration

__all__ = [
    "ErrorTable",
    "Judgement",
    "Limit",
    "Observations",
    "Registration",
]
