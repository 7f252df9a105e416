"""Errors of every capture against the registered gantry, in camera axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.bench_model import gantry_covariance, pose_residuals
from uvgs_bench.accuracy.observations import Observations, Role
from uvgs_bench.accuracy.registration import Registration
from uvgs_bench.accuracy.tangent import hats, rotation_logs
from uvgs_bench.accuracy.time_blocks import independent_parts
from uvgs_bench.geometry import FloatArray, read_only


@dataclass(frozen=True, slots=True, eq=False)
class ErrorTable:
    """N captures as a struct of arrays, misses included. Errors of a miss are NaN; predictions never are.

    Args:
        station: Station of each capture, shape (N,).
        place: Place of each capture, shape (N,): stations that revisit a place count as one in every interval; for
            captures in motion the block of time instead, a negative number, once ``in_blocks`` has found them.
        role: Role of each capture's station, length N.
        t_ns: Instants, shape (N,), ns.
        axis_position: Reported machine positions, shape (N, A), m or rad.
        is_solved: Whether there is a pose, shape (N,).
        reason: ``stage/reason`` of each miss, empty for a pose, length N.
        predicted_R: Rotation of the predicted camera_from_beacon, shape (N, 3, 3).
        predicted_t_m: Translation of the predicted camera_from_beacon, shape (N, 3), m.
        translation_error_m: ``t_observed - t_predicted`` in camera axes, shape (N, 3), m: lateral x, y, depth z.
        rotation_error_rad: ``Log(R_observed R_predicted^T)`` in camera axes, shape (N, 3), rad: tilt x, tilt y, roll z.
        range_m: Predicted distance from the optical centre to the beacon origin, shape (N,), m.
        field_angle_rad: Predicted angle between the optical axis and the line to the beacon, shape (N,), rad.
        view_angle_rad: Predicted angle between the beacon's z axis and the line of sight, shape (N,), rad.
        nees: Squared error over the predicted covariance (sensor, gantry and registration), shape (N,), 6 on average.
        registration_factor: Effect of the registration's own doubt on (rotation error, translation error), shape
            (N, 6, K), rad and m: its covariance is ``F F^T``; K is 12, or 20 when terms were fitted beside the poses.
        is_moving: Whether the carriage moved or turned at the capture, shape (N,).
        session: Which of several repeated runs it comes from, shape (N,).
    """

    station: NDArray[np.int64]
    place: NDArray[np.int64]
    role: tuple[Role, ...]
    t_ns: NDArray[np.int64]
    axis_position: FloatArray
    is_solved: NDArray[np.bool_]
    reason: tuple[str, ...]
    predicted_R: FloatArray
    predicted_t_m: FloatArray
    translation_error_m: FloatArray
    rotation_error_rad: FloatArray
    range_m: FloatArray
    field_angle_rad: FloatArray
    view_angle_rad: FloatArray
    nees: FloatArray
    registration_factor: FloatArray
    is_moving: NDArray[np.bool_]
    session: NDArray[np.int64]

    @property
    def count(self) -> int:
        """Number of captures, misses included."""
        return len(self.station)

    @property
    def position_error_m(self) -> FloatArray:
        """Length of the translation error, shape (N,), m."""
        length: FloatArray = np.linalg.norm(self.translation_error_m, axis=1)
        return length

    @property
    def lateral_error_m(self) -> FloatArray:
        """Length of the error across the optical axis, shape (N,), m."""
        length: FloatArray = np.linalg.norm(self.translation_error_m[:, :2], axis=1)
        return length

    @property
    def depth_error_m(self) -> FloatArray:
        """Signed error along the optical axis, shape (N,), m; positive = seen too far."""
        depth: FloatArray = self.translation_error_m[:, 2]
        return depth

    @property
    def attitude_error_rad(self) -> FloatArray:
        """Angle of the rotation error, shape (N,), rad."""
        angle: FloatArray = np.linalg.norm(self.rotation_error_rad, axis=1)
        return angle

    @property
    def registration_sigma_m(self) -> FloatArray:
        """Registration's share of the position error of each capture (root of the trace), shape (N,), m."""
        share: FloatArray = np.sqrt((self.registration_factor[:, 3:] ** 2).sum(axis=(1, 2)))
        return share

    @property
    def registration_sigma_rad(self) -> FloatArray:
        """Registration's share of the attitude error of each capture (root of the trace), shape (N,), rad."""
        share: FloatArray = np.sqrt((self.registration_factor[:, :3] ** 2).sum(axis=(1, 2)))
        return share

    def select(self, mask: NDArray[np.bool_]) -> ErrorTable:
        """The captures where the mask is True, in the same order."""
        chosen = np.flatnonzero(mask)
        return ErrorTable(
            station=self.station[chosen],
            place=self.place[chosen],
            role=tuple(self.role[i] for i in chosen),
            t_ns=self.t_ns[chosen],
            axis_position=self.axis_position[chosen],
            is_solved=self.is_solved[chosen],
            reason=tuple(self.reason[i] for i in chosen),
            predicted_R=self.predicted_R[chosen],
            predicted_t_m=self.predicted_t_m[chosen],
            translation_error_m=self.translation_error_m[chosen],
            rotation_error_rad=self.rotation_error_rad[chosen],
            range_m=self.range_m[chosen],
            field_angle_rad=self.field_angle_rad[chosen],
            view_angle_rad=self.view_angle_rad[chosen],
            nees=self.nees[chosen],
            registration_factor=self.registration_factor[chosen],
            is_moving=self.is_moving[chosen],
            session=self.session[chosen],
        )

    def in_blocks(self) -> ErrorTable:
        """The same errors with captures in motion parted into blocks of time that are independent of one another."""
        errors = np.column_stack([self.rotation_error_rad, self.translation_error_m])
        return replace(self, place=independent_parts(self.place, self.is_moving, self.t_ns, self.session, errors))


def error_table(obs: Observations, registration: Registration) -> ErrorTable:
    """Compare every capture with what the registered gantry predicts.

    Args:
        obs: Captures, misses included.
        registration: The registration; fitted on other stations when the errors shall be honest.

    Returns:
        The errors in the order of the captures.
    """
    N = obs.count
    R, t = registration.predict(obs)
    solved = obs.select(obs.is_solved)
    R_s, t_s = R[obs.is_solved], t[obs.is_solved]
    shift, turn, nees = np.full((N, 3), np.nan), np.full((N, 3), np.nan), np.full(N, np.nan)
    shift[obs.is_solved] = solved.t_cb_m - t_s
    turn[obs.is_solved] = rotation_logs(solved.R_cb @ R_s.transpose(0, 2, 1))

    tangent_factor = registration.prediction_factor(obs)
    # Left tangent to translation in camera axes: dt = v + omega x t.
    factor = tangent_factor.copy()
    factor[:, 3:] -= hats(t) @ tangent_factor[:, :3]

    doubt = solved.covariance + gantry_covariance(registration.gantry_sigma_m)
    own = tangent_factor[obs.is_solved]
    doubt = doubt + own @ own.transpose(0, 2, 1)
    e = pose_residuals(solved, R_s, t_s)
    nees[obs.is_solved] = np.einsum("ni,ni->n", e, np.linalg.solve(doubt, e[:, :, None])[:, :, 0])

    range_m = np.linalg.norm(t, axis=1)
    sight = t / np.maximum(range_m, 1e-12)[:, None]
    beacon_z = R[:, :, 2]
    view = np.arctan2(np.linalg.norm(np.cross(beacon_z, sight), axis=1), np.einsum("ni,ni->n", beacon_z, sight))
    return ErrorTable(
        station=obs.station,
        place=obs.place,
        role=obs.role,
        t_ns=obs.t_ns,
        axis_position=obs.axis_position,
        is_solved=obs.is_solved,
        reason=obs.reason,
        predicted_R=read_only(R),
        predicted_t_m=read_only(t),
        translation_error_m=read_only(shift),
        rotation_error_rad=read_only(turn),
        range_m=read_only(range_m),
        field_angle_rad=read_only(np.arctan2(np.linalg.norm(t[:, :2], axis=1), t[:, 2])),
        view_angle_rad=read_only(view),
        nees=read_only(nees),
        registration_factor=read_only(factor),
        is_moving=obs.is_moving,
        session=obs.session,
    )


def concatenated(parts: Sequence[ErrorTable], rows: Sequence[NDArray[np.intp]]) -> ErrorTable:
    """Put tables of different captures together, in a wanted order.

    The doubts of different registrations are taken as one and the same draw: the cautious reading for folds that share
    most of their stations.

    Args:
        parts: At least one table.
        rows: Where the captures of each part go, together a permutation.

    Returns:
        One table.
    """
    order = np.argsort(np.concatenate(rows))
    # A fold may have taken up terms that another left.
    columns = max(part.registration_factor.shape[2] for part in parts)
    parts = [
        replace(
            part,
            registration_factor=np.pad(
                part.registration_factor, ((0, 0), (0, 0), (0, columns - part.registration_factor.shape[2]))
            ),
        )
        for part in parts
    ]
    joined = {
        name: np.concatenate([getattr(part, name) for part in parts])[order]
        for name in ErrorTable.__dataclass_fields__
        if name not in ("role", "reason")
    }
    roles = [role for part in parts for role in part.role]
    reasons = [reason for part in parts for reason in part.reason]
    return ErrorTable(
        **joined,
        role=tuple(roles[i] for i in order),
        reason=tuple(reasons[i] for i in order),
    )
