"""Registration: how the frames of a bench sit together, fitted to what sensor and gantry said of the same instants.

The model of every capture is ``camera_from_beacon = left @ G @ right``. With the beacon on the carriage, ``left`` is
camera_from_gantry, ``G`` is gantry_from_carriage and ``right`` is carriage_from_beacon; with the camera on the
carriage, ``left`` is camera_from_carriage, ``G`` is carriage_from_gantry and ``right`` is gantry_from_beacon.

The scale of the sensor is never fitted: it would hide the error one looks for.

Source: M. Shah et al., An overview of robot-sensor calibration methods, 2012 (AX = ZB); T. D. Barfoot, State Estimation
for Robotics, chapters 5 and 7; P. Huber, Robust Statistics, chapter 7.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.bench_model import carriage_motion, predicted, prediction_jacobian
from uvgs_bench.accuracy.bench_terms import TERM_COUNT, AxisTerms, moved_carriage_m, term_jacobian
from uvgs_bench.accuracy.clusters import Estimate
from uvgs_bench.accuracy.distributions import t_quantiles
from uvgs_bench.accuracy.least_squares import LEAST_SIGMA_M, Alignment, usual_distance
from uvgs_bench.accuracy.observability import blind_spots, gauge_transform, in_gauge, mounted_slice
from uvgs_bench.accuracy.observations import Mount, Observations
from uvgs_bench.accuracy.place_scatter import fit_covariance, fit_parts
from uvgs_bench.accuracy.registration_start import start_poses
from uvgs_bench.accuracy.tangent import hats, rotation_logs
from uvgs_bench.accuracy.term_fit import FittedTerms, fit_terms
from uvgs_bench.errors import RegistrationError
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.units import mm_from_m

GANTRY_SIGMA_M = 5e-5
"""Positioning doubt per axis of a good belt or screw gantry, m, used when nothing better is known."""
LEAST_STATIONS = 3
FRAMES_BY_MOUNT: dict[Mount, tuple[tuple[str, str], tuple[str, str]]] = {
    "beacon_on_carriage": (("camera", "gantry"), ("carriage", "beacon")),
    "camera_on_carriage": (("camera", "carriage"), ("gantry", "beacon")),
}
"""Frames of the left and the right pose by mount."""

_LEAST_TRAVEL_M = 1e-5
_LEAST_TURN_RAD = 1e-5
_OUTLIER = 5.0
# Root mean square length of a whitened 6-vector.
_TYPICAL_LENGTH = 6.0**0.5


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
        station_count: Stations with a pose that took part; visits of one place count once.
        capture_count: Captures with a pose that took part.
        downweighted_count: Captures whose weight the robust loss lowered.
        outlier_count: Captures further from the fit than five times the usual distance.
        variance_factor: Scatter of the station means over what one capture's covariance predicts (1 = as predicted; 1/n
            when n captures per station are independent).
        degrees_of_freedom: Of the variance factor: 6 per station less the rank.
        gantry_sigma_m: Standard deviation per axis assumed for the carriage position, m.
        iterations: Iterations of the least squares.
        axis_terms: Scale and squareness of the axes, or None when not asked for or not justified.
        time_offset_s: How much later than mid-exposure the captures are stamped on the gantry's clock, s; or None.
        time_rate: Seconds by which that grows per second; or None.
        term_notes: What became of each term that was asked for, one line each, with the reason.
        terms: Scales x, y, z, shears xy, xz, yz, time offset and its rate as fitted, shape (8,), 1, rad, s, s/s; zero
            where held.
        term_factor: Root of the joint covariance of the 12 parameters and the terms: it is ``F F^T``, shape (20, K);
            empty without terms.
        origin_ns: Instant for which the time offset is quoted, ns.
        sensor_factor: The sensor's part of that scatter, over the variance of one capture; the covariances hold this
            part and the next.
        stopping_sigma_m: The carriage's part: standard deviation per axis of where it stops at a place, m.
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
    axis_terms: AxisTerms | None = None
    time_offset_s: Estimate | None = None
    time_rate: Estimate | None = None
    term_notes: tuple[str, ...] = ()
    terms: FloatArray = field(default_factory=lambda: np.zeros(TERM_COUNT))
    term_factor: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    origin_ns: int = 0
    sensor_factor: float = 1.0
    stopping_sigma_m: float = 0.0

    @property
    def left_covariance(self) -> FloatArray:
        """Covariance of the left tangent of ``left``, shape (6, 6)."""
        return read_only(self.covariance[:6, :6])

    @property
    def right_covariance(self) -> FloatArray:
        """Covariance of the left tangent of ``right``, shape (6, 6)."""
        return read_only(self.covariance[6:, 6:])

    def sigmas(self, part: Literal["left", "right"]) -> tuple[FloatArray, FloatArray]:
        """Standard deviations people can read off a pose.

        Args:
            part: Which of the two poses.

        Returns:
            Rotation about the target frame's axes, shape (3,), rad, and translation (position of the source origin in
            the target frame), shape (3,), m. Zero along what the gauge holds.
        """
        pose, C = (self.left, self.left_covariance) if part == "left" else (self.right, self.right_covariance)
        K = np.concatenate([-hats(pose.t_m[None])[0], np.eye(3)], axis=1)
        return np.sqrt(np.diag(C)[:3]), np.sqrt(np.maximum(np.diag(K @ C @ K.T), 0.0))

    def predict(self, obs: Observations) -> tuple[FloatArray, FloatArray]:
        """Where the beacon should be seen.

        Args:
            obs: Captures; only the gantry's fields are used.

        Returns:
            Rotations (N, 3, 3) and translations (N, 3), m, of camera_from_beacon.
        """
        R_g, t_g = carriage_motion(self._moved(obs))
        return predicted(self.left, self.right, R_g, t_g)

    def prediction_jacobian(self, obs: Observations) -> FloatArray:
        """Derivative of the left tangent of each prediction by the 12 parameters, shape (N, 6, 12)."""
        R_g, t_g = carriage_motion(self._moved(obs))
        return prediction_jacobian(self.left, R_g, t_g)

    def prediction_factor(self, obs: Observations) -> FloatArray:
        """Effect of the registration's doubt on the left tangent of each prediction.

        Args:
            obs: Captures; only the gantry's fields are used.

        Returns:
            Factors F, shape (N, 6, K), rad and m: the covariance is ``F F^T``.
        """
        poses = self.prediction_jacobian(obs)
        if self.term_factor.size == 0:
            values, vectors = np.linalg.eigh(self.covariance)
            # The symmetric root has no arbitrary signs, so factors of similar registrations can be compared.
            return np.asarray(poses @ ((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T))
        by_terms = term_jacobian(obs, self.left, self.terms, self.origin_ns)
        return np.asarray(np.concatenate([poses, by_terms], axis=2) @ self.term_factor)

    def _moved(self, obs: Observations) -> Observations:
        if not np.any(self.terms):
            return obs
        return replace(obs, t_gs_m=moved_carriage_m(obs, self.terms, self.origin_ns))


def fit_registration(
    obs: Observations,
    mask: NDArray[np.bool_] | None = None,
    *,
    gantry_sigma_m: float = GANTRY_SIGMA_M,
    nominal: Pose | None = None,
    terms: tuple[str, ...] = (),
) -> Registration:
    """Fit the two constant poses of a bench by robust least squares on SE(3), with an open gauge.

    Captures of one place share most of their error, so every place counts once however many captures it has: each
    capture's information is divided by the place's number of captures. The level of the doubt is taken from the
    scatter of the means of the places about the fit (variance factor), so it holds for independent and common errors.

    Args:
        obs: Captures of a run.
        mask: Captures to use, shape (N,); all when None. Captures without a pose are left out.
        gantry_sigma_m: Standard deviation per axis of the carriage position, m; added to every capture's covariance.
        nominal: Where what rides the carriage is drawn to in unseen directions: carriage_from_beacon, or
            camera_from_carriage; the identity when None.
        terms: Names of ``TERM_GROUPS`` that may be fitted beside the poses; each is only when the data ask for it.

    Returns:
        The registration.

    Raises:
        RegistrationError: Fewer than 3 stations with a pose, a carriage that did not move, a covariance that is none,
            or no convergence.
    """
    used = obs.is_solved if mask is None else obs.is_solved & mask
    data = obs.select(used)
    places, of_place, captures = np.unique(data.place, return_inverse=True, return_counts=True)
    if len(places) < LEAST_STATIONS:
        raise RegistrationError(
            f"needs at least {LEAST_STATIONS} stations with a pose to register the frames, got {len(places)}"
        )
    R_g, t_g = carriage_motion(data)
    _check_motion(R_g, t_g)
    left_names, right_names = FRAMES_BY_MOUNT[obs.mount]
    chosen = _typical_captures(data, of_place, len(places))
    R_l, t_l, R_r, t_r = start_poses(R_g[chosen], t_g[chosen], data.R_cb[chosen], data.t_cb_m[chosen])
    fit = Alignment(data, 1.0 / captures[of_place].astype(np.float64), gantry_sigma_m)
    left, right, weights, iterations = fit.solve(Pose(R_l, t_l, *left_names), Pose(R_r, t_r, *right_names))
    if nominal is None:
        nominal = Pose.identity(*(right_names if obs.mount == "beacon_on_carriage" else left_names))
    found, origin_ns = None, int(np.median(data.t_ns))
    if terms:
        found, fit, (left, right, weights, more) = fit_terms(
            data, fit, (left, right, weights), terms, of_place, origin_ns
        )
        iterations += more
    left, right, parted, gradient = fit.regauge(left, right, weights, nominal, obs.mount)
    null = parted.null_directions()
    seen = parted.factor()
    moves = prediction_jacobian(left, fit.R_g, fit.t_g) @ seen
    if found is not None:
        by_terms = term_jacobian(data, left, found.values, origin_ns) @ found.directions
        moves = np.concatenate([moves, by_terms], axis=2)
    means = fit.place_means(left, right, weights, of_place, moves)
    factor, parts = fit_parts(means)
    covariance = seen @ fit_covariance(means, parts, parted.rank) @ seen.T
    covariance = in_gauge(covariance, null, gradient, mounted_slice(obs.mount))
    extras: dict[str, Any] = {}
    if found is not None:
        into_gauge = gauge_transform(null, gradient, mounted_slice(obs.mount))
        covariance, extras = _with_terms(found, covariance, into_gauge, origin_ns, data, len(places))
    distance = fit.distances(left, right)
    return Registration(
        mount=obs.mount,
        left=left,
        right=right,
        covariance=read_only(covariance),
        rank=parted.rank,
        null_directions=read_only(null),
        blind_spots=blind_spots(null, left, obs.mount),
        gauge=_gauge_text(len(null), obs.mount),
        station_count=len(places),
        capture_count=data.count,
        downweighted_count=int((weights < 1.0).sum()),
        outlier_count=int((distance > _OUTLIER * _TYPICAL_LENGTH * usual_distance(distance, fit.shares)).sum()),
        variance_factor=factor,
        degrees_of_freedom=means.degrees_of_freedom,
        gantry_sigma_m=gantry_sigma_m,
        iterations=iterations,
        sensor_factor=float(parts[0]),
        stopping_sigma_m=max(gantry_sigma_m, LEAST_SIGMA_M) * float(parts[1]) ** 0.5,
        **extras,
    )


def _with_terms(
    found: FittedTerms,
    covariance: FloatArray,
    into_gauge: FloatArray,
    origin_ns: int,
    data: Observations,
    places: int,
) -> tuple[FloatArray, dict[str, Any]]:
    """Covariance of the poses with the doubt of the terms in it, and the terms as a registration carries them."""
    if not found.taken:
        return covariance, {"term_notes": found.notes}
    of_terms = found.covariance
    response = np.concatenate([into_gauge @ found.pose_response, np.eye(TERM_COUNT)])
    joint = response @ of_terms @ response.T
    joint[:12, :12] += covariance
    values, vectors = np.linalg.eigh(0.5 * (joint + joint.T))
    reach = t_quantiles(0.975, found.degrees_of_freedom)
    sigmas = np.sqrt(np.maximum(np.diag(of_terms), 0.0))

    def estimate(k: int) -> Estimate:
        value, half = float(found.values[k]), float(reach[k] * sigmas[k])
        return Estimate(value, value - half, value + half, places, data.count)

    has_axes = "axis_scale" in found.taken or "squareness" in found.taken
    axes = AxisTerms(
        read_only(found.values[:3]),
        read_only(found.values[3:6]),
        read_only(of_terms[:6, :6]),
        found.held,
        read_only(found.degrees_of_freedom[:6]),
    )
    return np.ascontiguousarray(joint[:12, :12]), {
        "axis_terms": axes if has_axes else None,
        "time_offset_s": estimate(6) if "time_offset" in found.taken else None,
        "time_rate": estimate(7) if "time_rate" in found.taken else None,
        "term_notes": found.notes,
        "terms": found.values,
        "term_factor": read_only(vectors * np.sqrt(np.maximum(values, 0.0))),
        "origin_ns": origin_ns,
    }


def _check_motion(R_g: FloatArray, t_g: FloatArray) -> None:
    travel_m = float(np.linalg.norm(t_g - t_g[0], axis=1).max())
    turn_rad = float(np.linalg.norm(rotation_logs(R_g @ R_g[0].T), axis=1).max())
    if travel_m < _LEAST_TRAVEL_M and turn_rad < _LEAST_TURN_RAD:
        raise RegistrationError(
            "the carriage did not move between the stations: the frames cannot be registered "
            f"(largest travel {mm_from_m(travel_m):.3f} mm)"
        )


def _typical_captures(data: Observations, of_place: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Of each station the capture nearest to its median position, so that a lone wrong pose does not start."""
    order = np.argsort(of_place, kind="stable")
    first = np.searchsorted(of_place[order], np.arange(count + 1))
    chosen = np.empty(count, dtype=np.intp)
    for s in range(count):
        rows = order[first[s] : first[s + 1]]
        if len(rows) > 2:
            t = data.t_cb_m[rows]
            chosen[s] = rows[((t - np.median(t, axis=0)) ** 2).sum(axis=1).argmin()]
        else:
            chosen[s] = rows[0]
    return chosen


def _gauge_text(blind: int, mount: Mount) -> str:
    rider = "beacon" if mount == "beacon_on_carriage" else "camera"
    if blind == 0:
        return "none needed: every direction is seen"
    return (
        f"the {blind} unseen direction{'s are' if blind > 1 else ' is'} held where the {rider}'s pose on the carriage "
        "is nearest to its nominal one; predictions do not depend on this choice"
    )
