"""Robust least squares on SE(3) for the two constant poses of a bench, with directions the data may not see.

Source: T. D. Barfoot, State Estimation for Robotics, chapters 5 and 7; P. Huber, Robust Statistics, chapter 7.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.bench_model import (
    carriage_motion,
    gantry_covariance,
    pose_residuals,
    predicted,
    prediction_jacobian,
    residual_jacobian,
)
from uvgs_bench.accuracy.observability import Information, gauge_gradient, mounted_slice, part_information
from uvgs_bench.accuracy.observations import Mount, Observations
from uvgs_bench.accuracy.place_scatter import Groups, PlaceMeans, crossed
from uvgs_bench.errors import RegistrationError
from uvgs_bench.geometry import FloatArray, Pose

LEAST_SIGMA_M = 1e-6
"""No carriage stops better than this, m."""
_MOST_ITERATIONS = 100
_SCALE_ITERATIONS = 20
_SCALE_SETTLED = 1e-8
# A step of a millionth of a standard deviation, squared.
_STILL = 1e-12
# Steps of rounding size, in rad and working distances.
_LEAST_STEP = 1e-12
# Roots of the chi-squared distribution with 6 degrees of freedom at 95 % and at 50 %.
_HUBER = 3.548
_MEDIAN_DISTANCE = 2.3126


class Alignment:
    """The least squares of one set of captures.

    Args:
        data: Captures, all with a pose.
        shares: Share of each capture in its place, shape (N,), summing to one per place.
        gantry_sigma_m: Standard deviation per axis of the carriage position, m.

    Raises:
        RegistrationError: A covariance that is not positive definite.
    """

    def __init__(self, data: Observations, shares: FloatArray, gantry_sigma_m: float) -> None:
        self.data, self.shares, self.gantry_sigma_m = data, shares, gantry_sigma_m
        self.R_g, self.t_g = carriage_motion(data)
        self.whitening = _whitening(data, gantry_sigma_m)
        self.length_m = max(float(np.median(np.linalg.norm(data.t_cb_m, axis=1))), 1e-6)

    def solve(self, left: Pose, right: Pose) -> tuple[Pose, Pose, FloatArray, int]:
        """Levenberg-Marquardt with Huber weights; steps stay within what the data see.

        Args:
            left: First guess of the left pose.
            right: First guess of the right pose.

        Returns:
            Left pose, right pose, weights of the robust loss (N,), number of iterations.

        Raises:
            RegistrationError: No convergence.
        """
        damping = 0.0
        scale = 0.0
        is_settled = False
        e = self.residuals(left, right)
        for iteration in range(1, _MOST_ITERATIONS + 1):
            residual, J = self._linearised(left, e)
            distance = np.linalg.norm(residual, axis=1)
            # Weights and scale that chase each other need not settle: the scale stops following after a while.
            if not is_settled:
                followed = usual_distance(distance, self.shares)
                is_settled = abs(followed - scale) <= _SCALE_SETTLED * scale or iteration >= _SCALE_ITERATIONS
                scale = followed
            weights = np.minimum(1.0, _HUBER * scale / np.maximum(distance, 1e-300))
            w = self.shares * weights
            weighted = J * w[:, None, None]
            H = crossed(weighted, J)
            g = np.einsum("nki,nk->i", weighted, residual)
            parted = part_information(H, self.length_m)
            cost = self._cost(distance, scale)
            while True:
                along = parted.seen.T @ (parted.scale * g)
                step = parted.scale * (parted.seen @ (-along / (parted.values * (1.0 + damping))))
                trial = left.perturbed(step[:6]), right.perturbed(step[6:])
                e = self.residuals(*trial)
                new_cost = self._cost(self._lengths(e), scale)
                if new_cost <= cost * (1.0 + 1e-9) + 1e-300 or damping > 1e9:
                    break
                damping = max(4.0 * damping, 1e-3)
            gain = float(step @ H @ step)
            left, right = trial
            damping = damping / 8.0 if damping > 1e-6 else 0.0
            is_still = gain <= _STILL * scale**2 or float(np.abs(step / parted.scale).max()) < _LEAST_STEP
            if is_settled and is_still:
                return left, right, weights, iteration
        raise RegistrationError(f"the registration did not converge in {_MOST_ITERATIONS} iterations")

    def residuals(self, left: Pose, right: Pose) -> FloatArray:
        """Residual of each capture, left tangents, shape (N, 6), rad and m."""
        return pose_residuals(self.data, *predicted(left, right, self.R_g, self.t_g))

    def distances(self, left: Pose, right: Pose) -> FloatArray:
        """Whitened length of each residual, shape (N,)."""
        return self._lengths(self.residuals(left, right))

    def _lengths(self, e: FloatArray) -> FloatArray:
        length: FloatArray = np.linalg.norm((self.whitening @ e[:, :, None])[:, :, 0], axis=1)
        return length

    def _linearised(self, left: Pose, e: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Whitened residuals (N, 6) and their derivatives (N, 6, 12) by the left tangents of both poses."""
        J = residual_jacobian(e, prediction_jacobian(left, self.R_g, self.t_g))
        return (self.whitening @ e[:, :, None])[:, :, 0], self.whitening @ J

    def _cost(self, distance: FloatArray, scale: float) -> float:
        knee = _HUBER * scale
        each = np.where(distance <= knee, 0.5 * distance**2, knee * (distance - 0.5 * knee))
        return float(self.shares @ each)

    def information(self, left: Pose, right: Pose, weights: FloatArray) -> Information:
        """Information at a solution."""
        _, J = self._linearised(left, self.residuals(left, right))
        return part_information(crossed(J * (self.shares * weights)[:, None, None], J), self.length_m)

    def regauge(
        self, left: Pose, right: Pose, weights: FloatArray, nominal: Pose, mount: Mount
    ) -> tuple[Pose, Pose, Information, FloatArray]:
        """Slide along unseen directions until the mounted part is nearest to its nominal pose."""
        mounted = mounted_slice(mount)
        for _ in range(_MOST_ITERATIONS):
            parted = self.information(left, right, weights)
            part = right if mount == "beacon_on_carriage" else left
            deviation, gradient = gauge_gradient(part, nominal, self.length_m)
            null = parted.null_directions()
            if len(null) == 0:
                break
            amount = np.linalg.lstsq(gradient @ null[:, mounted].T, -deviation, rcond=None)[0]
            # A long slide along a rotation is cut so that the linear step stays good.
            size = float(np.linalg.norm(amount @ (null / parted.scale)))
            if size < 1e-12:
                break
            step = amount @ null * min(1.0, 0.5 / size)
            left, right = left.perturbed(step[:6]), right.perturbed(step[6:])
        return left, right, parted, gradient

    def place_means(
        self, left: Pose, right: Pose, weights: FloatArray, of_place: NDArray[np.intp], moves: FloatArray
    ) -> PlaceMeans:
        """Means of the places at a solution, and how they would scatter by what is stated.

        Args:
            left: The left pose.
            right: The right pose.
            weights: Weights of the robust loss, shape (N,); a place that is not believed scatters more.
            of_place: Running number of each capture's place, shape (N,).
            moves: Derivative of the left tangent of each prediction by the fitted directions, shape (N, 6, r).

        Returns:
            The means; parts are the sensor's and the carriage's.
        """
        e = self.residuals(left, right)
        columns = residual_jacobian(e, moves)
        w = self.shares * weights
        P_inverse = self.whitening.transpose(0, 2, 1) @ (self.whitening * w[:, None, None])
        grouped = Groups.of(of_place)
        information = grouped.sums(P_inverse)
        # Robust weights are ratios; a place without captures of full weight is known that much less.
        trust = grouped.sums(w)[:, None, None]
        stated = grouped.sums(self.data.covariance * self.shares[:, None, None]) / trust
        visits = np.unique(np.column_stack([of_place, self.data.station]), axis=0)[:, 0]
        often = np.bincount(visits, minlength=grouped.count)[:, None, None]
        stopping = gantry_covariance(max(self.gantry_sigma_m, LEAST_SIGMA_M)) / (often * trust)
        return PlaceMeans(
            residual=_solved(information, grouped.sums(np.einsum("nij,nj->ni", P_inverse, e))[:, :, None])[:, :, 0],
            design=_solved(information, grouped.sums(P_inverse @ columns)),
            information=information,
            parts=np.stack([stated, stopping]),
        )

    def scatter_of(self, e: FloatArray, weights: FloatArray, of_place: NDArray[np.intp]) -> float:
        """Sum over places of the squared whitened mean of residuals, shape (N, 6), rad and m."""
        w = (self.shares * weights)[:, None, None]
        P_inverse = self.whitening.transpose(0, 2, 1) @ (self.whitening * w)
        grouped = Groups.of(of_place)
        info, pull = grouped.sums(P_inverse), grouped.sums(np.einsum("nij,nj->ni", P_inverse, e))
        return float(np.einsum("si,si->", pull, np.linalg.solve(info, pull[:, :, None])[:, :, 0]))


def usual_distance(distance: FloatArray, shares: FloatArray) -> float:
    """Robust scale of whitened 6-vectors: 1 when covariances are right.

    Args:
        distance: Lengths, shape (N,).
        shares: Share of each capture in its place, shape (N,): places, not captures, have a say in what is usual.

    Returns:
        Weighted median over the median expected.
    """
    order = np.argsort(distance)
    reached = np.cumsum(shares[order])
    middle = float(distance[order[int(np.searchsorted(reached, 0.5 * reached[-1]))]])
    return max(middle / _MEDIAN_DISTANCE, 1e-9)


def _whitening(data: Observations, gantry_sigma_m: float) -> FloatArray:
    """Matrices that whiten each capture's residual, shape (N, 6, 6)."""
    total = data.covariance + gantry_covariance(gantry_sigma_m)
    try:
        if not np.isfinite(total).all():
            raise np.linalg.LinAlgError
        return np.linalg.inv(np.linalg.cholesky(total))
    except np.linalg.LinAlgError:
        raise RegistrationError("a pose has a covariance that is not positive definite") from None


def _solved(matrices: FloatArray, columns: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.solve(matrices, columns), dtype=np.float64)
