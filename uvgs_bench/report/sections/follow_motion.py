"""Positions and angles over time with what was commanded, and the paths in the plane: commands, truth, sensor."""

from __future__ import annotations

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.document import Figure, Section
from uvgs_bench.report.figures import canvas, label_of, legend_above, series, style, svg_of, thinned
from uvgs_bench.report.follow_evidence import FollowEvidence
from uvgs_bench.report.palette import BLUE, FAINT, GREEN, ORANGE

_AXES = ("x, right", "y, down", "z, forward")
_GANTRY_AXES = ("x, gantry", "y, gantry", "z, gantry")
_ANGLES = ("yaw, about z", "pitch, about y", "roll, about x")
# A path that is flatter than this is drawn in its plane all the same, m.
_LEAST_SPAN_M = 0.02


def build(evidence: FollowEvidence) -> Section | None:
    """Three drawings; nothing without captures."""
    if len(evidence.track.t_s) < 2:
        return None
    places = _over_time(
        evidence, "follow-xyz", "m", _names(evidence), evidence.wanted_m, evidence.true_m, evidence.sensed_m,
        "Position of the follower's body in the world over time: commanded (the station), true, sensed.",
    )  # fmt: skip
    angles = _over_time(
        evidence, "follow-euler", "deg", _ANGLES, evidence.wanted_deg, evidence.true_deg, evidence.sensed_deg,
        "Angles of the follower's body over time, intrinsic Z-Y-X: commanded, true, sensed.",
    )  # fmt: skip
    # A gantry follows by its linear axes: there are no angles to show.
    has_angles = evidence.run.manifest.plant != "gantry"
    return Section("motion", "Motion", (places, *((angles,) * has_angles), _paths(evidence)))


def _names(evidence: FollowEvidence) -> tuple[str, str, str]:
    return _GANTRY_AXES if evidence.run.manifest.plant == "gantry" else _AXES


def _over_time(
    evidence: FollowEvidence,
    key: str,
    unit: str,
    names: tuple[str, ...],
    wanted: FloatArray,
    true: FloatArray,
    sensed: FloatArray,
    caption: str,
) -> Figure:
    t_s = evidence.track.t_s
    shown = thinned(len(t_s))
    spans = ", ".join(f"{name.split(',')[0]} by {np.ptp(wanted[:, k]):.2f} {unit}" for k, name in enumerate(names))
    alt = f"{caption} The command moves {spans} in {t_s[-1]:.0f} s."
    with style(key):
        figure = canvas(5.4)
        panels = figure.subplots(3, 1, sharex=True)
        for k, (axes, name) in enumerate(zip(panels, names, strict=True)):
            axes.plot(t_s[shown], sensed[shown, k], ".", color=ORANGE, ms=2.6, label="sensed")
            if evidence.is_true:
                axes.plot(t_s[shown], true[shown, k], color=BLUE, lw=1.2, label="true")
            axes.plot(t_s[shown], wanted[shown, k], color=GREEN, lw=1.2, ls="--", label="commanded")
            for begin_s, hue in evidence.hues:
                axes.axvline(begin_s, color=FAINT, lw=0.8, ls=":")
                if k == 0:
                    place = {"xycoords": axes.get_xaxis_transform(), "textcoords": "offset points"}
                    axes.annotate(label_of(hue, 8), (begin_s, 1.0), (2, -9), fontsize=7.5, color=FAINT, **place)
            axes.set_ylabel(f"{name} ({unit})", fontsize=8.5)
        panels[-1].set_xlabel("time since the first capture (s)")
        legend_above(panels[0], 3)
        svg = svg_of(figure, key, alt)
    data = [series("time", "s", t_s)]
    for k, name in enumerate(names):
        short = name.split(",")[0]
        data += [series(f"{short} commanded", unit, wanted[:, k]), series(f"{short} sensed", unit, sensed[:, k])]
        data += [series(f"{short} true", unit, true[:, k])] * evidence.is_true
    said = f"{caption} Changes of the leader's hue are dotted." if evidence.hues else caption
    return Figure(key, svg, alt, said, tuple(data))


def _paths(evidence: FollowEvidence) -> Figure:
    key = "follow-paths"
    leader, names = evidence.leader_m, _names(evidence)
    a, b = sorted(np.argsort(-np.ptp(leader, axis=0), kind="stable")[:2].tolist())
    shown = thinned(len(leader))
    at_hue = [int(np.searchsorted(evidence.track.t_s, begin_s)) for begin_s, _ in evidence.hues]
    alt = (
        f"Paths in the plane of {names[a]} and {names[b]}: the leader over {np.ptp(leader[:, a]):.2f} m by "
        f"{np.ptp(leader[:, b]):.2f} m, and the follower; largest position error "
        f"{float(np.nanmax(np.linalg.norm(evidence.track.error_m, axis=1))):.3f} m."
    )
    # The offset to the leader is taken off, so that the paths can be compared.
    offset = evidence.wanted_m - leader
    with style(key):
        figure = canvas(4.2)
        axes = figure.add_subplot()
        axes.plot(*_pair(evidence.sensed_m - offset, a, b, shown), ".", color=ORANGE, ms=2.6, label="follower, sensed")
        if evidence.is_true:
            axes.plot(*_pair(evidence.true_m - offset, a, b, shown), color=BLUE, lw=1.2, label="follower, true")
        axes.plot(*_pair(leader, a, b, shown), color=GREEN, lw=1.2, ls="--", label="leader")
        for i, (_, hue) in zip(at_hue, evidence.hues, strict=True):
            axes.plot(leader[i, a], leader[i, b], "s", color=FAINT, ms=5)
            axes.annotate(
                label_of(hue, 8), (leader[i, a], leader[i, b]), (5, 5), textcoords="offset points", fontsize=8
            )
        axes.set_xlabel(f"{names[a]} (m)")
        axes.set_ylabel(f"{names[b]} (m)")
        _frame(axes, leader[:, a], leader[:, b])
        if names[b] == _AXES[1]:
            axes.invert_yaxis()
        legend_above(axes, 3)
        svg = svg_of(figure, key, alt)
    data = [series(f"leader {names[k].split(',')[0]}", "m", leader[:, k]) for k in (a, b)]
    data += [series(f"sensed {names[k].split(',')[0]}", "m", (evidence.sensed_m - offset)[:, k]) for k in (a, b)]
    if evidence.is_true:
        data += [series(f"true {names[k].split(',')[0]}", "m", (evidence.true_m - offset)[:, k]) for k in (a, b)]
    caption = "Paths of leader and follower, the station's offset taken off; squares where the leader changes its hue."
    return Figure(key, svg, alt, caption, tuple(data))


def _pair(points: FloatArray, a: int, b: int, shown: np.ndarray) -> tuple[FloatArray, FloatArray]:
    return points[shown, a], points[shown, b]


def _frame(axes: object, first: FloatArray, second: FloatArray) -> None:
    """Equal scales with room around the leader's path; a follower far off is seen as far as the frame reaches."""
    from matplotlib.axes import Axes

    assert isinstance(axes, Axes)
    axes.set_aspect("equal", adjustable="box")
    span = max(float(np.ptp(first)), float(np.ptp(second)), _LEAST_SPAN_M)
    for values, which in ((first, axes.set_xlim), (second, axes.set_ylim)):
        middle = 0.5 * (float(values.min()) + float(values.max()))
        which(middle - 0.65 * span, middle + 0.65 * span)
