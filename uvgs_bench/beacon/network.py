"""Bundle adjustment of LED positions: sparse normal equations, Levenberg-Marquardt, covariance and leverage.

Global unknowns are the LEDs and, as far as asked for, the pose and the faults of the gantry, the print scale of a board
and the lens; local unknowns are a pose per view, or with a gantry the stopping error of each station. The local ones
are eliminated (Schur complement). Declared doubts enter as priors with their own deviations, so that the covariance
holds them.

Source: B. Triggs et al., Bundle adjustment - a modern synthesis (2000), sections 6.1 and 9.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.beacon.length_row import LengthRow
from uvgs_bench.camera.lens import Lens
from uvgs_bench.errors import CalibrationError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.se3 import se3_exp

_MAX_ITERATIONS = 100
# No emission centre travels farther than the dome of an LED is high.
_SHIFT_SIGMA_M = 5e-3
# Faults of the gantry: three scales, three squarenesses, as an upper triangle added to the unit matrix.
_FAULTS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Every seen point of all views in one list, view after view.

    Args:
        px: Pixels, shape (N, 2).
        sigma_px: Deviation per axis, shape (N,), px.
        led: Number of the LED, or -1 for a board point, shape (N,).
        board_m: Board points in the board frame, shape (N, 3), m; not used for LEDs.
        view: Number of the view, shape (N,), rising from 0.
        view_count: Number of views; each sees something.
    """

    px: FloatArray
    sigma_px: FloatArray
    led: NDArray[np.intp]
    board_m: FloatArray
    view: NDArray[np.intp]
    view_count: int

    def per_view(self, values: FloatArray) -> FloatArray:
        """Sum over the sightings of each view, shape (V, ...)."""
        result: FloatArray = np.add.reduceat(values, np.searchsorted(self.view, np.arange(self.view_count)), axis=0)
        return result


@dataclass(frozen=True, slots=True, eq=False)
class GantryModel:
    """The carriage as the gantry reports it; it must not turn.

    Args:
        carriage_m: Reported carriage positions, shape (V, 3), m, gantry frame.
        is_carried: Whether the beacon rides the carriage, else the camera does.
        station_sigma_m: Deviation of a stop per axis, m.
        scale_sigma: Deviation of the scale of each axis.
        squareness_sigma_rad: Deviation of each squareness, rad.
    """

    carriage_m: FloatArray
    is_carried: bool
    station_sigma_m: float
    scale_sigma: float
    squareness_sigma_rad: float

    @property
    def sign(self) -> float:
        """1 when the beacon moves with the carriage, -1 when the camera does."""
        return 1.0 if self.is_carried else -1.0


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """What is adjusted and what is held against it.

    Args:
        sightings: What was seen.
        led_count: Number of LEDs.
        gauge: Directions of the LED vector that nothing decides, orthonormal columns, shape (3n, k).
        gantry: The gantry, or None when every view has a free pose.
        lengths: Statements about distances.
        board_scale_sigma: Deviation of the print scale of the board, or 0 when there is no board.
        lens_covariance: Covariance of the lens parameters when the lens is adjusted too, shape (P, P), or None.
        shift_axes: Where a sighted point goes when the emission centre of its LED travels by 1, shape (N, 3), in the
            frame of the LEDs; None when emission centres stay.
    """

    sightings: Sightings
    led_count: int
    gauge: FloatArray
    gantry: GantryModel | None = None
    lengths: Sequence[LengthRow] = ()
    board_scale_sigma: float = 0.0
    lens_covariance: FloatArray | None = None
    shift_axes: FloatArray | None = None

    @property
    def columns(self) -> dict[str, slice]:
        """Where each global unknown stands."""
        sizes = {"leds": 3 * self.led_count}
        if self.gantry is not None:
            sizes |= {"outer": 6, "faults": 6}
        if self.board_scale_sigma > 0.0:
            sizes["board_scale"] = 1
        if self.lens_covariance is not None:
            sizes["lens"] = len(self.lens_covariance)
        if self.shift_axes is not None:
            sizes["shifts"] = self.led_count
        out, at = {}, 0
        for name, size in sizes.items():
            out[name] = slice(at, at + size)
            at += size
        return out


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Values of all unknowns.

    Args:
        leds_m: LED positions, shape (n, 3), m.
        lens: The lens.
        R: Rotations camera_from_beacon of the views, shape (V, 3, 3); one row camera_from_gantry with a gantry
            (camera_from_carriage when the camera is carried).
        t_m: Translations, same rows, m.
        stops_m: Stopping errors, shape (V, 3), m, gantry frame; empty without a gantry.
        faults: Scales and squarenesses of the gantry, shape (6,).
        board_scale: Print scale of the board minus one.
        shifts_m: Travel of each emission centre, shape (n,), m; not used when they stay.
    """

    leds_m: FloatArray
    lens: Lens
    R: FloatArray
    t_m: FloatArray
    stops_m: FloatArray
    faults: FloatArray
    board_scale: float = 0.0
    shifts_m: FloatArray = field(default_factory=lambda: np.zeros(0))

    def moved(self, network: Network, step: FloatArray, local: FloatArray) -> State:
        """The state after a step of global unknowns, shape (G,), and of local ones, shape (V, k)."""
        at = network.columns
        twists = local if network.gantry is None else step[at["outer"]][None]
        R, t = np.empty_like(self.R), np.empty_like(self.t_m)
        for i, twist in enumerate(np.ascontiguousarray(twists)):
            dR, dt = se3_exp(twist)
            R[i], t[i] = dR @ self.R[i], dR @ self.t_m[i] + dt
        return State(
            self.leds_m + step[at["leds"]].reshape(-1, 3),
            self.lens.with_parameters(self.lens.parameters + step[at["lens"]]) if "lens" in at else self.lens,
            R,
            t,
            self.stops_m if network.gantry is None else self.stops_m + local,
            self.faults + step[at["faults"]] if "faults" in at else self.faults,
            self.board_scale + float(step[at["board_scale"]][0]) if "board_scale" in at else self.board_scale,
            self.shifts_m + step[at["shifts"]] if "shifts" in at else self.shifts_m,
        )


def points_in_camera(network: Network, state: State) -> FloatArray:
    """Every sighted point in camera axes, shape (N, 3), m."""
    s = network.sightings
    is_led = s.led >= 0
    X = np.where(is_led[:, None], state.leds_m[s.led], s.board_m * (1.0 + state.board_scale))
    if network.shift_axes is not None:
        X = X + network.shift_axes * np.where(is_led, state.shifts_m[s.led], 0.0)[:, None]
    if network.gantry is None:
        turned = np.einsum("nij,nj->ni", state.R[s.view], X)
        result: FloatArray = turned + state.t_m[s.view]
        return result
    carriage = network.gantry.carriage_m @ (np.eye(3) + _fault_matrix(state.faults)).T + state.stops_m
    moved: FloatArray = (X + network.gantry.sign * carriage[s.view]) @ state.R[0].T + state.t_m[0]
    return moved


def _fault_matrix(faults: FloatArray) -> FloatArray:
    out = np.zeros((3, 3))
    for value, place in zip(faults, _FAULTS, strict=True):
        out[place] = value
    return out


def residuals_px(network: Network, state: State) -> FloatArray:
    """Observed minus projected, shape (N, 2), px; NaN where the lens sees nothing."""
    return network.sightings.px - state.lens.project(points_in_camera(network, state))


def jacobians(network: Network, state: State) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals and the derivatives of the projected pixels.

    Args:
        network: The network.
        state: Where.

    Returns:
        Residuals (N, 2), derivatives by the global unknowns (N, 2, G), and by the local ones of the view (N, 2, k).
    """
    s, at = network.sightings, network.columns
    p = points_in_camera(network, state)
    px, by_point, by_lens = state.lens.project_with_jacobians(p)
    N = len(px)
    # d p / d xi = [-[p]^ | I] for the left update; a row a times -[p]^ is p x a.
    by_pose = np.concatenate([np.cross(p[:, None, :], by_point), by_point], axis=2)
    turn = state.R[s.view] if network.gantry is None else np.broadcast_to(state.R[0], (N, 3, 3))
    by_source = by_point @ turn
    by_global = np.zeros((N, 2, max(part.stop for part in at.values())))
    is_led = s.led >= 0
    for i in range(network.led_count):
        chosen = s.led == i
        by_global[chosen, :, 3 * i : 3 * i + 3] = by_source[chosen]
    if "board_scale" in at:
        by_board = np.einsum("nij,nj->ni", by_source, s.board_m)
        by_global[:, :, at["board_scale"].start] = np.where(is_led[:, None], 0.0, by_board)
    if "lens" in at:
        by_global[:, :, at["lens"]] = by_lens
    if network.shift_axes is not None:
        by_shift = np.einsum("nij,nj->ni", by_source, network.shift_axes)
        for i in range(network.led_count):
            by_global[:, :, at["shifts"].start + i] = np.where((s.led == i)[:, None], by_shift, 0.0)
    if network.gantry is None:
        return s.px - px, by_global, by_pose
    by_global[:, :, at["outer"]] = by_pose
    by_carriage = network.gantry.sign * by_source
    for k, (row, column) in enumerate(_FAULTS):
        lever = network.gantry.carriage_m[s.view, column]
        by_global[:, :, at["faults"].start + k] = by_carriage[:, :, row] * lever[:, None]
    return s.px - px, by_global, by_carriage


def _prior(network: Network, state: State, origin: State) -> tuple[FloatArray, FloatArray, float]:
    """Information, gradient and cost of everything that is declared rather than seen, over the global unknowns."""
    at = network.columns
    G = max(part.stop for part in at.values())
    H, g, cost = np.zeros((G, G)), np.zeros(G), 0.0

    def hold(where: slice, value: FloatArray, information: FloatArray) -> None:
        nonlocal cost
        H[where, where] += information
        g[where] -= information @ value
        cost += float(value @ information @ value)

    if network.gantry is not None:
        doubt = network.gantry
        sigma = np.array([doubt.scale_sigma] * 3 + [doubt.squareness_sigma_rad] * 3)
        hold(at["faults"], state.faults, np.diag(sigma**-2.0))
    if "board_scale" in at:
        hold(at["board_scale"], np.array([state.board_scale]), np.array([[network.board_scale_sigma**-2.0]]))
    if network.lens_covariance is not None:
        scale = 1.0 / np.sqrt(np.diag(network.lens_covariance))
        information = scale[:, None] * np.linalg.inv(scale[:, None] * network.lens_covariance * scale) * scale
        hold(at["lens"], state.lens.parameters - origin.lens.parameters, information)
    if "shifts" in at:
        hold(at["shifts"], state.shifts_m, np.eye(network.led_count) * _SHIFT_SIGMA_M**-2.0)
    for row in network.lengths:
        J, e = row.gradient(state.leds_m), row.residual(state.leds_m)
        H[at["leds"], at["leds"]] += np.outer(J, J) / row.sigma**2
        g[at["leds"]] += J * e / row.sigma**2
        cost += (e / row.sigma) ** 2
    # Holds only what nothing else decides, so its strength (a millimetre) does not matter.
    hold(at["leds"], (state.leds_m - origin.leds_m).ravel(), network.gauge @ network.gauge.T * 1e6)
    return H, g, cost


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Local blocks (V, k, k), mixed blocks (V, k, G), global block (G, G), gradients, cost."""

    local: FloatArray
    mixed: FloatArray
    whole: FloatArray
    gradient_local: FloatArray
    gradient_whole: FloatArray
    cost: float

    def reduced(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """Inverse local blocks and the Schur complement."""
        local, whole = self.local.copy(), self.whole.copy()
        k, G = np.arange(local.shape[1]), np.arange(len(whole))
        local[:, k, k] *= 1.0 + damping
        whole[G, G] *= 1.0 + damping
        inverse: FloatArray = np.asarray(np.linalg.inv(local), dtype=np.float64)
        S = whole - np.tensordot(self.mixed, inverse @ self.mixed, axes=((0, 1), (0, 1)))
        return inverse, 0.5 * (S + S.T)


def _normal(network: Network, state: State, origin: State, weight: FloatArray) -> _Normal:
    s = network.sightings
    e, by_global, by_local = jacobians(network, state)
    w = weight / s.sigma_px**2
    H, g, _ = _prior(network, state, origin)
    weighted = by_local * w[:, None, None]
    local = s.per_view(weighted.swapaxes(1, 2) @ by_local)
    gradient = s.per_view(np.einsum("nij,ni->nj", weighted, e))
    if network.gantry is not None:
        information = network.gantry.station_sigma_m**-2.0
        local = local + information * np.eye(3)
        gradient = gradient - information * state.stops_m
    return _Normal(
        local,
        s.per_view(weighted.swapaxes(1, 2) @ by_global),
        H + np.tensordot(by_global * w[:, None, None], by_global, axes=((0, 1), (0, 1))),
        gradient,
        g + np.einsum("nij,ni,n->j", by_global, e, w),
        _cost(network, state, origin, weight, e) if np.isfinite(e).all() else np.inf,
    )


def _cost(network: Network, state: State, origin: State, weight: FloatArray, e: FloatArray) -> float:
    cost = _prior(network, state, origin)[2] + float(((e / network.sightings.sigma_px[:, None]) ** 2).sum(1) @ weight)
    if network.gantry is not None:
        cost += float((state.stops_m**2).sum()) / network.gantry.station_sigma_m**2
    return cost


def adjust(network: Network, start: State, weight: FloatArray | None = None) -> tuple[State, float]:
    """Least squares over all unknowns.

    Args:
        network: What is adjusted.
        start: Start, and what the lens prior is centred on.
        weight: Factor of each sighting's weight, shape (N,); 1 when None.

    Returns:
        The minimum and its cost (whitened sum of squares with priors).

    Raises:
        CalibrationError: The start does not see its points.
    """
    weight = np.ones(len(network.sightings.px)) if weight is None else weight
    state = start
    normal = _normal(network, state, start, weight)
    if not np.isfinite(normal.cost):
        raise CalibrationError("the start of the adjustment does not see all points")
    damping, growth = 1e-4, 2.0
    for _ in range(_MAX_ITERATIONS):
        try:
            inverse, S = normal.reduced(damping)
            carried = np.einsum("vij,vj->vi", inverse, normal.gradient_local)
            rhs = normal.gradient_whole - np.einsum("vij,vi->j", normal.mixed, carried)
            scale = 1.0 / np.sqrt(np.diag(normal.whole))
            step = scale * np.linalg.solve(scale[:, None] * S * scale, scale * rhs)
            local = carried - np.einsum("vij,vj->vi", inverse, normal.mixed @ step)
            candidate = state.moved(network, step, local)
            e = residuals_px(network, candidate)
            cost = _cost(network, candidate, start, weight, e) if np.isfinite(e).all() else np.inf
        except (np.linalg.LinAlgError, CalibrationError, ValueError):
            cost = np.inf
        if cost <= normal.cost:
            gain = (normal.cost - cost) / max(normal.cost, 1e-300)
            state = candidate
            damping, growth = max(damping / 10.0, 1e-14), 2.0
            # What is left is below a thousandth of a deviation.
            if gain < 1e-11 or cost < 1e-16:
                return state, cost
            normal = _normal(network, state, start, weight)
        else:
            damping, growth = damping * growth, growth * 2.0
            if damping > 1e10:
                break
    return state, normal.cost


@dataclass(frozen=True, slots=True, eq=False)
class Doubt:
    """Covariance at a minimum and how much each sighting decides.

    Args:
        covariance: Covariance of the global unknowns; along the gauge it means nothing, shape (G, G).
        leverage: Share of each pixel component that the fit takes for itself, shape (N, 2), between 0 and 1.
        condition: Condition number of the information, scaled to a unit diagonal.
    """

    covariance: FloatArray
    leverage: FloatArray
    condition: float


def doubt(network: Network, state: State, weight: FloatArray | None = None) -> Doubt:
    """Covariance and leverages.

    Args:
        network: The network.
        state: Its minimum.
        weight: As for ``adjust``.

    Returns:
        The doubt.

    Raises:
        CalibrationError: The sightings leave something open.
    """
    s = network.sightings
    weight = np.ones(len(s.px)) if weight is None else weight
    try:
        inverse, S = _normal(network, state, state, weight).reduced(0.0)
    except np.linalg.LinAlgError:
        raise CalibrationError("a view of the adjustment leaves its own pose open") from None
    scale = 1.0 / np.sqrt(np.abs(np.diag(S)))
    values, vectors = np.linalg.eigh(scale[:, None] * S * scale)
    if not values[0] > 1e-13 * values[-1]:
        raise CalibrationError("the views leave a direction of the LED positions open")
    covariance = scale[:, None] * ((vectors / values) @ vectors.T) * scale
    _, by_global, by_local = jacobians(network, state)
    w = weight / s.sigma_px**2
    mixed = s.per_view((by_local * w[:, None, None]).swapaxes(1, 2) @ by_global)
    free = by_global - by_local @ (inverse @ mixed)[s.view]
    leverage = np.einsum("nij,njk,nik->ni", by_local, inverse[s.view], by_local)
    leverage = leverage + np.einsum("nij,jk,nik->ni", free, covariance, free)
    return Doubt(covariance, np.clip(leverage * w[:, None], 0.0, 1.0), float(values[-1] / values[0]))


def with_sigma(network: Network, sigma_px: FloatArray) -> Network:
    """The network with other pixel deviations, shape (N,), px."""
    return replace(network, sightings=replace(network.sightings, sigma_px=sigma_px))
