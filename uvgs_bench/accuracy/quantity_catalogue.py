"""What every quantity of a run is called, what it means, and after which text: the words that are printed with it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from uvgs_bench.accuracy.clusters import Estimate

Unit = Literal["m", "rad", "s", "1"]

_E2919 = "after the idea of ASTM E2919 (static pose); no conformity is claimed"
_ISO_9283 = "after ISO 9283; angles from residual rotation vectors, where the standard has Euler angles"
_ISO_5725 = "after ISO 5725-2, places as levels and runs as laboratories"
_E3064 = "after the idea of ASTM E3064 (withdrawn 2025): two clusters held rigidly, no reference needed"


@dataclass(frozen=True, slots=True)
class Text:
    """Name, definition, source and unit of a quantity.

    Args:
        name: What it is called, without its unit.
        definition: How it is computed, one sentence or two.
        source: Where the definition comes from.
        unit: SI unit of the figure; ``1`` for fractions and ratios.
    """

    name: str
    definition: str
    source: str
    unit: Unit


@dataclass(frozen=True, slots=True)
class Quantity:
    """One figure of a run with its definition.

    Args:
        key: Its name in files, a key of ``TEXTS``.
        name: What it is called, without its unit.
        definition: How it is computed.
        source: Where the definition comes from.
        unit: SI unit of the estimate: ``m rad s 1``.
        estimate: Figure, 95 % interval and counts; NaN with a note when the run cannot give it.
        group: What the captures were grouped by (``range view_angle zone exposure``), empty for all captures.
        group_value: Which group, in words, empty for all captures.
    """

    key: str
    name: str
    definition: str
    source: str
    unit: Unit
    estimate: Estimate
    group: str = ""
    group_value: str = ""


def quantity(key: str, estimate: Estimate, group: str = "", group_value: str = "") -> Quantity:
    """A figure with its words from ``TEXTS``.

    Args:
        key: A key of ``TEXTS``.
        estimate: The figure.
        group: What was grouped by.
        group_value: Which group.

    Returns:
        The quantity.
    """
    text = TEXTS[key]
    return Quantity(key, text.name, text.definition, text.source, text.unit, estimate, group, group_value)


TEXTS: dict[str, Text] = {
    "absolute_position_rms": Text(
        "absolute position error, RMS",
        "Root mean square length of t_observed − t_predicted over captures at rest. Predictions come from the "
        "registered gantry, so a constant error of the sensor is not in it.",
        _E2919,
        "m",
    ),
    "absolute_attitude_rms": Text(
        "absolute attitude error, RMS",
        "Root mean square angle of R_observed R_predictedᵀ over captures at rest; a constant error of the sensor is "
        "not in it.",
        _E2919,
        "rad",
    ),
    "position_tolerance_95": Text(
        "position error that 95 % of captures stay below",
        "Smallest observed error below which 95 % of all captures lie with 95 % confidence, by order statistics, every "
        "place counted as one; the lower end is what they exceed with the same confidence. Needs 59 places.",
        "order statistics (Hahn and Meeker, Statistical Intervals, chapter 5)",
        "m",
    ),
    "attitude_tolerance_95": Text(
        "attitude error that 95 % of captures stay below",
        "The same statement for the angle of the attitude error.",
        "order statistics (Hahn and Meeker, Statistical Intervals, chapter 5)",
        "rad",
    ),
    "relative_position_rms": Text(
        "relative position error, RMS",
        "F = (T_ref,i⁻¹ T_ref,j)⁻¹ (T_obs,i⁻¹ T_obs,j) for pairs of places, in beacon axes; root mean square length of "
        "its translation. The camera's place drops out, the beacon's own attitude noise times the distance is in it.",
        _E2919,
        "m",
    ),
    "relative_attitude_rms": Text(
        "relative attitude error, RMS",
        "Root mean square angle of the rotation of the same F.",
        _E2919,
        "rad",
    ),
    "ap_position_median": Text(
        "pose accuracy AP, position, median of places",
        "AP of a place: distance between the barycentre of the captures there and the prediction. Scatter over the "
        "root of the number of captures is in it.",
        _ISO_9283,
        "m",
    ),
    "ap_position_max": Text("pose accuracy AP, position, worst place", "Largest AP of all places.", _ISO_9283, "m"),
    "ap_attitude_max": Text(
        "pose accuracy AP, attitude, worst place",
        "Largest angle of the mean residual rotation of a place.",
        _ISO_9283,
        "rad",
    ),
    "rp_position_median": Text(
        "pose repeatability RP, position, median of places",
        "RP = l̄ + 3 S_l of a place: mean and standard deviation (n − 1) of the distances of its captures from their "
        "barycentre. The standard asks for 30 captures, of 30 approaches.",
        _ISO_9283,
        "m",
    ),
    "rp_position_max": Text(
        "pose repeatability RP, position, worst place", "Largest RP of all places.", _ISO_9283, "m"
    ),
    "rp_attitude_max": Text(
        "pose repeatability RP, attitude, worst place and axis",
        "Largest 3 S of the residual rotation vector's components, over axes and places.",
        _ISO_9283,
        "rad",
    ),
    "vap_position": Text(
        "multi-directional accuracy variation vAP, worst place",
        "Largest distance between the barycentres of captures of one place approached from different directions, "
        "against the prediction of each.",
        _ISO_9283,
        "m",
    ),
    "ad_rms": Text(
        "distance accuracy AD, RMS over pairs",
        "AD = |mean measured distance − distance by the gantry| of two places; root mean square over pairs. It needs "
        "no registration of the camera.",
        _ISO_9283,
        "m",
    ),
    "rd_rms": Text(
        "distance repeatability RD, RMS over pairs",
        "RD = 3 S (n − 1) of the measured distances of two places, k-th capture with k-th capture; root mean square "
        "over pairs.",
        _ISO_9283,
        "m",
    ),
    "drift_position": Text(
        "drift of position over the run",
        "Length of the linear change of the position error with time at places visited again, over the time from the "
        "first to the last capture.",
        "after ISO 9283 (drift dAP), as a straight line",
        "m",
    ),
    "drift_attitude": Text(
        "drift of attitude over the run", "The same for the residual rotation vector.", "as above", "rad"
    ),
    "repeatability_sd": Text(
        "repeatability s_r",
        "Standard deviation per axis (root of a third of the trace) of captures of one place in one run.",
        _ISO_5725,
        "m",
    ),
    "between_runs_sd": Text(
        "between-run standard deviation s_L",
        "Standard deviation per axis of what a run adds to all its captures of a place, s_L² = (MS_between − s_r²)/n, "
        "not below 0.",
        _ISO_5725,
        "m",
    ),
    "reproducibility_sd": Text("reproducibility s_R", "s_R² = s_r² + s_L².", _ISO_5725, "m"),
    "repeatability_limit": Text(
        "repeatability limit r", "2.8 s_r: two captures of one run differ by less in 95 of 100 cases.", _ISO_5725, "m"
    ),
    "reproducibility_limit": Text(
        "reproducibility limit R", "2.8 s_R: the same for captures of two runs.", _ISO_5725, "m"
    ),
    "availability": Text("availability", "Captures with a pose over captures attempted.", "this bench", "1"),
    "false_fix": Text(
        "false-fix rate",
        "Poses published although they are wrong, over poses published. Wrong: squared error over the stated "
        "covariance beyond 39.8 (as rare as 5 sigma), and off by more than 3 % of the range or 10°.",
        "this bench",
        "1",
    ),
    "lag": Text(
        "lag of poses behind their stamps",
        "τ that fits position error = −τ · velocity best over captures in motion, a constant left free; positive: "
        "the pose shows where the beacon was τ before its stamp.",
        "after the idea of ASTM E3124 (latency)",
        "s",
    ),
    "dynamic_position_rms": Text(
        "dynamic position error, RMS",
        "Root mean square position error of captures in motion, the lag in it; intervals over blocks of captures "
        "longer than the errors stay alike.",
        "after ISO 9283 (path accuracy) and ASTM E3064, at the gantry's reference",
        "m",
    ),
    "dynamic_attitude_rms": Text(
        "dynamic attitude error, RMS", "The same for the angle of the attitude error.", "as above", "rad"
    ),
    "two_cluster_position_rms": Text(
        "relative position of two beacons, RMS about its mean",
        "Scatter of T_a⁻¹ T_b of two beacons held rigidly, both seen in one capture: whatever varies is error.",
        _E3064,
        "m",
    ),
    "two_cluster_attitude_rms": Text(
        "relative attitude of two beacons, RMS about its mean",
        "Root mean square angle between R_aᵀ R_b and its mean over SO(3).",
        _E3064,
        "rad",
    ),
    "position_rms": Text("position error, RMS", "Root mean square position error of the group.", "this bench", "m"),
    "attitude_rms": Text("attitude error, RMS", "Root mean square attitude error of the group.", "this bench", "rad"),
}
"""Every quantity by its key."""

LIMITABLE: dict[str, tuple[str, Literal["mm", "deg", "percent", "ms"]]] = {
    "position_tolerance_95_mm": ("position_tolerance_95", "mm"),
    "attitude_tolerance_95_deg": ("attitude_tolerance_95", "deg"),
    "relative_position_rms_mm": ("relative_position_rms", "mm"),
    "relative_attitude_rms_deg": ("relative_attitude_rms", "deg"),
    "ap_position_max_mm": ("ap_position_max", "mm"),
    "rp_position_max_mm": ("rp_position_max", "mm"),
    "vap_position_mm": ("vap_position", "mm"),
    "ad_rms_mm": ("ad_rms", "mm"),
    "drift_position_mm": ("drift_position", "mm"),
    "drift_attitude_deg": ("drift_attitude", "deg"),
    "reproducibility_limit_mm": ("reproducibility_limit", "mm"),
    "false_fix_percent": ("false_fix", "percent"),
    "lag_ms": ("lag", "ms"),
    "dynamic_position_rms_mm": ("dynamic_position_rms", "mm"),
    "dynamic_attitude_rms_deg": ("dynamic_attitude_rms", "deg"),
}
"""Name a limit may have -> key of the quantity, and the limit's unit."""
