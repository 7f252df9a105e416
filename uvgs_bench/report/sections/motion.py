"""What was driven after the places at rest: told, reported and seen positions over time, and the path in its plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.accuracy.registration import Registration
from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Block, Column, Figure, Paragraph, Section, Table
from uvgs_bench.report.figures import canvas, label_of, legend_above, series, style, svg_of, thinned
from uvgs_bench.report.palette import BLUE, FAINT, GREEN, ORANGE
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.store.run import Run, Sample
from uvgs_bench.units import mm_from_m, ms_from_s, s_from_ns

_MOST_PANELS = 3


@dataclass(frozen=True, slots=True, eq=False)
class _Driven:
    """The motion of a run, linear axes only: times (N,), s; positions (N, L), mm, NaN where nothing was seen."""

    axes: tuple[Axis, ...]
    t_s: FloatArray
    told_mm: FloatArray
    reported_mm: FloatArray
    seen_mm: FloatArray
    held_mm: FloatArray
    switches: tuple[tuple[float, str], ...]


def build(run: Run, judgement: Judgement) -> Section | None:
    """Two drawings and what they say in numbers; nothing for a run without a motion."""
    first = next((i for i, sample in enumerate(run.samples) if sample.is_moving), None)
    if first is None:
        return None
    # Captures of the wait before the first move belong to it as well.
    samples = [sample for sample in run.samples if sample.station >= run.manifest.station_count]
    linear = [i for i, axis in enumerate(run.manifest.axes) if axis.kind == "linear"]
    if len(samples) < 2 or not linear:
        return None
    driven = _driven(run, samples, linear, judgement.registration)
    blocks: list[Block] = [
        Paragraph(
            "After the places at rest the carriage was driven along a path. Told is where the plan wanted it at the "
            "instant of each capture, reported what the controller said for that instant, seen what the sensor says "
            "through the registration. All three are on one clock; errors are judged against the reported position."
        ),
        _table(samples, driven),
        _over_time(driven),
    ]
    if len(linear) > 1:
        blocks.append(_path(driven))
    return Section("motion", "Motion", tuple(blocks))


def _driven(run: Run, samples: list[Sample], linear: list[int], registration: Registration | None) -> _Driven:
    axes = tuple(run.manifest.axes[i] for i in linear)
    seen = np.full((len(samples), len(linear)), np.nan)
    held = np.full_like(seen, np.nan)
    to_axes = np.linalg.pinv(np.array([axis.direction * axis.scale for axis in axes]).T)
    last: FloatArray | None = None
    for k, sample in enumerate(samples):
        if registration is not None and isinstance(sample.outcome, PoseEstimate):
            seen[k] = last = to_axes @ _carriage_m(sample.outcome, registration, run.manifest.mount)
        elif sample.held_age_s is not None and last is not None:
            held[k] = last
    t_s = np.array([s_from_ns(sample.t_ns - samples[0].t_ns) for sample in samples])
    active = [sample.active for sample in samples]
    changes = [k for k, name in enumerate(active) if name and (k == 0 or name != active[k - 1])]
    return _Driven(
        axes,
        t_s,
        mm_from_m(np.array([sample.target[linear] for sample in samples])),
        mm_from_m(np.array([sample.position[linear] for sample in samples])),
        mm_from_m(seen),
        mm_from_m(held),
        tuple((float(t_s[k]), active[k]) for k in changes),
    )


def _carriage_m(pose: PoseEstimate, registration: Registration, mount: str) -> FloatArray:
    """Where the sensor says the carriage is in gantry axes, shape (3,), m."""
    moving = registration.left.inverse() @ pose.camera_from_beacon @ registration.right.inverse()
    return moving.t_m if mount == "beacon_on_carriage" else moving.inverse().t_m


def _table(samples: list[Sample], driven: _Driven) -> Table:
    moving = np.array([sample.is_moving for sample in samples])
    off = np.linalg.norm(driven.told_mm - driven.reported_mm, axis=1)
    speed = np.array(
        [np.linalg.norm(sample.velocity[: len(driven.axes)]) if sample.is_moving else 0.0 for sample in samples]
    )
    late_ms = ms_from_s(off[moving] / np.maximum(mm_from_m(speed[moving]), 1e-9)) if moving.any() else np.zeros(1)
    is_fast = mm_from_m(speed[moving]) > 5.0 if moving.any() else np.zeros(1, dtype=bool)
    rows: list[tuple[Cell, ...]] = [
        ("Captures of the motion", Number(len(samples), 0, "")),
        ("Taken while moving", Number(int(moving.sum()), 0, "")),
        ("With a pose", Number(sum(sample.is_solved for sample in samples), 0, "")),
        ("Misses filled by a held pose", Number(sum(sample.held_age_s is not None for sample in samples), 0, "")),
        ("Changes of the beacon", Number(max(len(driven.switches) - 1, 0), 0, "")),
        ("Largest speed", Number(float(mm_from_m(speed.max())), 1, "mm/s")),
        ("Told less reported, largest", Number(float(off.max()), 3, "mm")),
        ("The same as a time, largest above 5 mm/s", Number(float(late_ms[is_fast].max(initial=0.0)), 0, "ms")),
    ]
    columns = (Column("Figure"), Column("Value", is_numeric=True))
    return Table("The motion in numbers; a held pose never counts as a pose.", columns, tuple(rows))


def _over_time(driven: _Driven) -> Figure:
    key = "motion-time"
    panels = range(min(len(driven.axes), _MOST_PANELS))
    spans = ", ".join(f"{axis.name} by {np.ptp(driven.told_mm[:, k]):.0f} mm" for k, axis in enumerate(driven.axes))
    changes = "".join(f", {name} from {t_s:.1f} s on" for t_s, name in driven.switches)
    alt = f"Machine positions over {driven.t_s[-1]:.0f} s, told, reported and seen: {spans}{changes}."
    shown = thinned(len(driven.t_s))
    t_s = driven.t_s[shown]
    with style(key):
        figure = canvas(1.6 + 1.3 * len(panels))
        drawn = np.atleast_1d(figure.subplots(len(panels), 1, sharex=True))
        for k in panels:
            axes = drawn[k]
            axes.plot(t_s, driven.seen_mm[shown, k], ".", color=ORANGE, ms=3.0, label="seen")
            if np.isfinite(driven.held_mm).any():
                axes.plot(t_s, driven.held_mm[shown, k], "x", color=FAINT, ms=3.5, label="held")
            axes.plot(t_s, driven.reported_mm[shown, k], color=BLUE, lw=1.2, label="reported")
            axes.plot(t_s, driven.told_mm[shown, k], color=GREEN, lw=1.0, ls="--", label="told")
            for begin_s, name in driven.switches:
                axes.axvline(begin_s, color=FAINT, lw=0.8, ls=":")
                if k == 0:
                    place = {"xycoords": axes.get_xaxis_transform(), "textcoords": "offset points"}
                    axes.annotate(label_of(name, 14), (begin_s, 1.0), (2, -9), fontsize=7.0, color=FAINT, **place)
            if k == 0 and driven.switches:
                # Room for the names above the lines.
                axes.margins(y=0.22)
            axes.set_ylabel(f"{driven.axes[k].name} (mm)")
        drawn[-1].set_xlabel("time since the first capture of the motion (s)")
        legend_above(drawn[0], 4)
        svg = svg_of(figure, key, alt)
    data = [series("time", "s", driven.t_s)]
    for k, axis in enumerate(driven.axes):
        for word, values in (("told", driven.told_mm), ("reported", driven.reported_mm), ("seen", driven.seen_mm)):
            data.append(series(f"{axis.name} {word}", "mm", values[:, k]))
    caption = "Machine positions over time: told, reported by the controller, seen by the sensor."
    said = f"{caption} Dotted lines: another beacon is looked at from here on." if driven.switches else caption
    return Figure(key, svg, alt, said, tuple(data))


def _path(driven: _Driven) -> Figure:
    key = "motion-path"
    a, b = sorted(np.argsort(-np.ptp(driven.told_mm, axis=0), kind="stable")[:2].tolist())
    names = driven.axes[a].name, driven.axes[b].name
    off = np.linalg.norm(driven.seen_mm - driven.reported_mm, axis=1)
    worst = float(np.nanmax(off)) if np.isfinite(off).any() else float("nan")
    alt = (
        f"The path in the plane of {names[0]} and {names[1]}, {np.ptp(driven.told_mm[:, a]):.0f} mm by "
        f"{np.ptp(driven.told_mm[:, b]):.0f} mm; seen and reported positions differ by at most {worst:.2f} mm."
    )
    shown = thinned(len(driven.t_s))
    with style(key):
        figure = canvas(4.0)
        axes = figure.add_subplot()
        axes.plot(driven.seen_mm[shown, a], driven.seen_mm[shown, b], ".", color=ORANGE, ms=3.0, label="seen")
        axes.plot(driven.reported_mm[shown, a], driven.reported_mm[shown, b], color=BLUE, lw=1.2, label="reported")
        axes.plot(driven.told_mm[shown, a], driven.told_mm[shown, b], color=GREEN, lw=1.0, ls="--", label="told")
        axes.set_xlabel(f"{names[0]} (mm)")
        axes.set_ylabel(f"{names[1]} (mm)")
        axes.set_aspect("equal", adjustable="datalim")
        legend_above(axes, 3)
        svg = svg_of(figure, key, alt)
    data = [
        series(f"{names[i]} {word}", "mm", values[:, column])
        for i, column in enumerate((a, b))
        for word, values in (("told", driven.told_mm), ("reported", driven.reported_mm), ("seen", driven.seen_mm))
    ]
    return Figure(key, svg, alt, "The path in the plane it goes through most.", tuple(data))
