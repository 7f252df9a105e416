"""How good the sensor is, against a gantry.

Here: registration of the frames with what cannot be seen, errors in camera axes, statistics with intervals that respect
stations, verdicts against limits. In: ``Observations`` of one run and limits. Out: ``Judgement``. Plug point: none.
"""

from uvgs_bench.accuracy.judgement import Judgement, Limit, judge
from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.pose_error import ErrorTable, error_table
from uvgs_bench.accuracy.registration import Registration, fit_registration

__all__ = [
    "ErrorTable",
    "Judgement",
    "Limit",
    "Observations",
    "Registration",
    "error_table",
    "fit_registration",
    "judge",
]
