"""Advice on a procedure: how many places, where, and in which order, for an interval one would like to have.

Places are spread evenly over what the gantry reaches and the camera sees. Procedures of growing length are simulated
on benches like this one, each judged as a run would be, until nine benches of ten give the wanted interval.

Source: J. H. Halton, On the efficiency of certain quasi-random sequences of points (1960).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from uvgs_bench.accuracy import error_table, fit_registration
from uvgs_bench.accuracy.bench_model import predicted
from uvgs_bench.accuracy.blind_bench import BlindBench, PlannedStations, observe
from uvgs_bench.accuracy.centroid_noise import LearnedNoise, learn_noise
from uvgs_bench.accuracy.judgement import QUANTITIES
from uvgs_bench.accuracy.observations import Mount, Observations
from uvgs_bench.accuracy.statistics import AccuracySummary, Estimate, summarise
from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.bench import Bench
from uvgs_bench.devices.gantry.axes import Axis, gantry_from_carriage
from uvgs_bench.errors import EnvelopeError, PlanError, RegistrationError, RunError
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.sessions.events import EventSink, StageAdvanced, StageFinished, StageStarted
from uvgs_bench.sessions.patterns import Waypoints, position_key
from uvgs_bench.sessions.planning import Plan, plan
from uvgs_bench.sessions.procedure import Procedure
from uvgs_bench.store.observations import observations_from_run
from uvgs_bench.store.run import read_run
from uvgs_bench.units import deg_from_rad, m_from_mm, mm_from_m, mps_from_mm_min

PLANNABLE = tuple(
    name
    for name, (component, statistic, _) in QUANTITIES.items()
    if statistic in ("rms", "p95") and component != "quantity"
)
"""Quantities an interval can be wanted of."""
FEED_MM_MIN = 3000.0
SETTLE_S = 0.3
OVERSHOOT_MM = 1.0
REFERENCE_EVERY = 10
# What a third of them, registering, leaves to judge must be more than intervals need at all.
_PLACES = (18, 27, 36, 54, 72, 108, 144, 216, 288)
_SHOTS = (1, 3)
_TRIALS = 8
_CONFIRMATIONS = 30
_CHANCE = 0.9
_LOOKED_AT = 3000
_LEAST_SEEN = 0.02
_EDGE_PX = 10.0


@dataclass(frozen=True, slots=True)
class Wish:
    """What is wanted, and what the sensor is taken to be.

    Args:
        quantity: One of ``PLANNABLE``.
        half_width: Half of the 95 % interval that is wanted, in the quantity's unit, mm or deg.
        centroid_sigma_px: Standard deviation of each centroid coordinate, new in every capture, px.
        place_sigma_px: The same for what all captures of a place share, px.
        source: Where the two are known from, in words; empty when they were assumed or given.
    """

    quantity: str
    half_width: float
    centroid_sigma_px: float
    place_sigma_px: float
    source: str = ""


@dataclass(frozen=True, slots=True)
class Forecast:
    """What simulated benches say of a procedure, in the unit of the quantity.

    Args:
        value: The figure, typically.
        half_width: Half of its interval, typically; inf when the data cannot bound it.
        half_width_most: Half of its interval in the worst tenth of benches.
        reached: Benches whose interval is as narrow as wanted.
        benches: Number of benches.
        availability: Part of the captures with a pose.
        registration_share: Part of the squared errors that comes from the registration.
    """

    value: float
    half_width: float
    half_width_most: float
    reached: int
    benches: int
    availability: float
    registration_share: float


@dataclass(frozen=True, slots=True, eq=False)
class Advice:
    """A procedure with what to expect of it.

    Args:
        plan: The procedure, checked on the bench.
        forecast: What benches that played no part in the choice say of it.
        seen_share: Part of the gantry's reach where the camera sees all LEDs.
        range_min_m: Smallest distance of the beacon, m.
        range_max_m: Largest, m.
    """

    plan: Plan
    forecast: Forecast
    seen_share: float
    range_min_m: float
    range_max_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """What a first run teaches for planning the next.

    Args:
        noise: Noise of the sensor.
        poses: Left and right pose of the run's registration.
        words: Where both come from, one line.
    """

    noise: LearnedNoise
    poses: tuple[Pose, Pose]
    words: str


def learned_from(path: Path, mount: Mount) -> Learned:
    """Learn noise and registration from a run.

    Args:
        path: The run folder.
        mount: Which part rides the carriage on the bench that is planned for.

    Returns:
        What was learned.

    Raises:
        RunError: The run is unreadable, or of a bench with the other mount.
        RegistrationError: Too few stations with a pose.
    """
    run = read_run(path)
    if run.manifest.mount != mount:
        raise RunError(f"has {run.manifest.mount}, the bench has {mount}", str(path))
    obs = observations_from_run(run)
    found = fit_registration(obs, gantry_sigma_m=run.manifest.gantry_sigma_m, nominal=run.manifest.mounted)
    noise = learn_noise(obs, found, run.calibration.lens, run.beacon.positions_m)
    words = f"learned from {noise.visit_count} stations of {run.manifest.id}"
    if not noise.is_parted:
        words += "; one capture a station does not part the two"
    return Learned(noise, (found.left, found.right), words)


def advise(
    bench: Bench, lens: Lens, beacon: Beacon, poses: tuple[Pose, Pose], wish: Wish, seed: int, sink: EventSink
) -> Advice:
    """Propose the shortest procedure that gives the wanted interval on nine benches of ten.

    Args:
        bench: The bench.
        lens: The camera's lens.
        beacon: The beacon.
        poses: Left and right pose of its registration, as in ``Registration``.
        wish: What is wanted.
        seed: Seed of places and simulated benches.
        sink: Where progress goes.

    Returns:
        The procedure and its forecast.

    Raises:
        PlanError: The camera sees the beacon nearly nowhere, or no procedure of up to 288 places is long enough.
        EnvelopeError: The paths between the places touch a keep-out box.
    """
    places, seen_share = _places(bench, lens, beacon, poses, seed)
    simulated = BlindBench(
        lens,
        beacon.positions_m,
        *poses,
        mount=bench.mount,
        centroid_sigma_px=wish.centroid_sigma_px,
        place_sigma_px=wish.place_sigma_px,
        gantry_repeatability_m=bench.position_sigma_m,
    )
    sink(StageStarted("procedures"))
    best, tried = None, 0
    options: list[Plan] = []
    for shots in _SHOTS:
        lengths = [
            plan(_procedure(places[:count], bench.envelope.axes, shots, wish, seed), bench.envelope)
            for count in _PLACES
            if count <= len(places)
        ]
        # More places never widen an interval but by chance, so halving finds the first that is narrow enough.
        low, high = 0, len(lengths)
        while low < high:
            middle = (low + high) // 2
            sink(StageAdvanced("procedures", tried, _words(lengths[middle])))
            found = _forecast(lengths[middle], simulated, bench, wish, (seed, tried, 0), _TRIALS)
            tried += 1
            best = found if best is None else min(best, found, key=lambda forecast: forecast.half_width_most)
            low, high = (low, middle) if found.half_width_most <= wish.half_width else (middle + 1, high)
        options += lengths[low:]
    for candidate in sorted(options, key=lambda option: option.duration_s):
        sink(StageAdvanced("procedures", tried, _words(candidate)))
        # The choice is the luckiest of several trials; benches of their own tell what it is worth.
        found = _forecast(candidate, simulated, bench, wish, (seed, tried, 1), _CONFIRMATIONS)
        tried += 1
        best = found if best is None else min(best, found, key=lambda forecast: forecast.half_width_most)
        if found.reached >= _CHANCE * _CONFIRMATIONS:
            sink(StageFinished("procedures", _words(candidate)))
            ranges_m = np.linalg.norm(_seen_from(bench, poses, places[: candidate.waypoint_count])[1], axis=1)
            return Advice(candidate, found, seen_share, float(ranges_m.min()), float(ranges_m.max()))
    unit = QUANTITIES[wish.quantity][2]
    tells = (
        "no procedure could be tried"
        if best is None
        else (
            f"the best of these procedures gives {best.half_width_most:.3g} {unit} in the worst tenth of benches, "
            f"with the figure at {best.value:.3g} {unit}"
        )
    )
    raise PlanError(
        f"half an interval of {wish.half_width:g} {unit} of {wish.quantity} cannot be had with up to "
        f"{min(len(places), _PLACES[-1])} places: {tells}"
    )


def _words(candidate: Plan) -> str:
    shots = candidate.procedure.captures_per_station
    return f"{candidate.waypoint_count} places, {shots} capture{'s' if shots > 1 else ''} each"


def procedure_tables(advice: Advice, wish: Wish) -> dict[str, object]:
    """The procedure as a file says it.

    Args:
        advice: The advice.
        wish: What was wanted, for the description.

    Returns:
        Keys to plain values, for ``toml_text``; ``read_procedure`` reads the same procedure.
    """
    procedure, forecast = advice.plan.procedure, advice.forecast
    assert isinstance(procedure.pattern, Waypoints)
    assert isinstance(procedure.register, tuple)
    unit = QUANTITIES[wish.quantity][2]
    return {
        "schema": 1,
        "name": procedure.name,
        "description": (
            f"Proposed for half an interval of {wish.half_width:g} {unit} of {wish.quantity}; simulated benches with "
            f"{wish.centroid_sigma_px:g} px centroid noise reached it in {forecast.reached} of {forecast.benches}."
        ),
        "pattern": "waypoints",
        "feed_mm_min": FEED_MM_MIN,
        "settle_s": procedure.settle_s,
        "captures_per_station": procedure.captures_per_station,
        "order": procedure.order,
        "register": list(procedure.register),
        "reference_every": procedure.reference_every,
        "seed": procedure.seed,
        "approach": {"kind": procedure.approach},
        "waypoints": {"at": procedure.pattern.at},
    }


def _places(bench: Bench, lens: Lens, beacon: Beacon, poses: tuple[Pose, Pose], seed: int) -> tuple[FloatArray, float]:
    """Places the gantry reaches and the camera sees, any first of them evenly spread, shape (n, A), m or rad."""
    from scipy.stats import qmc

    axes = bench.envelope.axes
    lower = np.array([axis.lower for axis in axes])
    upper = np.array([axis.upper for axis in axes])
    # The last move begins below the target.
    lower = lower + np.array(
        [max(m_from_mm(OVERSHOOT_MM), 2.0 * a.backlash) if a.kind == "linear" else 0.02 for a in axes]
    )
    rng = np.random.default_rng([seed, 1])
    unit = qmc.Halton(len(axes), scramble=True, rng=rng).random(_LOOKED_AT)
    at = lower + unit * (upper - lower)
    is_seen = _is_seen(bench, lens, beacon, poses, at)
    for k, position in enumerate(at):
        if is_seen[k] and bench.envelope.keep_out:
            try:
                bench.envelope.check_point(position)
            except EnvelopeError:
                is_seen[k] = False
    seen_share = float(is_seen.mean())
    if seen_share < _LEAST_SEEN:
        raise PlanError(
            f"the camera sees all LEDs in {100.0 * seen_share:.1f} % of what the gantry reaches: "
            "move camera or gantry, or turn the beacon to the camera"
        )
    chosen = at[is_seen][: _PLACES[-1]]
    return read_only(chosen), seen_share


def _seen_from(bench: Bench, poses: tuple[Pose, Pose], at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """camera_from_beacon at carriage positions: rotations (n, 3, 3) and translations (n, 3), m."""
    carriage = [gantry_from_carriage(bench.envelope.axes, position) for position in at]
    if bench.mount == "camera_on_carriage":
        carriage = [pose.inverse() for pose in carriage]
    return predicted(*poses, np.array([pose.R for pose in carriage]), np.array([pose.t_m for pose in carriage]))


def _is_seen(
    bench: Bench, lens: Lens, beacon: Beacon, poses: tuple[Pose, Pose], at: FloatArray
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    R, t = _seen_from(bench, poses, at)
    seen = np.ones(len(at), dtype=np.bool_)
    for led in beacon.leds:
        point = R @ led.position_m + t
        seen &= point[:, 2] > 0.0
        seen[seen] &= lens.contains(lens.project(point[seen]), _EDGE_PX)
        if led.axis is not None and led.half_angle_rad is not None:
            towards = -point / np.linalg.norm(point, axis=1, keepdims=True)
            seen &= np.einsum("ni,ni->n", R @ led.axis, towards) > np.cos(led.half_angle_rad)
    return seen


def _procedure(places: FloatArray, axes: tuple[Axis, ...], shots: int, wish: Wish, seed: int) -> Procedure:
    convert = [mm_from_m if axis.kind == "linear" else deg_from_rad for axis in axes]
    at = [
        {position_key(axis): round(float(to(value)), 3) for axis, to, value in zip(axes, convert, row, strict=True)}
        for row in places
    ]
    # Neither every third nor a run of neighbours: the order of a Halton sequence goes with the place.
    rng = np.random.default_rng([seed, 2])
    return Procedure(
        name=f"planned_{wish.quantity}",
        pattern=Waypoints(at),
        feed_mps=mps_from_mm_min(FEED_MM_MIN),
        settle_s=SETTLE_S,
        captures_per_station=shots,
        order="shuffled",
        register=tuple(sorted(rng.permutation(len(places))[: len(places) // 3].tolist())),
        reference_every=REFERENCE_EVERY,
        seed=seed,
        approach="from_below",
    )


def _forecast(
    candidate: Plan, simulated: BlindBench, bench: Bench, wish: Wish, key: tuple[int, int, int], benches: int
) -> Forecast:
    stations = _stations(candidate, bench)
    halves, values, solved, shares = [], [], [], []
    component, statistic, unit = QUANTITIES[wish.quantity]
    in_unit = mm_from_m(1.0) if unit == "mm" else deg_from_rad(1.0)
    for number in range(benches):
        rng = np.random.default_rng([*key, number])
        obs = observe(simulated, stations, rng)
        solved.append(float(obs.is_solved.mean()))
        summary = _summary(obs, bench.position_sigma_m, rng)
        if summary is None:
            halves.append(np.inf)
            continue
        found = cast("Estimate", getattr(summary.components[component], statistic))
        halves.append(0.5 * (found.high - found.low) * in_unit)
        values.append(found.value * in_unit)
        rms = summary.components[component].rms.value
        share = summary.registration_share_m if unit == "mm" else summary.registration_share_rad
        shares.append(min((share / rms) ** 2, 1.0))
    widths = np.sort(halves)
    return Forecast(
        value=float(np.median(values)) if values else float("nan"),
        half_width=float(widths[benches // 2]),
        half_width_most=float(widths[min(int(np.ceil(_CHANCE * benches)), benches) - 1]),
        reached=int((widths <= wish.half_width).sum()),
        benches=benches,
        availability=float(np.mean(solved)),
        registration_share=float(np.median(shares)) if shares else float("nan"),
    )


def _summary(obs: Observations, sigma_m: float, rng: np.random.Generator) -> AccuracySummary | None:
    registers = obs.has_role("register")
    try:
        registration = fit_registration(obs.select(registers), gantry_sigma_m=sigma_m)
    except RegistrationError:
        return None
    return summarise(error_table(obs.select(~registers), registration), rng)


def _stations(candidate: Plan, bench: Bench) -> PlannedStations:
    """The visits of a plan as the simulated bench takes them."""
    visits = candidate.stations
    S = len(visits)
    carriage = [gantry_from_carriage(bench.envelope.axes, visit.target) for visit in visits]
    return PlannedStations(
        position_m=read_only(np.array([pose.t_m for pose in carriage])),
        velocity_mps=read_only(np.zeros((S, 3))),
        approach=np.ones((S, 3), dtype=np.int8),
        t_s=read_only(np.arange(S) * candidate.duration_s / S),
        shots=np.full(S, candidate.procedure.captures_per_station, dtype=np.int64),
        place=np.array([visit.waypoint for visit in visits], dtype=np.int64),
        role=tuple(visit.role for visit in visits),
        session=np.zeros(S, dtype=np.int64),
        R_gs=read_only(np.array([pose.R for pose in carriage])),
    )
