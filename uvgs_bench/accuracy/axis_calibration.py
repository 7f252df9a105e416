"""Scale and squareness of the linear axes, from pictures of a board that the axes carry.

The board turns with nothing, so all pictures share one attitude, and where it stands is a linear function of the axis
positions: three scales and three shears, as far as there are axes. All corners of all pictures are fitted at once.
What can hide in the result: an error of the board's own size is an error of every scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from uvgs_bench.accuracy.distributions import f_tail
from uvgs_bench.accuracy.observations import Mount
from uvgs_bench.camera.boards import BoardView
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.lens import Lens
from uvgs_bench.errors import RegistrationError
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.geometry.se3 import hat, mean_rotation, so3_exp

_ITERATIONS = 30
_FEWEST_VIEWS = 8
_REWEIGHTINGS = 2
_STEP = 1e-6
# Range in which the scatter of places is looked for, as shares of that of corners, m/px.
_TINIEST, _LARGEST = 1e-8, 1e-1
_EXACT_PX2 = 1e-16
# Of half the way along an axis: places nearer than this are one.
_APART = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class AxisErrors:
    """How the linear axes differ from what the bench file says.

    Args:
        scale: Relative excess of travel of each linear axis, shape (L,), 1.
        shear_rad: How far each pair of axes leans together (less than a right angle), in the order 1-2, 1-3, 2-3,
            shape (P,), rad: the later axis leans towards the earlier.
        covariance: Covariance of scales and shears, shape (L + P, L + P), 1 and rad; doubts of corners, of the places
            themselves, of the lens, and of the board's size are in it.
        rms_px: Root mean square of the corners' residuals, px.
        view_count: Number of pictures.
        place_sigma_m: Scatter of the places about the fit along each linear axis, shape (L,), m: what the axes do not
            repeat, and the pictures' own scatter.
        bend_m: Largest deviation of each axis from a constant scale, as a polynomial of third order (second where only
            three places were seen) has it, shape (L,), m; NaN with fewer places.
        bend_chance: Chance that an axis without any shows as much, shape (L,); NaN likewise.
    """

    scale: FloatArray
    shear_rad: FloatArray
    covariance: FloatArray
    rms_px: float
    view_count: int
    place_sigma_m: FloatArray
    bend_m: FloatArray
    bend_chance: FloatArray

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations of scales and shears, shape (L + P,), 1 and rad."""
        return read_only(np.sqrt(np.diag(self.covariance)))


def axis_pairs(count: int) -> tuple[tuple[int, int], ...]:
    """Pairs of linear axes in the order of the shears: 1-2, 1-3, 2-3."""
    return tuple((i, j) for i in range(count) for j in range(i + 1, count))


def true_directions(directions: FloatArray, scale: FloatArray, shear_rad: FloatArray) -> FloatArray:
    """What a unit of travel of each linear axis truly is.

    Args:
        directions: Nominal unit vectors, shape (L, 3).
        scale: Relative excess of travel, shape (L,).
        shear_rad: Lean of each pair, shape (P,), rad.

    Returns:
        Vectors in gantry axes, shape (L, 3); their length is the travel per nominal travel.
    """
    leaned = directions.copy()
    for (earlier, later), angle in zip(axis_pairs(len(directions)), shear_rad, strict=True):
        leaned[later] = leaned[later] + angle * directions[earlier]
    return np.asarray(leaned / np.linalg.norm(leaned, axis=1, keepdims=True) * (1.0 + scale)[:, None])


def board_places(views: Sequence[BoardView], lens: Lens) -> tuple[FloatArray, FloatArray]:
    """The one attitude of a board that is only shifted, and its place in each picture.

    Args:
        views: Pictures.
        lens: The lens.

    Returns:
        Rotation camera_from_board, shape (3, 3), and translations, shape (V, 3), m.

    Raises:
        RegistrationError: A picture whose pose cannot be found.
    """
    import cv2

    rotations, starts = [], []
    for view in views:
        rays = lens.unproject(view.px)
        plane = rays[:, :2] / rays[:, 2:]
        is_found, turn, shift = cv2.solvePnP(view.board_m, plane, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        if not is_found or not np.all(np.isfinite(turn)):
            raise RegistrationError(f"{view.name}: the board's pose cannot be found")
        rotations.append(so3_exp(turn.reshape(3)))
        starts.append(shift.reshape(3))
    R = mean_rotation(np.array(rotations))
    t_m = np.array([_shift(view, lens, R, start) for view, start in zip(views, starts, strict=True)])
    return R, t_m


def _shift(view: BoardView, lens: Lens, R: FloatArray, start_m: FloatArray) -> FloatArray:
    """The translation that explains a picture best at a given attitude."""
    t_m = start_m
    for _ in range(5):
        px, by_point, _ = lens.project_with_jacobians(view.board_m @ R.T + t_m)
        t_m = t_m + np.linalg.lstsq(by_point.reshape(-1, 3), (view.px - px).reshape(-1), rcond=None)[0]
    return t_m


def fit_axis_errors(
    views: Sequence[BoardView],
    positions_m: FloatArray,
    directions: FloatArray,
    calibration: Calibration,
    *,
    mount: Mount = "beacon_on_carriage",
    board_sigma: float = 0.0,
) -> AxisErrors:
    """Fit scales and shears to pictures of a board, one at each place, all approached the same way.

    Args:
        views: Pictures, length V.
        positions_m: Machine positions of the linear axes at each, shape (V, L), m.
        directions: Nominal unit vectors of the linear axes, shape (L, 3).
        calibration: The camera; its doubt goes into the covariance.
        mount: With ``camera_on_carriage`` the board stands still.
        board_sigma: Relative doubt of the board's printed size, standard deviation.

    Returns:
        The errors.

    Raises:
        RegistrationError: Too few pictures, or places that do not spread along every axis.
    """
    V = len(positions_m)
    if V < _FEWEST_VIEWS:
        raise RegistrationError(f"scale and squareness need pictures at {_FEWEST_VIEWS} places or more, got {V}")
    spread = np.linalg.svd(positions_m - positions_m.mean(axis=0), compute_uv=False)
    if spread[-1] < 0.05 * spread[0]:
        raise RegistrationError("the places must spread along every linear axis, and not on one plane or line")
    sign = 1.0 if mount == "beacon_on_carriage" else -1.0
    fit = _Fit(views, positions_m - positions_m.mean(axis=0), directions, calibration.lens, sign)
    R_cb, t_m = board_places(views, calibration.lens)
    nominal = sign * fit.positions_m @ directions
    R_cg = _best_rotation(nominal, t_m - t_m.mean(axis=0))
    errors = np.zeros(fit.error_count)
    state = (R_cb, R_cg, t_m.mean(axis=0), errors)
    residual, J, _ = fit.linearised(*state)
    damping, cost = 1e-6, float(residual @ residual)
    for _ in range(_ITERATIONS):
        H = J.T @ J
        step: FloatArray = np.linalg.solve(H + damping * np.diag(np.diag(H)), J.T @ residual).astype(np.float64)
        tried = fit.moved(state, step)
        new_residual, new_J, _ = fit.linearised(*tried)
        new_cost = float(new_residual @ new_residual)
        if new_cost <= cost:
            gain, state, residual, J = (cost - new_cost) / max(cost, 1e-30), tried, new_residual, new_J
            cost, damping = new_cost, damping * 0.1
            if gain < 1e-12:
                break
        else:
            damping *= 10.0
    for _ in range(_REWEIGHTINGS):
        fit.weigh(*fit.linearised(*state)[:2])
        for _ in range(2):
            M, scores = fit.normal(*fit.linearised(*state)[:2])
            state = fit.moved(state, np.linalg.solve(M.sum(axis=0), scores.sum(axis=0)))
    return fit.result(state, calibration, board_sigma)


class _Fit:
    """Residuals and derivatives; the unknowns are two attitudes, a place, scales and shears, in this order."""

    def __init__(
        self, views: Sequence[BoardView], positions_m: FloatArray, directions: FloatArray, lens: Lens, sign: float
    ) -> None:
        self.positions_m = positions_m
        self.directions = directions
        self.axis_count = len(directions)
        self.error_count = self.axis_count + len(axis_pairs(self.axis_count))
        self._lens = lens
        self._sign = sign
        self._board_m = np.concatenate([view.board_m for view in views])
        self._px = np.concatenate([view.px for view in views])
        self.view = np.repeat(np.arange(len(views)), [len(view.px) for view in views])
        ends = np.concatenate([[0], 2 * np.cumsum([len(view.px) for view in views])])
        self._rows = [slice(a, b) for a, b in pairwise(ends)]
        self._share_m_px = 0.0

    def moved(
        self, state: tuple[FloatArray, FloatArray, FloatArray, FloatArray], step: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        R_cb, R_cg, t_m, errors = state
        turn, lean = so3_exp(np.ascontiguousarray(step[:3])), so3_exp(np.ascontiguousarray(step[3:6]))
        return turn @ R_cb, lean @ R_cg, t_m + step[6:9], errors + step[9:]

    def linearised(
        self, R_cb: FloatArray, R_cg: FloatArray, t_m: FloatArray, errors: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residuals (2N,), px, their derivatives (2N, U) with the sign of the prediction, and by the lens (2N, P)."""
        carried = self._sign * self.positions_m @ self._true(errors) @ R_cg.T
        turned = self._board_m @ R_cb.T
        px, by_point, by_lens = self._lens.project_with_jacobians(turned + carried[self.view] + t_m)
        if not np.all(np.isfinite(px)):
            raise RegistrationError("a corner lies outside the valid field of the lens")
        J = np.empty((len(px), 2, 9 + self.error_count))
        J[:, :, 0:3] = -by_point @ np.array([hat(p) for p in turned])
        J[:, :, 3:6] = -by_point @ np.array([hat(p) for p in carried])[self.view]
        J[:, :, 6:9] = by_point
        for k in range(self.error_count):
            ahead = errors.copy()
            ahead[k] += _STEP
            change = self._sign * self.positions_m @ ((self._true(ahead) - self._true(errors)) / _STEP) @ R_cg.T
            J[:, :, 9 + k] = np.einsum("nij,nj->ni", by_point, change[self.view])
        U = J.shape[2]
        return (self._px - px).reshape(-1), J.reshape(-1, U), by_lens.reshape(-1, by_lens.shape[2])

    def weigh(self, residual: FloatArray, J: FloatArray) -> None:
        """Learn how much the places scatter against the corners: a place that is off shifts all its corners alike.

        Source: maximum likelihood of the two variances of a mixed model, given the residuals.
        """
        from scipy.optimize import minimize_scalar

        by_shift = [J[rows, 6:9] for rows in self._rows]
        shifts = [
            np.linalg.lstsq(B, residual[rows], rcond=None)[0] for B, rows in zip(by_shift, self._rows, strict=True)
        ]
        within = [residual[rows] - B @ s for B, s, rows in zip(by_shift, shifts, self._rows, strict=True)]
        square_px2 = sum(float(e @ e) for e in within) / max(1, len(residual) - 3 * len(shifts) - 3)
        if not square_px2 > _EXACT_PX2:
            return
        unit = np.array([np.linalg.inv(B.T @ B) for B in by_shift])
        scaled = np.array(shifts) / np.sqrt(square_px2)

        def unlikely(log_share: float) -> float:
            C = unit + np.exp(2.0 * log_share) * np.eye(3)
            asked = np.linalg.solve(C, scaled[:, :, None])[:, :, 0]
            return float(np.linalg.slogdet(C)[1].sum() + np.sum(scaled * asked))

        found = minimize_scalar(unlikely, bounds=(np.log(_TINIEST), np.log(_LARGEST)), method="bounded")
        self._share_m_px = float(np.exp(found.x))

    def normal(self, residual: FloatArray, J: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Normal matrices (V, U, U) and gradients (V, U) of each picture, weighed by corners and places."""
        M = [self._times(J, J, rows) for rows in self._rows]
        return np.array(M), np.array([self._times(J, residual, rows) for rows in self._rows])

    def _times(self, J: FloatArray, other: FloatArray, rows: slice) -> FloatArray:
        """``J^T W other`` of one picture, W the inverse covariance of its residuals in units of the corners'."""
        own, B, X = J[rows], J[rows, 6:9], other[rows]
        if self._share_m_px == 0.0:
            return np.asarray(own.T @ X)
        between = np.linalg.solve(B.T @ B + np.eye(3) / self._share_m_px**2, B.T @ X)
        return np.asarray(own.T @ X - own.T @ B @ between)

    def result(
        self, state: tuple[FloatArray, FloatArray, FloatArray, FloatArray], calibration: Calibration, board_sigma: float
    ) -> AxisErrors:
        residual, J, by_lens = self.linearised(*state)
        V = len(self.positions_m)
        inverse, covariance = self._solved(residual, J)
        if calibration.covariance is not None:
            K = inverse @ np.sum([self._times(J, by_lens, rows) for rows in self._rows], axis=0)
            covariance = covariance + K @ calibration.covariance @ K.T
        covariance = np.array(covariance[9:, 9:])
        L = self.axis_count
        covariance[:L, :L] += board_sigma**2
        errors = state[3]
        bends = np.array([self._bend(axis, state, residual, J) for axis in range(L)])
        return AxisErrors(
            scale=read_only(errors[:L]),
            shear_rad=read_only(errors[L:]),
            covariance=read_only(0.5 * (covariance + covariance.T)),
            rms_px=float(np.sqrt(np.mean(residual**2))),
            view_count=V,
            place_sigma_m=self._place_sigma_m(state, residual, J),
            bend_m=read_only(bends[:, 0]),
            bend_chance=read_only(bends[:, 1]),
        )

    def _solved(self, residual: FloatArray, J: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Inverse of the normal matrix, and the covariance of what was fitted, both (U, U).

        Pictures are the independent things, not corners. Each counts with the residual it has when it is left out of
        the fit, or the far ends would look too good.
        """
        M, scores = self.normal(residual, J)
        inverse = np.linalg.inv(M.sum(axis=0))
        one = np.eye(len(inverse))
        left_out = np.array([np.linalg.solve(one - m @ inverse, g) for m, g in zip(M, scores, strict=True)])
        return inverse, inverse @ (left_out.T @ left_out) @ inverse

    def _bend(
        self,
        axis: int,
        state: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
        residual: FloatArray,
        J: FloatArray,
    ) -> tuple[float, float]:
        """Largest deviation of an axis from a constant scale, m, and the chance of it without any: a Wald test."""
        q = self.positions_m[:, axis]
        half = 0.5 * float(np.ptp(q))
        place_count = 1 + int(np.sum(np.diff(np.sort(q)) > _APART * half))
        orders = range(2, min(3, place_count - 1) + 1)
        if not orders:
            return np.nan, np.nan
        basis = np.eye(4)[:, orders]
        shapes = np.polynomial.legendre.legval((q - q.min()) / half - 1.0, basis)
        along = self._sign * state[1] @ self._true(state[3])[axis]
        added = (J[:, 6:9] @ along)[:, None] * shapes.T[np.repeat(self.view, 2)]
        wide = np.column_stack([J, added])
        M, scores = self.normal(residual, wide)
        step = np.linalg.solve(M.sum(axis=0), scores.sum(axis=0))
        _, covariance = self._solved(residual - wide @ step, wide)
        c, C = step[-len(orders) :], covariance[-len(orders) :, -len(orders) :]
        square = float(c @ np.linalg.solve(C, c)) / len(orders)
        chance = f_tail(square, len(orders), max(1, len(q) - wide.shape[1]))
        curve = np.polynomial.legendre.legval(np.linspace(-1.0, 1.0, 41), basis @ c)
        return float(np.abs(curve).max()), chance

    def _place_sigma_m(
        self, state: tuple[FloatArray, FloatArray, FloatArray, FloatArray], residual: FloatArray, J: FloatArray
    ) -> FloatArray:
        """Scatter along each axis of the shift of each picture that its own residuals ask for."""
        V = len(self.positions_m)
        towards = self._true(state[3]) @ state[1].T
        shifts = np.empty((V, self.axis_count))
        for v in range(V):
            rows = np.repeat(self.view, 2) == v
            shift_m = np.linalg.lstsq(J[rows, 6:9], residual[rows], rcond=None)[0]
            shifts[v] = towards @ shift_m
        return read_only(np.sqrt(np.sum(shifts**2, axis=0) / max(1, V - 4)))

    def _true(self, errors: FloatArray) -> FloatArray:
        return true_directions(self.directions, errors[: self.axis_count], errors[self.axis_count :])


def _best_rotation(source: FloatArray, target: FloatArray) -> FloatArray:
    """Rotation that carries centred points onto others best. Source: W. Kabsch, 1976."""
    U, _, Vt = np.linalg.svd(target.T @ source)
    return np.asarray(U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt)
