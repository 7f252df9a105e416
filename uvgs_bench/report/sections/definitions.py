"""What every figure of merit means."""

from __future__ import annotations

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.report.document import Definitions, Section
from uvgs_bench.store.run import Run

_ITEMS = (
    ("Position error", "e = t_observed − t_predicted in camera axes; lateral: x and y; depth: z; length ‖e‖."),
    (
        "Attitude error",
        "θ = Log(R_observed R_predictedᵀ) in camera axes; tilt: x and y; roll: z; angle ‖θ‖.",
    ),
    ("Bias", "Mean of the error; for lateral, position and attitude the length of the mean vector (trueness)."),
    (
        "Spread",
        "Standard deviation about that mean; for vectors the root of the covariance's trace (precision).",
    ),
    ("RMS", "Root of the mean square, bias included: RMS² = bias² + spread²."),
    ("Median, 95th percentile", "Of the absolute value of a component, or of the length of a vector."),
    (
        "Largest",
        "The largest seen: a fact, without interval. From 59 independent captures on 95 % of all captures lie below "
        "it with 95 % confidence; with fewer, less, as stated under the tables.",
    ),
    ("Within a station", "Standard deviation of repeated captures about the mean of their station: repeatability."),
    ("Between stations", "Standard deviation of the station means beyond what repeatability explains."),
    ("Availability", "Captures with a pose over captures attempted."),
    ("95 % interval", "Range that holds the true figure in 95 of 100 such runs; whole stations are resampled."),
    (
        "Pass, fail, inconclusive",
        "The interval lies within the limit; outside it; across it, so the data cannot tell.",
    ),
    ("Held out, in sample", "Stations that took no part in the registration; stations it was fitted on."),
    ("NEES", "eᵀ C⁻¹ e of the six-component error with its predicted covariance; 6 on average when C is honest."),
    ("Reprojection RMS", "Of LED residuals, per axis; of the camera calibration, both axes: sqrt(mean(dx² + dy²))."),
    ("Margin", "Cost of the runner-up pose over the cost of the chosen one; 1 means a toss-up."),
)


def build(run: Run, judgement: Judgement) -> Section | None:
    """The definitions card."""
    del run, judgement
    return Section("definitions", "Definitions", (Definitions(_ITEMS),))
