"""What is judged: for every capture, where the gantry says the carriage was and what the sensor answered."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray

Mount = Literal["beacon_on_carriage", "camera_on_carriage"]
Role = Literal["register", "judge"]


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """N captures of one run as a struct of arrays. Rows of a miss hold NaN in the sensor's fields.

    Args:
        station: Station of each capture, shape (N,). Captures of one station share the carriage position.
        role: Role of each capture's station, length N.
        t_ns: Instants, shape (N,), ns.
        axis_position: Reported machine positions, shape (N, A), m or rad.
        R_gs: Rotation of gantry_from_carriage by nominal axes, shape (N, 3, 3).
        t_gs_m: Translation of gantry_from_carriage by nominal axes, shape (N, 3), m.
        R_cb: Rotation of camera_from_beacon, shape (N, 3, 3).
        t_cb_m: Translation of camera_from_beacon, shape (N, 3), m.
        covariance: Covariance of the left tangent (omega, v) in camera axes, shape (N, 6, 6), rad and m.
        is_solved: Whether there is a pose, shape (N,).
        reason: ``stage/reason`` of each miss, empty for a pose, length N.
        mount: Which part rides the carriage.
        place: Waypoint of each capture, shape (N,): stations that revisit a place share its systematic errors, so they
            are one when doubts are computed; the station itself when empty.
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
    place: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    def __post_init__(self) -> None:
        if len(self.place) == 0:
            object.__setattr__(self, "place", self.station)

    @property
    def count(self) -> int:
        """Number of captures, misses included."""
        return len(self.station)

    def select(self, mask: NDArray[np.bool_]) -> Observations:
        """The captures where the mask is True, in the same order."""
        chosen = np.flatnonzero(mask)
        return Observations(
            station=self.station[chosen],
            role=tuple(self.role[i] for i in chosen),
            t_ns=self.t_ns[chosen],
            axis_position=self.axis_position[chosen],
            R_gs=self.R_gs[chosen],
            t_gs_m=self.t_gs_m[chosen],
            R_cb=self.R_cb[chosen],
            t_cb_m=self.t_cb_m[chosen],
            covariance=self.covariance[chosen],
            is_solved=self.is_solved[chosen],
            reason=tuple(self.reason[i] for i in chosen),
            mount=self.mount,
            place=self.place[chosen],
        )

    def has_role(self, role: Role) -> NDArray[np.bool_]:
        """Mask of the captures whose station has a role, shape (N,)."""
        return np.array([r == role for r in self.role], dtype=np.bool_)
