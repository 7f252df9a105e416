"""From a run on disk to the plain numbers that are judged."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.devices.gantry.axes import Axis, gantry_from_carriage
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.geometry.se3 import so3_log
from uvgs_bench.sensor.outcome import PoseEstimate

if TYPE_CHECKING:
    from uvgs_bench.store.run_types import Run

# Rates become a velocity by a difference over this, s; a linear axis is exact, a rotary one to 1e-6 of it.
_STEP_S = 1e-3


def observations_from_run(run: Run) -> Observations:
    """Put what the gantry reported and what the sensor answered side by side.

    The carriage is where the nominal axes put it at the reported position, not at the commanded one.

    Args:
        run: A run, finished or not.

    Returns:
        One row per sample, in the order of taking; rows of a miss hold NaN in the sensor's fields.
    """
    samples = run.samples
    N, A = len(samples), len(run.manifest.axes)
    R_gs, t_gs = np.empty((N, 3, 3)), np.empty((N, 3))
    R_cb, t_cb, covariance = np.full((N, 3, 3), np.nan), np.full((N, 3), np.nan), np.full((N, 6, 6), np.nan)
    by_beacon, by_lens = np.full((N, 6, 6), np.nan), np.full((N, 6, 6), np.nan)
    rms_px, exposure_s = np.full(N, np.nan), np.full(N, np.nan)
    velocity, turn = np.zeros((N, 3)), np.zeros((N, 3))
    led_px = np.full((N, len(run.beacon.leds), 2), np.nan)
    known: dict[bytes, Pose] = {}
    for i, sample in enumerate(samples):
        at = sample.position.tobytes()
        if at not in known:
            known[at] = gantry_from_carriage(run.manifest.axes, sample.position)
        R_gs[i], t_gs[i] = known[at].R, known[at].t_m
        if sample.is_moving:
            velocity[i], turn[i] = _carriage_rates(run.manifest.axes, sample.position, sample.velocity)
        if sample.exposure_s is not None:
            exposure_s[i] = sample.exposure_s
        seen = sample.outcome.led_px
        # Of a group only the pose is in the frame of the run's beacon; the lights are those of another one.
        is_own = not run.has_several_beacons or sample.outcome.beacon == run.beacon.name
        if seen is not None and is_own and seen.shape == led_px.shape[1:]:
            led_px[i] = seen
        if isinstance(sample.outcome, PoseEstimate):
            R_cb[i] = sample.outcome.camera_from_beacon.R
            t_cb[i] = sample.outcome.camera_from_beacon.t_m
            covariance[i] = sample.outcome.covariance
            rms_px[i] = sample.outcome.rms_px
            if sample.outcome.beacon_covariance is not None:
                by_beacon[i] = sample.outcome.beacon_covariance
            if sample.outcome.calibration_covariance is not None:
                by_lens[i] = sample.outcome.calibration_covariance
    return Observations(
        station=np.array([sample.station for sample in samples], dtype=np.int64),
        role=tuple(sample.role for sample in samples),
        t_ns=np.array([sample.t_ns for sample in samples], dtype=np.int64),
        axis_position=_stacked([sample.position for sample in samples], A),
        R_gs=read_only(R_gs),
        t_gs_m=read_only(t_gs),
        R_cb=read_only(R_cb),
        t_cb_m=read_only(t_cb),
        covariance=read_only(covariance),
        is_solved=np.array([sample.is_solved for sample in samples], dtype=np.bool_),
        reason=tuple(sample.reason for sample in samples),
        mount=run.manifest.mount,
        velocity_gs_mps=read_only(velocity),
        turn_gs_radps=read_only(turn),
        place=np.array([sample.waypoint for sample in samples], dtype=np.int64),
        approach=_approaches(run),
        exposure_s=read_only(exposure_s),
        is_saturated=np.array([bool(sample.clipped_leds) for sample in samples], dtype=np.bool_),
        led_px=read_only(led_px),
        rms_px=read_only(rms_px),
        blob_count=np.array([sample.outcome.blob_count for sample in samples], dtype=np.int64),
        beacon_covariance=read_only(by_beacon),
        calibration_covariance=read_only(by_lens),
    )


def _carriage_rates(axes: Sequence[Axis], position: FloatArray, rates: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Velocity (3,), m/s, and angular velocity (3,), rad/s, of the carriage in gantry axes for rates of the axes."""
    before = gantry_from_carriage(axes, position - _STEP_S * rates)
    after = gantry_from_carriage(axes, position + _STEP_S * rates)
    return (after.t_m - before.t_m) / (2.0 * _STEP_S), so3_log(after.R @ before.R.T) / (2.0 * _STEP_S)


def _approaches(run: Run) -> NDArray[np.int8]:
    """Sign of the last motion of each axis before each capture, shape (N, A); 0 where nobody knows."""
    out = np.zeros((len(run.samples), len(run.manifest.axes)), dtype=np.int8)
    if run.manifest.approach in ("from_below", "from_above"):
        out[:] = 1 if run.manifest.approach == "from_below" else -1
    elif run.manifest.approach == "none":
        for i, sample in enumerate(run.samples[1:], start=1):
            before = run.samples[i - 1]
            moved = np.sign(sample.target - before.target).astype(np.int8)
            # An axis that stayed keeps the side it came from; a seam may hide a move, so nothing is known after it.
            seam = any(seam.first_index == sample.index for seam in run.seams)
            out[i] = np.where(moved != 0, moved, 0 if seam else out[i - 1])
    for i, sample in enumerate(run.samples):
        if sample.is_moving:
            out[i] = np.sign(sample.velocity)
    return out


def _stacked(rows: list[FloatArray], width: int) -> FloatArray:
    return read_only(np.array(rows, dtype=np.float64).reshape(len(rows), width))
