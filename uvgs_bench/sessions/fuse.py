"""Fuse: hand everything to a method in the order it became known, and keep what the method said at each instant."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from time import process_time_ns
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.errors import ConfigError, RunError
from uvgs_bench.geometry import read_only
from uvgs_bench.navigation.ar_swap import ArSwap, AstroLocSettings
from uvgs_bench.navigation.error_state_filter import (
    POSE_ROWS,
    ErrorStateFilter,
    FilterConfig,
    UpdateRecord,
    start_state,
)
from uvgs_bench.navigation.fusion_data import BOTH, METHODS, FusionInput, FusionResult, Method
from uvgs_bench.navigation.imu import fit_static_bias
from uvgs_bench.navigation.states import NavigationState, PoseMeasurement
from uvgs_bench.units import NS_PER_S, NS_PER_US, ns_from_s

_OUTPUT_HZ = 20.0
# Of so many poses at the beginning one far from the median of all, m, is no place to begin.
_FIRST_POSES, _STRAY_M = 7, 0.02


@dataclass(frozen=True, slots=True)
class FusionOptions:
    """How to fuse.

    Args:
        gate_chi2: Largest squared Mahalanobis distance of a pose that is believed, 6 degrees of freedom.
        smooth: Whether to smooth afterwards (filter only).
        factors: Whether the graph gets ``pose`` or ``led`` factors of the sensor.
        learn_beacon: Whether the graph treats the beacon's place as a variable.
        min_num_matches: Fewest LEDs the AR pipeline accepts.
    """

    gate_chi2: float = 16.8119
    smooth: bool = False
    factors: Literal["pose", "led"] = "pose"
    learn_beacon: bool = False
    min_num_matches: int = 4


def fuse(
    source: FusionInput,
    method: Method = "filter",
    sources: tuple[str, ...] = BOTH,
    options: FusionOptions | None = None,
) -> FusionResult:
    """Fuse a mission.

    Args:
        source: The input.
        method: ``filter``, ``graph`` or ``ar_swap``.
        sources: Whose poses to use: ``uvgs``, ``native``.
        options: How.

    Returns:
        What the method said.

    Raises:
        ConfigError: The method is unknown, or its extra is not installed.
        RunError: There is nothing to begin with: no pose, or no readings where the method needs them.
    """
    chosen = FusionOptions() if options is None else options
    if method == "filter":
        return _by_filter(source, sources, chosen)
    if method == "ar_swap":
        return _by_swap(source, sources, chosen)
    if method == "graph":
        from uvgs_bench.sessions.fuse_graph import fuse_by_graph

        return fuse_by_graph(source, sources, chosen)
    raise ConfigError(f"unknown method '{method}', expected one of {', '.join(METHODS)}", "--method")


def first_state(source: FusionInput, sources: tuple[str, ...]) -> NavigationState:
    """Where the filter begins: at the last pose of the rest at the start, with biases measured over that rest.

    Raises:
        RunError: There is no pose, or no reading.
    """
    known = sorted(source.measurements(sources), key=lambda m: m.t_ns)
    if not known:
        raise RunError(f"no pose of {' or '.join(sources)} to begin with", source.name)
    if len(source.imu) < 2:
        raise RunError(
            "no readings of an inertial unit, which this method needs; --method ar_swap needs none", source.name
        )
    begin_ns = int(source.imu.t_ns[0])
    end_ns = begin_ns + ns_from_s(source.rest_s)
    resting = [m for m in known if m.t_ns <= end_ns]
    first = _unstrayed(resting)[-1] if resting else _unstrayed(known[:_FIRST_POSES])[0]
    if source.rest_s <= 0.0 or first.t_ns > end_ns:
        return start_state(first)
    sigma_rad = float(np.sqrt(np.diag(first.covariance)[:3].max()))
    readings = source.imu.between(begin_ns, end_ns)
    if len(readings) < 2:
        return start_state(first)
    bias = fit_static_bias(readings, source.noise, first.world_from_body.R, sigma_rad, source.gravity_mps2)
    if not bias.is_still:
        return start_state(first)
    return start_state(
        first,
        velocity_sigma_mps=0.01,
        acceleration_bias_sigma_mps2=float(bias.acceleration_sigma_mps2.max()),
        rate_bias_sigma_radps=float(bias.rate_sigma_radps.max()),
        acceleration_bias_mps2=bias.acceleration_bias_mps2,
        rate_bias_radps=bias.rate_bias_radps,
    )


def _unstrayed(poses: list[PoseMeasurement]) -> list[PoseMeasurement]:
    """Poses without those that stand far from the median of all: it must not begin at a false one."""
    places = np.array([pose.world_from_body.t_m for pose in poses])
    off = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    limit = max(_STRAY_M, 5.0 * float(np.median(off)))
    return [pose for pose, far in zip(poses, off > limit, strict=True) if not far]


def output_instants(source: FusionInput, start_ns: int) -> NDArray[np.int64]:
    """When a state is asked for: evenly, from the start to the end of the data, ns."""
    last = [int(source.imu.t_ns[-1])] if len(source.imu) else []
    last += [p.t_ns for p in source.sensed[-1:]] + [m.t_ns for m in source.native[-1:]]
    step_ns = round(NS_PER_S / _OUTPUT_HZ)
    return np.arange(start_ns + step_ns, max(last) + 1, step_ns, dtype=np.int64)


def filter_config(source: FusionInput, options: FusionOptions) -> FilterConfig:
    """Parameters of the filter for an input."""
    x, y, z = (float(v) for v in source.gravity_mps2)
    return FilterConfig(noise=source.noise, gravity_mps2=(x, y, z), gate_chi2=options.gate_chi2)


def in_order(
    source: FusionInput, measurements: tuple[PoseMeasurement, ...], outputs: NDArray[np.int64], start_ns: int
) -> Iterator[tuple[int, int, PoseMeasurement | int | None]]:
    """Readings (their number), poses and wishes for a state (None), each with its instant, as they became known."""
    events: list[tuple[int, int, PoseMeasurement | int | None]] = []
    events += [(int(t), 0, k) for k, t in enumerate(source.imu.t_ns)]
    events += [(m.t_ns + m.delay_ns, 1, m) for m in measurements if m.t_ns > start_ns]
    events += [(int(t), 2, None) for t in outputs]
    events.sort(key=lambda event: event[:2])
    yield from events


def _by_filter(source: FusionInput, sources: tuple[str, ...], options: FusionOptions) -> FusionResult:
    start = first_state(source, sources)
    config = filter_config(source, options)
    estimator = ErrorStateFilter(start, config)
    measurements = source.measurements(sources)
    outputs = output_instants(source, start.t_ns)
    states: list[NavigationState] = []
    updates: list[UpdateRecord] = []
    spent: list[int] = []
    believed: list[PoseMeasurement] = []
    for _, _, what in in_order(source, measurements, outputs, start.t_ns):
        if isinstance(what, int):
            t_ns = int(source.imu.t_ns[what])
            estimator.add_imu(t_ns, source.imu.acceleration_mps2[what], source.imu.rate_radps[what])
        elif what is None:
            states.append(estimator.state)
        else:
            begin = process_time_ns()
            record = estimator.add_pose(what)
            spent.append(process_time_ns() - begin)
            updates.append(record)
            if record.status in ("fused", "reopened"):
                believed.append(what)
    if options.smooth:
        from uvgs_bench.navigation.smoother import smooth

        instants = np.array([state.t_ns for state in states], dtype=np.int64)
        states = list(smooth(start, source.imu, believed, instants, config))
    return FusionResult(
        "filter",
        sources,
        tuple(states),
        tuple(updates),
        read_only(np.array(spent, dtype=np.float64) / NS_PER_US),
        tuple(estimator.gaps_s),
        is_smoothed=options.smooth,
    )


def _by_swap(source: FusionInput, sources: tuple[str, ...], options: FusionOptions) -> FusionResult:
    learns = "native" in sources and bool(source.native)
    settings = AstroLocSettings(min_num_matches=options.min_num_matches)
    swap = ArSwap(
        source.body_from_camera,
        source.leds_m,
        source.focal_px,
        None if learns else source.world_from_beacon,
        settings,
    )
    known = source.measurements(sources)
    if not known:
        raise RunError(f"no pose of {' or '.join(sources)} to begin with", source.name)
    sensed = {pose.t_ns: pose for pose in source.sensed}
    start_ns = min(m.t_ns for m in known)
    outputs = output_instants(source, start_ns)
    updates: list[UpdateRecord] = []
    spent: list[int] = []
    states: list[NavigationState] = []
    lost: list[int] = []
    events: list[tuple[int, int, PoseMeasurement | None]] = [(m.t_ns + m.delay_ns, 1, m) for m in known]
    events += [(int(t), 2, None) for t in outputs]
    for t_ns, _, what in sorted(events, key=lambda event: event[:2]):
        if what is None:
            said = swap.state_at(t_ns)
            if said is None:
                lost.append(t_ns)
                continue
            P = np.zeros((15, 15))
            P[np.ix_(POSE_ROWS, POSE_ROWS)] = said.covariance
            zero = read_only(np.zeros(3))
            states.append(NavigationState(t_ns, said.world_from_body, said.velocity_mps, zero, zero, read_only(P)))
            continue
        begin = process_time_ns()
        reason = swap.add_sensed(sensed[what.t_ns]) if what.source == "uvgs" else swap.add_native(what)
        spent.append(process_time_ns() - begin)
        status: Literal["fused", "refused"] = "fused" if reason == "fused" else "refused"
        nothing = read_only(np.full(6, np.nan))
        updates.append(UpdateRecord(what.t_ns, what.source, status, np.nan, what.delay_ns / NS_PER_S, nothing))
    return FusionResult(
        "ar_swap",
        sources,
        tuple(states),
        tuple(updates),
        read_only(np.array(spent, dtype=np.float64) / NS_PER_US),
        lost_ns=tuple(lost),
    )
