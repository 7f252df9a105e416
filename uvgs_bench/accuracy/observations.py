"""What is judged: for every capture, where the gantry says the carriage was and what the sensor answered."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray, read_only

Mount = Literal["beacon_on_carriage", "camera_on_carriage"]
Role = Literal["register", "judge"]

REST_MPS, REST_RADPS = 1e-4, 1e-3
"""A carriage slower than both is at rest, m/s and rad/s."""


def _no_integers() -> NDArray[np.int64]:
    return np.empty(0, dtype=np.int64)


def _no_floats() -> FloatArray:
    return np.empty(0)


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """N captures of one run as a struct of arrays. Rows of a miss hold NaN in the sensor's fields.

    Fields with a default may be left empty; they are then filled with what says nothing.

    Args:
        station: Station of each capture, shape (N,). Captures of one station share the carriage position.
        role: Role of each capture's station, length N.
        t_ns: Instants, shape (N,), ns.
        axis_position: Reported machine positions, shape (N, A), m or rad.
        R_gs: Rotation of gantry_from_carriage by nominal axes, shape (N, 3, 3).
        t_gs_m: Translation of gantry_from_carriage by nominal axes, shape (N, 3), m.
        R_cb: Rotation of camera_from_beacon, shape (N, 3, 3).
        t_cb_m: Translation of camera_from_beacon, shape (N, 3), m.
        covariance: Covariance of the left tangent (omega, v) in camera axes, shape (N, 6, 6), rad and m: noise and LED
            positions, without the lens.
        is_solved: Whether there is a pose, shape (N,).
        reason: ``stage/reason`` of each miss, empty for a pose, length N.
        mount: Which part rides the carriage.
        place: Waypoint of each capture, shape (N,): stations that revisit a place share its systematic errors, so they
            are one when doubts are computed; the station itself when empty.
        velocity_gs_mps: Velocity of the carriage in gantry axes at the capture, shape (N, 3), m/s; at rest when empty.
        turn_gs_radps: Angular velocity of the carriage, likewise, shape (N, 3), rad/s.
        approach: Sign of the last motion of each axis before the capture, shape (N, A); 0 where it is not known.
        session: Which of several repeated runs a capture comes from, shape (N,).
        exposure_s: Exposure, shape (N,), s; NaN where it is not known.
        is_saturated: Whether an LED of the capture was clipped, shape (N,).
        rms_px: Root mean square of the sensor's own residual, shape (N,), px; NaN where it is not known.
        blob_count: Candidate spots of the capture, shape (N,); 0 where it is not known.
        beacon_covariance: The part of ``covariance`` from the LED positions, the same error in every capture, shape
            (N, 6, 6), rad and m; NaN where it was not stated.
        calibration_covariance: What the doubt of the lens adds to ``covariance``, the same error in every capture,
            shape (N, 6, 6), rad and m; NaN where it was not stated.
        led_px: Where each LED of the beacon was seen, also in fits that were refused, shape (N, L, 2), px; NaN where
            it was not, and L = 0 where that is not known.
    """

    station: NDArray[np.int64]
    role: tuple[Role, ...]
    t_ns: NDArray[np.int64]
    axis_position: FloatArray
    R_gs: FloatArray
    t_gs_m: FloatArray
    R_cb: FloatArray
    t_cb_m: FloatArray
    covariance: FloatArray
    is_solved: NDArray[np.bool_]
    reason: tuple[str, ...]
    mount: Mount = "beacon_on_carriage"
    place: NDArray[np.int64] = field(default_factory=_no_integers)
    velocity_gs_mps: FloatArray = field(default_factory=_no_floats)
    turn_gs_radps: FloatArray = field(default_factory=_no_floats)
    approach: NDArray[np.int8] = field(default_factory=lambda: np.empty(0, dtype=np.int8))
    session: NDArray[np.int64] = field(default_factory=_no_integers)
    exposure_s: FloatArray = field(default_factory=_no_floats)
    is_saturated: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    rms_px: FloatArray = field(default_factory=_no_floats)
    blob_count: NDArray[np.int64] = field(default_factory=_no_integers)
    beacon_covariance: FloatArray = field(default_factory=_no_floats)
    calibration_covariance: FloatArray = field(default_factory=_no_floats)
    led_px: FloatArray = field(default_factory=_no_floats)

    def __post_init__(self) -> None:
        N = len(self.station)
        neutral: dict[str, NDArray[Any]] = {
            "place": self.station,
            "velocity_gs_mps": np.broadcast_to(0.0, (N, 3)),
            "turn_gs_radps": np.broadcast_to(0.0, (N, 3)),
            "approach": np.broadcast_to(np.int8(0), self.axis_position.shape),
            "session": np.broadcast_to(np.int64(0), (N,)),
            "exposure_s": np.broadcast_to(np.nan, (N,)),
            "is_saturated": np.broadcast_to(np.False_, (N,)),
            "rms_px": np.broadcast_to(np.nan, (N,)),
            "blob_count": np.broadcast_to(np.int64(0), (N,)),
            "beacon_covariance": np.broadcast_to(np.nan, (N, 6, 6)),
            "calibration_covariance": np.broadcast_to(np.nan, (N, 6, 6)),
            "led_px": np.broadcast_to(np.nan, (N, 0, 2)),
        }
        for name, values in neutral.items():
            if len(getattr(self, name)) == 0 and N:
                object.__setattr__(self, name, values)

    @property
    def count(self) -> int:
        """Number of captures, misses included."""
        return len(self.station)

    @property
    def is_moving(self) -> NDArray[np.bool_]:
        """Whether the carriage moved or turned at the capture, shape (N,)."""
        is_fast = np.linalg.norm(self.velocity_gs_mps, axis=1) > REST_MPS
        return np.asarray(is_fast | (np.linalg.norm(self.turn_gs_radps, axis=1) > REST_RADPS))

    @property
    def noise_covariance(self) -> FloatArray:
        """The part of ``covariance`` that is drawn anew in every capture, shape (N, 6, 6), rad and m."""
        return read_only(self.covariance - np.nan_to_num(self.beacon_covariance, nan=0.0))

    @property
    def common_covariance(self) -> FloatArray:
        """What LED positions and lens add as the same error in every capture, shape (N, 6, 6), rad and m.

        Zero where neither was stated.
        """
        return read_only(
            np.nan_to_num(self.beacon_covariance, nan=0.0) + np.nan_to_num(self.calibration_covariance, nan=0.0)
        )

    def select(self, mask: NDArray[np.bool_]) -> Observations:
        """The captures where the mask is True, in the same order."""
        chosen = np.flatnonzero(mask)
        fields: dict[str, Any] = {
            name: getattr(self, name)[chosen]
            for name in Observations.__dataclass_fields__
            if name not in ("role", "reason", "mount")
        }
        return Observations(
            **fields,
            role=tuple(self.role[i] for i in chosen),
            reason=tuple(self.reason[i] for i in chosen),
            mount=self.mount,
        )

    def has_role(self, role: Role) -> NDArray[np.bool_]:
        """Mask of the captures whose station has a role, shape (N,)."""
        return np.array([r == role for r in self.role], dtype=np.bool_)
