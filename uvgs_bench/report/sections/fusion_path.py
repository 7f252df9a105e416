"""The path in the plane and over time, with what the native localiser alone makes of it."""

from __future__ import annotations

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.navigation.fusion_outcome import FusedRun, FusionOutcome
from uvgs_bench.report.document import Figure, Section
from uvgs_bench.report.figures import canvas, legend_above, series, style, svg_of, thinned
from uvgs_bench.report.palette import BLUE, FAINT, GREEN, ORANGE, RULE

_AXES = ("x", "y", "z")
# The truth is drawn at so many instants.
_TRUE_POINTS = 400


def build(outcome: FusionOutcome) -> Section | None:
    """Drawings; nothing without states."""
    if len(outcome.main.result.states) < 2:
        return None
    alone = next((run for run in outcome.runs if run.name == "native alone"), None)
    figures = [_plane(outcome, alone), _over_time(outcome, alone)]
    if outcome.source.truth is not None:
        figures.append(_errors(outcome))
    return Section("path", "The path", tuple(figures))


def _places(run: FusedRun) -> FloatArray:
    return np.array([state.world_from_body.t_m for state in run.result.states]).reshape(-1, 3)


def _truth(outcome: FusionOutcome) -> tuple[FloatArray, FloatArray]:
    """Instants (s, as in the scores) and true places; empty without truth."""
    truth, states = outcome.source.truth, outcome.main.result.states
    if truth is None:
        return np.empty(0), np.empty((0, 3))
    shown = np.unique(np.linspace(0, len(states) - 1, _TRUE_POINTS).astype(int))
    places = np.array([truth(states[k].t_ns).pose.t_m for k in shown])
    return outcome.main.score.t_s[shown], places


def _sensed(outcome: FusionOutcome) -> tuple[FloatArray, FloatArray]:
    """Instants and places of the body by the sensor alone."""
    source, main = outcome.source, outcome.main
    begin_ns = main.result.states[0].t_ns - round(1e9 * float(main.score.t_s[0]))
    poses = [source.sensed[int(k)] for k in thinned(len(source.sensed))]
    t_s = np.array([(pose.t_ns - begin_ns) / 1e9 for pose in poses])
    return t_s, np.array([source.measured(pose).world_from_body.t_m for pose in poses]).reshape(-1, 3)


def _plane(outcome: FusionOutcome, alone: FusedRun | None) -> Figure:
    key = "fusion-plane"
    fused, (_, true) = _places(outcome.main), _truth(outcome)
    frame = true if len(true) else fused
    a, b = sorted(np.argsort(-np.ptp(frame, axis=0), kind="stable")[:2].tolist())
    shown = thinned(len(fused))
    alt = (
        f"The path in the plane of {_AXES[a]} and {_AXES[b]}, {np.ptp(frame[:, a]):.2f} m by "
        f"{np.ptp(frame[:, b]):.2f} m, as fused"
    )
    if alone is not None and len(alone.score.error):
        alt += f"; by the native localiser alone it leaves the true one by up to {alone.score.worst_m:.3f} m"
    data = []
    with style(key):
        figure = canvas(4.2)
        axes = figure.add_subplot()
        if alone is not None:
            places = _places(alone)
            few = thinned(len(places))
            axes.plot(places[few, a], places[few, b], color=ORANGE, lw=0.9, label="native alone")
            data += [series(f"native alone {_AXES[k]}", "m", places[:, k]) for k in (a, b)]
        axes.plot(fused[shown, a], fused[shown, b], color=BLUE, lw=1.2, label="fused")
        data += [series(f"fused {_AXES[k]}", "m", fused[:, k]) for k in (a, b)]
        if len(true):
            axes.plot(true[:, a], true[:, b], color=GREEN, lw=1.2, ls="--", label="true")
            data += [series(f"true {_AXES[k]}", "m", true[:, k]) for k in (a, b)]
        axes.set_xlabel(f"{_AXES[a]} (m)")
        axes.set_ylabel(f"{_AXES[b]} (m)")
        axes.set_aspect("equal", adjustable="box")
        span = max(float(np.ptp(frame[:, a])), float(np.ptp(frame[:, b])), 0.02)
        for values, limit in ((frame[:, a], axes.set_xlim), (frame[:, b], axes.set_ylim)):
            half = max(0.5 * float(np.ptp(values)) + 0.15 * span, 0.3 * span)
            middle = 0.5 * float(values.min() + values.max())
            limit(middle - half, middle + half)
        legend_above(axes, 3)
        svg = svg_of(figure, key, f"{alt}.")
    return Figure(key, svg, f"{alt}.", "The path of the body in the world, as the paper's Figure 23.", tuple(data))


def _over_time(outcome: FusionOutcome, alone: FusedRun | None) -> Figure:
    key = "fusion-time"
    t_s, fused = outcome.main.score.t_s, _places(outcome.main)
    (t_true_s, true), (t_sensed_s, sensed) = _truth(outcome), _sensed(outcome)
    shown = thinned(len(t_s))
    spans = ", ".join(f"{name} by {np.ptp(fused[:, k]):.2f} m" for k, name in enumerate(_AXES))
    alt = f"Position over {t_s[-1] - t_s[0]:.0f} s: {spans}; {len(outcome.main.score.pauses)} pauses of the sensor."
    with style(key):
        figure = canvas(5.4)
        panels = figure.subplots(3, 1, sharex=True)
        for k, (axes, name) in enumerate(zip(panels, _AXES, strict=True)):
            _shade_starved(axes, outcome)
            if alone is not None:
                places = _places(alone)
                few = thinned(len(places))
                axes.plot(alone.score.t_s[few], places[few, k], color=ORANGE, lw=0.9, label="native alone")
            axes.plot(t_sensed_s, sensed[:, k], ".", color=FAINT, ms=2.4, label="sensor alone")
            axes.plot(t_s[shown], fused[shown, k], color=BLUE, lw=1.2, label="fused")
            if len(true):
                axes.plot(t_true_s, true[:, k], color=GREEN, lw=1.2, ls="--", label="true")
            low, high = float(fused[:, k].min()), float(fused[:, k].max())
            room = 0.15 * max(high - low, 0.02)
            axes.set_ylim(low - room, high + room)
            axes.set_ylabel(f"{name} (m)")
        panels[-1].set_xlabel("time (s)")
        legend_above(panels[0], 4)
        svg = svg_of(figure, key, alt)
    data = [series("time", "s", t_s)]
    data += [series(f"fused {name}", "m", fused[:, k]) for k, name in enumerate(_AXES)]
    said = "Position over time, as the paper's Figure 19; what leaves the frame goes on outside it."
    if outcome.source.starved_ns:
        said += " Grey: the native localiser has too few landmarks."
    return Figure(key, svg, alt, said, tuple(data))


def _shade_starved(axes: object, outcome: FusionOutcome) -> None:
    from matplotlib.axes import Axes

    assert isinstance(axes, Axes)
    main = outcome.main
    begin_ns = main.result.states[0].t_ns - round(1e9 * float(main.score.t_s[0]))
    instants = np.array([t_ns for t_ns, _ in outcome.source.starved_ns], dtype=np.float64)
    for t_s in (instants - begin_ns) / 1e9:
        axes.axvspan(t_s - 0.6, t_s + 0.6, color=RULE, lw=0.0)


def _errors(outcome: FusionOutcome) -> Figure:
    key = "fusion-errors"
    worst = ", ".join(f"{run.name} {run.score.worst_m:.2g} m" for run in outcome.runs)
    alt = f"Errors of position over time on a logarithmic scale; the worst are: {worst}."
    data = []
    with style(key):
        figure = canvas(3.6)
        axes = figure.add_subplot()
        others = iter((GREEN, FAINT))
        for run in reversed(outcome.runs):
            t_s, distance = run.score.t_s, run.score.distance_m
            shown = thinned(len(t_s))
            is_native = run.name == "native alone"
            colour = BLUE if run is outcome.main else ORANGE if is_native else next(others)
            axes.semilogy(t_s[shown], np.maximum(distance[shown], 1e-6), color=colour, lw=1.0, label=run.name)
            data += [series(f"{run.name} time", "s", t_s), series(f"{run.name} error", "m", distance)]
        sigma = np.linalg.norm(outcome.main.score.sigma[:, :3], axis=1)
        shown = thinned(len(sigma))
        axes.semilogy(outcome.main.score.t_s[shown], sigma[shown], color=BLUE, lw=0.8, ls=":", label="fused, stated")
        for p in outcome.main.score.pauses:
            begin_ns = outcome.main.result.states[0].t_ns - round(1e9 * float(outcome.main.score.t_s[0]))
            axes.axvspan((p.pause.start_ns - begin_ns) / 1e9, (p.pause.end_ns - begin_ns) / 1e9, color=RULE, lw=0.0)
        axes.set_xlabel("time (s)")
        axes.set_ylabel("error of position (m)")
        legend_above(axes, 3)
        svg = svg_of(figure, key, alt)
    return Figure(key, svg, alt, "Errors of position over time; grey: the sensor is silent.", tuple(data))
