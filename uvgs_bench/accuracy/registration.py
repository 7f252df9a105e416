"""Registration: how the frames of a bench sit together, fitted to what sensor and gantry said of the same instants.

The model of every capture is ``camera_from_beacon = left @ G @ right``. With the beacon on the carriage, ``left`` is
camera_from_gantry, ``G`` is gantry_from_carriage and ``right`` is carriage_from_beacon; with the camera on the
carriage, ``left`` is camera_from_carriage, ``G`` is carriage_from_gantry and ``right`` is gantry_from_beacon.

The scale of the sensor is never fitted: it would hide the error one looks for.

Source: M. Shah et al., An overview of robot-sensor calibration methods, 2012 (AX = ZB); T. D. Barfoot, State Estimation
for Robotics, chapters 5 and 7; P. Huber, Robust Statistics, chapter 7.
"""

from __future__ import annotations

from dataclasses import dataclass

from uvgs_bench.accuracy.observations import Mount
from uvgs_bench.geometry import FloatArray, Pose


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """The two constant poses of a bench with their doubt, and what the data could not tell.

    Args:
        mount: Which part rides the carriage.
        left: camera_from_gantry (beacon on the carriage) or camera_from_carriage (camera on the carriage).
        right: carriage_from_beacon (beacon on the carriage) or gantry_from_beacon (camera on the carriage).
        covariance: Covariance of the left tangents (left: omega, v; right: omega, v), shape (12, 12), rad and m, in the
            gauge said; zero along what the gauge holds.
        rank: Number of directions the data see, of 12.
        null_directions: Unseen directions in the same order of parameters, shape (12 - rank, 12), each of unit length
            (1 rad counts as 1 m).
        blind_spots: The unseen directions in words, one line each.
        gauge: How the unseen directions were chosen, one line.
        station_count: Stations with a pose that took part.
        capture_count: Captures with a pose that took part.
        downweighted_count: Captures whose weight the robust loss lowered.
        outlier_count: Captures further than five times the usual distance.
        variance_factor: Scatter of the station means over what one capture's covariance predicts (1 = as predicted; 1/n
            when n captures per station are independent); the covariance is already multiplied with it.
        degrees_of_freedom: Of the variance factor: 6 per station less the rank.
        gantry_sigma_m: Standard deviation per axis assumed for the carriage position, m.
        iterations: Iterations of the least squares.
    """

    mount: Mount
    left: Pose
    right: Pose
    covariance: FloatArray
    rank: int
    null_directions: FloatArray
    blind_spots: tuple[str, ...]
    gauge: str
    station_count: int
    capture_count: int
    downweighted_count: int
    outlier_count: int
    variance_factor: float
    degrees_of_freedom: int
    gantry_sigma_m: float
    iterations: int
