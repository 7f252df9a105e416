"""Fit axis scale, squareness and time terms beside the two poses of a bench, each only when the data ask for it.

The sensor's own scale is never corrected. It is fitted along, as a depth scale and a size scale, only so that what
looks like it is not taken for an error of the axes; then it is dropped, and stays in the sensor's errors.

Source: nested linear models by the F test on place means, with the cluster-robust covariance of K.-Y. Liang and
S. L. Zeger, 1986, where it is larger; Bonferroni for several terms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.bench_model import pose_residuals, predicted, prediction_jacobian, residual_jacobian
from uvgs_bench.accuracy.bench_terms import (
    SENSOR_COUNT,
    TERM_COUNT,
    TERM_GROUPS,
    is_straight,
    moved_carriage_m,
    sensor_jacobian,
    sensor_like_terms,
    term_jacobian,
)
from uvgs_bench.accuracy.distributions import f_tail
from uvgs_bench.accuracy.least_squares import Alignment
from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.place_scatter import Groups, crossed
from uvgs_bench.geometry import FloatArray, Pose, read_only

LEVEL = 0.01
"""Chance at which any one of the terms asked for is taken up although nothing is there."""
_POSES = 12
# A term is seen when the data pin it to a tenth of this: scales and shears to 1 %, time to 0.1 s and 1 ms/s.
_UNITS = np.array([0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 1.0, 0.01])
_WORST_SEEN = 0.1
_RELATIVE_FLOOR = 1e-11
_MOST_ITERATIONS = 8
_SETTLED = 1e-4
_AXES = "axis_scale+squareness"
# Share of a sensor-like direction that must lie within a group for it to be held there.
_ALIKE = 0.1
_LEAST_SHARE = 0.25
# A place that alone shows a direction cannot be foretold by the others at all.
_MOST_OWN = 0.99
_EYE = np.eye(_POSES + TERM_COUNT + SENSOR_COUNT)
# Poses and the sensor's scales: whatever the terms are, these are free.
_OTHERS = np.delete(_EYE, np.s_[_POSES : _POSES + TERM_COUNT], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class FittedTerms:
    """Terms that were taken up.

    Args:
        values: Scales x, y, z, shears xy, xz, yz, time offset, time rate, shape (8,), 1, rad, s, s/s; 0 where not
            fitted.
        covariance: Their covariance, shape (8, 8).
        degrees_of_freedom: How well each one's variance is known, shape (8,); 1 or more.
        pose_response: How both poses follow a change of the terms, shape (12, 8), before a gauge is chosen.
        taken: Names of the groups taken up.
        held: Directions of (scale, shear) held at zero, orthonormal rows, shape (k, 6).
        directions: Directions that were fitted, orthonormal columns, shape (8, K).
        notes: What became of each group, in the order asked.
    """

    values: FloatArray
    covariance: FloatArray
    degrees_of_freedom: FloatArray
    pose_response: FloatArray
    taken: tuple[str, ...]
    held: FloatArray
    directions: FloatArray
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations of all 22 unknowns, and how much each place pulls."""

    H: FloatArray
    pulls: FloatArray
    scatter: float
    rank: int
    rows: FloatArray
    grouped: Groups

    def eliminated(self, keep: FloatArray, drop: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Information about ``keep`` and the places' pulls on it, ``drop`` being free. Columns are directions."""
        through = self._through(keep, drop)
        return keep.T @ self.H @ through, self.pulls @ through

    def place_information(self, keep: FloatArray, drop: FloatArray) -> FloatArray:
        """What each place contributes to the information about ``keep``, shape (S, k, k)."""
        seen = self.rows @ self._through(keep, drop)
        each = seen.reshape(len(self.grouped.order), 6, -1)
        return self.grouped.sums(each.transpose(0, 2, 1) @ each)

    def _through(self, keep: FloatArray, drop: FloatArray) -> FloatArray:
        """The directions with what the others do to follow them."""
        return keep - drop @ _solved(drop.T @ self.H @ drop, drop.T @ self.H @ keep)


def fit_terms(
    data: Observations,
    fit: Alignment,
    poses: tuple[Pose, Pose, FloatArray],
    asked: tuple[str, ...],
    of_place: NDArray[np.intp],
    origin_ns: int,
) -> tuple[FittedTerms, Alignment, tuple[Pose, Pose, FloatArray, int]]:
    """Fit the terms asked for, drop those the data do not ask for, and fit the rest.

    Args:
        data: Captures, all with a pose.
        fit: Their least squares.
        poses: Left pose, right pose and robust weights at its solution without terms.
        asked: Names of ``TERM_GROUPS``.
        of_place: Running number of each capture's place, shape (N,).
        origin_ns: Instant at which the clocks' offset is quoted, ns.

    Returns:
        The terms, the least squares with the carriage moved by them, and its solution.

    Raises:
        RegistrationError: No convergence.
    """
    state = _State(fit, *poses, 0, np.zeros(TERM_COUNT))
    bases, notes = _bases(data, state, asked, _normal(state, data, of_place, origin_ns))
    taken = tuple(bases)
    if taken:
        full, normal = _converged(state, data, np.column_stack(list(bases.values())), of_place, origin_ns)
        taken, found = _asked_for(bases, full.values, normal)
        notes |= found
        if len(taken) == len(bases):
            state = full
        elif taken:
            basis = np.column_stack([bases[name] for name in taken])
            start = _at(full, data, basis @ (basis.T @ full.values), origin_ns)
            state, normal = _converged(start, data, basis, of_place, origin_ns)
    ordered = tuple(dict.fromkeys(notes[_group(name, asked)] for name in asked))
    solution = (state.left, state.right, state.weights, state.iterations)
    if not taken:
        nothing = np.zeros((TERM_COUNT, TERM_COUNT))
        empty = FittedTerms(
            values=state.values,
            covariance=nothing,
            degrees_of_freedom=np.ones(TERM_COUNT),
            pose_response=np.zeros((_POSES, TERM_COUNT)),
            taken=(),
            held=np.eye(6),
            directions=np.empty((TERM_COUNT, 0)),
            notes=ordered,
        )
        return empty, state.fit, solution
    basis = np.column_stack([bases[name] for name in taken])
    through = state.fit.information(state.left, state.right, state.weights).covariance()
    fitted = FittedTerms(
        values=read_only(state.values),
        covariance=read_only(basis @ _covariance(basis, normal) @ basis.T),
        degrees_of_freedom=read_only(_degrees(basis, normal)),
        pose_response=read_only(-through @ normal.H[:_POSES, _POSES : _POSES + TERM_COUNT]),
        taken=tuple(part for name in taken for part in name.split("+")),
        held=read_only(np.linalg.svd(basis[:6].T)[2][int(np.linalg.matrix_rank(basis[:6])) :]),
        directions=read_only(basis),
        notes=ordered,
    )
    return fitted, state.fit, solution


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """Where the fit stands."""

    fit: Alignment
    left: Pose
    right: Pose
    weights: FloatArray
    iterations: int
    values: FloatArray


def _converged(
    state: _State, data: Observations, basis: FloatArray, of_place: NDArray[np.intp], origin_ns: int
) -> tuple[_State, _Normal]:
    """Poses and the terms along a basis, in turn, each step of the terms knowing how the poses will follow."""
    normal = _normal(state, data, of_place, origin_ns)
    for _ in range(_MOST_ITERATIONS):
        information, pulls = normal.eliminated(_embedded(basis), _OTHERS)
        step = -basis @ np.linalg.solve(information, pulls.sum(axis=0))
        state = _at(state, data, state.values + step, origin_ns)
        normal = _normal(state, data, of_place, origin_ns)
        if float(np.abs(step / _UNITS).max()) < _SETTLED:
            break
    return state, normal


def _at(state: _State, data: Observations, values: FloatArray, origin_ns: int) -> _State:
    """The best poses for given terms."""
    moved = replace(data, t_gs_m=moved_carriage_m(data, values, origin_ns))
    fit = Alignment(moved, state.fit.shares, state.fit.gantry_sigma_m)
    left, right, weights, iterations = fit.solve(state.left, state.right)
    return _State(fit, left, right, weights, state.iterations + iterations, values)


def _normal(state: _State, data: Observations, of_place: NDArray[np.intp], origin_ns: int) -> _Normal:
    """Normal equations of poses, terms and the sensor's scales at a solution of the poses."""
    fit, left, right, weights = state.fit, state.left, state.right, state.weights
    R, t = predicted(left, right, fit.R_g, fit.t_g)
    e = pose_residuals(fit.data, R, t)
    columns = np.concatenate(
        [
            prediction_jacobian(left, fit.R_g, fit.t_g),
            term_jacobian(data, left, state.values, origin_ns),
            sensor_jacobian(t),
        ],
        axis=2,
    )
    plain = residual_jacobian(e, columns)
    J = fit.whitening @ plain
    root = np.sqrt(fit.shares * weights)
    flat = (J * root[:, None, None]).reshape(-1, J.shape[2])
    J = flat.reshape(len(flat) // 6, 6, -1)
    H = crossed(J, J)
    # Residuals as they would be with the sensor's scales free: what these explain is not scatter.
    pull = flat.T @ ((fit.whitening @ e[:, :, None])[:, :, 0] * root[:, None]).ravel()
    step = _OTHERS @ _solved(_OTHERS.T @ H @ _OTHERS, _OTHERS.T @ pull)
    e = e - (plain.reshape(-1, J.shape[2]) @ step).reshape(-1, 6)
    whitened = (fit.whitening @ e[:, :, None])[:, :, 0] * root[:, None]
    grouped = Groups.of(of_place)
    pulls = grouped.sums(np.einsum("nki,nk->ni", J, whitened))
    size = np.sqrt(np.maximum(np.diag(H)[:_POSES], 1e-300))
    seen = np.linalg.eigvalsh(H[:_POSES, :_POSES] / np.outer(size, size))
    rank = int((seen > 1e-9 * seen[-1]).sum())
    scatter = fit.scatter_of(e, weights, of_place)
    return _Normal(H, pulls, scatter, rank, flat, grouped)


def _solved(A: FloatArray, b: FloatArray) -> FloatArray:
    """Least-norm solution of normal equations whose unknowns may not all be seen."""
    size = np.sqrt(np.maximum(np.diag(A), 1e-300))
    values, vectors = np.linalg.eigh(A / np.outer(size, size))
    good = values > _RELATIVE_FLOOR * float(values[-1])
    through = vectors[:, good].T @ (b.T / size).T
    return np.asarray(((vectors[:, good] @ (through.T / values[good]).T).T / size).T, dtype=np.float64)


def _embedded(basis: FloatArray) -> FloatArray:
    """Directions of terms as directions of all unknowns."""
    out = np.zeros((_POSES + TERM_COUNT + SENSOR_COUNT, basis.shape[1]))
    out[_POSES : _POSES + TERM_COUNT] = basis
    return out


def _group(name: str, asked: tuple[str, ...]) -> str:
    """Scale and squareness share what looks like the sensor's scale, so they are one group when both are asked for."""
    return _AXES if name in _AXES.split("+") and set(_AXES.split("+")) <= set(asked) else name


def _bases(
    data: Observations, state: _State, asked: tuple[str, ...], normal: _Normal
) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Directions each group may use, and why a group has none."""
    bases: dict[str, FloatArray] = {}
    notes: dict[str, str] = {}
    slices = {"axis_scale": (0, 3), "squareness": (3, 6), _AXES: (0, 6), "time_offset": (6, 7), "time_rate": (7, 8)}
    for name in dict.fromkeys(_group(name, asked) for name in TERM_GROUPS if name in asked):
        first, end = slices[name]
        columns = np.eye(TERM_COUNT)[:, first:end]
        if first < 6:
            if not is_straight(data):
                notes[name] = f"{_title(name)}: not fitted, a rotary axis turns the linear axes of this gantry"
                continue
            alike = sensor_like_terms(data, state.left)[:, first:end]
            _, size, directions = np.linalg.svd(alike)
            columns = columns @ directions[int((size > _ALIKE).sum()) :].T
        elif not np.any(data.velocity_gs_mps):
            notes[name] = f"{_title(name)}: not fitted, no capture was taken in motion"
            continue
        # What the data do not pin is held at zero rather than quoted.
        units = _UNITS[np.abs(columns).argmax(axis=0)]
        information, _ = normal.eliminated(_embedded(columns * units), _OTHERS)
        spread, vectors = np.linalg.eigh(information)
        usable = (columns * units) @ vectors[:, spread > 1.0 / _WORST_SEEN**2]
        if usable.shape[1] == 0:
            notes[name] = f"{_title(name)}: not fitted, these stations cannot see it"
        else:
            bases[name] = np.linalg.qr(usable)[0]
    return bases, notes


def _asked_for(
    bases: dict[str, FloatArray], values: FloatArray, normal: _Normal
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Drop the least significant group, and again beside the rest, until all are significant."""
    taken, notes, tests = list(bases), dict[str, str](), len(bases)
    basis = np.column_stack(list(bases.values()))
    found = basis.T @ values
    # The fit with fewer groups follows from the full one as if the full one were all that was observed.
    information = np.asarray(np.linalg.inv(_covariance(basis, normal)), dtype=np.float64)
    target = information @ found
    owner = np.repeat(np.arange(tests), [b.shape[1] for b in bases.values()])
    of_term = _degrees(basis, normal)
    while taken:
        kept = np.flatnonzero([list(bases)[k] in taken for k in owner])
        C = np.linalg.inv(information[np.ix_(kept, kept)])
        here = C @ target[kept]
        chances = {}
        for name in taken:
            own = np.flatnonzero(owner[kept] == list(bases).index(name))
            degrees = max(float(of_term[np.abs(bases[name]).max(axis=1) > _ALIKE].min()) - len(own) + 1.0, 1.0)
            gain = float(here[own] @ np.linalg.solve(C[np.ix_(own, own)], here[own])) / len(own)
            chances[name] = tests * f_tail(gain, len(own), degrees)
        worst = max(chances, key=lambda name: chances[name])
        if chances[worst] < LEVEL:
            for name, chance in chances.items():
                count = bases[name].shape[1]
                notes[name] = f"{_title(name)}: fitted in {count} direction{'s' if count > 1 else ''}, {_odds(chance)}"
                if name in ("axis_scale", _AXES):
                    notes[name] += (
                        "; all axes alike (a wrong size of the beacon) and travel along the line of sight (a wrong "
                        "focal length) cannot be told from the sensor's own scale and stay in its errors"
                    )
            break
        notes[worst] = f"{_title(worst)}: left at nominal, {_odds(chances[worst])}"
        taken.remove(worst)
    return tuple(taken), notes


def _odds(chance: float) -> str:
    return f"chance alone explains as much with probability {min(1.0, chance):.2g}"


def _covariance(basis: FloatArray, normal: _Normal) -> FloatArray:
    """Covariance of directions from how differently the places pull; never below half of the sigma of the model.

    Components of a pose need not all err in proportion to what is stated, so the variance factor, which is one number
    for all, says too much of some directions and too little of others.
    """
    keep = _embedded(basis)
    information, pulls = normal.eliminated(keep, _OTHERS)
    S, k = len(pulls), len(information)
    # A place that matters much draws the fit to itself and so hides its own error: as if the others had foretold it.
    own = normal.place_information(keep, _OTHERS) @ np.linalg.inv(information)
    foretold = np.linalg.solve(np.eye(k) - _MOST_OWN * own, pulls[:, :, None])[:, :, 0]
    centred = foretold - foretold.mean(axis=0)
    scatter = centred.T @ centred * S / max(S - 1.0, 1.0)
    model = np.linalg.inv(information) * (normal.scatter / max(6 * S - normal.rank - k - SENSOR_COUNT, 1))
    # Eigenvalues relative to the model: with few places a direction may seem to scatter less than it can.
    root = np.linalg.cholesky(model)
    inverse = np.linalg.inv(information)
    whitened = np.linalg.solve(root, np.linalg.solve(root, inverse @ scatter @ inverse).T)
    values, vectors = np.linalg.eigh(0.5 * (whitened + whitened.T))
    factor = root @ (vectors * np.sqrt(np.maximum(values, _LEAST_SHARE)))
    return np.asarray(factor @ factor.T)


def _degrees(basis: FloatArray, normal: _Normal) -> FloatArray:
    """Degrees of freedom of each term's variance, shape (8,): how many places it rests on, less one.

    Few places at the ends of a travel, or few in motion, carry most of what is known of a term, however many there are.

    Source: R. M. Bell and D. F. McCaffrey, Bias reduction in standard errors for linear regression with multi-stage
    samples (2002), with the terms of different places taken as independent.
    """
    keep = _embedded(basis)
    information, _ = normal.eliminated(keep, _OTHERS)
    direction = basis @ np.linalg.inv(information)
    share = np.einsum("ti,sij,tj->ts", direction, normal.place_information(keep, _OTHERS), direction, optimize=True)
    return np.asarray(np.maximum(share.sum(axis=1) ** 2 / np.maximum((share**2).sum(axis=1), 1e-300) - 1.0, 1.0))


def _title(name: str) -> str:
    return name.replace("_", " ").replace("+", " and ")
