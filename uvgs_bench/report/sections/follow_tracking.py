"""How well the station was kept: figures, and the error over time."""

from __future__ import annotations

import numpy as np

from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Column, Figure, Section, Table
from uvgs_bench.report.figures import legend_above, plain_axes, series, style, svg_of, thinned
from uvgs_bench.report.follow_evidence import FollowEvidence
from uvgs_bench.report.palette import BLUE, FAINT, GREEN, RULE
from uvgs_bench.units import deg_from_rad, mm_from_m, percent_from_fraction


def build(evidence: FollowEvidence) -> Section | None:
    """Table and drawing."""
    return Section("tracking", "Keeping the station", (_table(evidence), _drawing(evidence)))


def _table(evidence: FollowEvidence) -> Table:
    q = evidence.quality
    overshoot_mm = None if q.overshoot_m is None else mm_from_m(q.overshoot_m)
    rows: list[tuple[Cell, ...]] = [
        ("First in tolerance", Number(q.acquired_s, 2, "s")),
        ("Position error, RMS from then on", Number(mm_from_m(q.rms_m), 2, "mm")),
        ("Position error, largest from then on", Number(mm_from_m(q.worst_m), 2, "mm")),
        ("Attitude error, RMS from then on", Number(deg_from_rad(q.rms_rad), 3, "deg")),
        ("Attitude error, largest from then on", Number(deg_from_rad(q.worst_rad), 3, "deg")),
        (f"Steady position error, RMS ({q.steady_count} captures)", Number(mm_from_m(q.steady_rms_m), 2, "mm")),
        ("Steady position error, largest", Number(mm_from_m(q.steady_worst_m), 2, "mm")),
        (
            f"Steady position error with the leader on its way, largest ({q.cruise_count} captures)",
            Number(mm_from_m(q.cruise_worst_m), 2, "mm"),
        ),
        ("Overshoot past a stop, largest", Number(overshoot_mm, 2, "mm")),
        ("Time in tolerance from then on", Number(percent_from_fraction(q.in_tolerance), 1, "%")),
        ("Captures with a believed pose", Number(percent_from_fraction(q.pose_share), 1, "%")),
        ("Captures lost one by one", Number(q.lost_capture_count, 0)),
    ]
    whose = "True errors" if evidence.is_true else "Errors as the sensor saw them"
    return Table(f"{whose} against the station, Euclidean.", (Column("Figure"), Column("Value", "", True)), tuple(rows))


def _drawing(evidence: FollowEvidence) -> Figure:
    key = "follow-error"
    t_s = evidence.track.t_s
    error_mm = mm_from_m(np.linalg.norm(evidence.track.error_m, axis=1))
    error_deg = deg_from_rad(np.linalg.norm(evidence.track.error_rad, axis=1))
    tolerance_mm = evidence.fact("scenario", "tolerance_mm")
    largest = float(np.nanmax(error_mm)) if np.isfinite(error_mm).any() else 0.0
    alt = (
        f"Position error over {t_s[-1] if len(t_s) else 0.0:.0f} s, largest {largest:.1f} mm; "
        f"{len(evidence.quality.losses)} losses of sight shaded."
    )
    shown = thinned(len(t_s))
    with style(key):
        figure, axes = plain_axes(2.9)
        for loss in evidence.quality.losses:
            axes.axvspan(loss.begin_s, loss.begin_s + loss.duration_s, color=RULE, lw=0.0)
        if tolerance_mm is not None:
            axes.axhline(tolerance_mm, color=GREEN, lw=1.0, label="tolerance")
        axes.plot(t_s[shown], error_mm[shown], color=BLUE, lw=1.2, label="position error")
        for begin_s, _ in evidence.hues[1:]:
            axes.axvline(begin_s, color=FAINT, lw=0.8, ls=":")
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel("time since the first capture (s)")
        axes.set_ylabel("position error (mm)")
        legend_above(axes, 2)
        svg = svg_of(figure, key, alt)
    data = (
        series("time", "s", t_s),
        series("position error", "mm", error_mm),
        *(series(f"along {axis}", "mm", mm_from_m(evidence.track.error_m[:, k])) for k, axis in enumerate("xyz")),
        *((series("attitude error", "deg", error_deg),) if np.isfinite(error_deg).any() else ()),
    )
    caption = (
        "Length of the position error; losses of sight shaded, changes of hue dotted. Components in the leader's axes."
    )
    return Figure(key, svg, alt, caption, data, live="zoom")
