"""The bench as registered, with its frames drawn: camera and field of view, gantry and travel, beacon at a station."""

from __future__ import annotations

import numpy as np

from uvgs_bench.accuracy.registration import Registration
from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.gantry.axes import Axis, gantry_from_carriage
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.report.document import Figure
from uvgs_bench.report.figures import series, style, svg_of
from uvgs_bench.report.marks import draw_marks
from uvgs_bench.report.palette import BLUE, FAINT, GREEN, ORANGE, PURPLE
from uvgs_bench.report.space import SpaceView, space_view
from uvgs_bench.store.run import Run

_TRIAD = (ORANGE, GREEN, BLUE)
_TRIAD_SHARE = 0.14
_MOST_STATIONS = 400
# Looked at from the side, so that the way from camera to beacon is seen in its length.
_TURN_RAD = -1.05
# A name in pixels of the drawing.
_NAME_PX = np.array([120.0, 18.0])


def bench_figure(run: Run, registration: Registration) -> Figure | None:
    """Draw the bench in the camera frame.

    Args:
        run: The run: lens, beacon, axes and where the carriage went.
        registration: How the frames sit together.

    Returns:
        The figure, or None when no capture was taken.
    """
    if not run.samples:
        return None
    positions = np.unique(np.array([s.position for s in run.samples]), axis=0)
    step = max(1, len(positions) // _MOST_STATIONS)
    axes_of = run.manifest.axes
    middle = positions[len(positions) // 2]
    frames, beacons, box = _frames(axes_of, registration, middle, positions[::step])
    beacon = frames["beacon"]
    leds_m = beacon.apply(run.beacon.positions_m)
    reach_m = float(np.linalg.norm(beacons, axis=1).max())
    cone = _field(run.calibration.lens, 0.45 * reach_m)
    everything = np.vstack([np.zeros((1, 3)), cone, beacons, leds_m, box.reshape(-1, 3)])
    size_m = _TRIAD_SHARE * float(np.ptp(everything, axis=0).max())
    low, high = beacons.min(axis=0), beacons.max(axis=0)
    key = "bench"
    alt = (
        f"The bench in the camera frame. Camera at the origin, looking along z. Beacon at {len(positions)} stations: "
        f"x {low[0]:.3f} to {high[0]:.3f} m, y {low[1]:.3f} to {high[1]:.3f} m, z {low[2]:.3f} to {high[2]:.3f} m. "
        + "; ".join(f"{name} frame at {_place(pose)}" for name, pose in frames.items() if name != "camera")
        + "."
    )
    with style(key):
        tips = [pose.t_m + size_m * pose.R[:, k] for pose in frames.values() for k in range(3)]
        figure, view = space_view(np.vstack([everything, tips]), turn_rad=_TURN_RAD)
        gap = np.full(3, np.nan)
        sides = np.concatenate([np.stack([np.zeros(3), corner, gap]) for corner in cone])
        view.axes.plot(*view.of(np.vstack([sides, cone, cone[:1]])), color=FAINT, lw=0.9)
        if len(box):
            gaps = np.concatenate([box, np.full((len(box), 1, 3), np.nan)], axis=1).reshape(-1, 3)
            view.axes.plot(*view.of(gaps), "--", color=PURPLE, lw=0.8, label="travel of the carriage")
        draw_marks(view.axes, view.of(beacons), "o", colour=FAINT, size_pt=1.6, label="beacon at the stations")
        draw_marks(view.axes, view.of(leds_m), "o", colour=ORANGE, size_pt=3.2, label="LEDs")
        merged = _merged(frames, 0.25 * size_m)
        for pose in merged.values():
            _draw_frame(view, pose, size_m)
        _draw_names(view, merged)
        figure.legend(loc="upper left", ncols=3, handletextpad=0.3, columnspacing=0.9, borderaxespad=0.2)
        svg = svg_of(figure, key, alt)
    data = tuple(series(f"beacon {n}", "m", beacons[:, k]) for k, n in enumerate("xyz"))
    held = "" if registration.rank == 12 else f" Places no motion tells are chosen: {registration.gauge}."
    caption = (
        f"The bench as registered, in the camera frame; x orange, y green, z blue; thin lines: field of view.{held}"
    )
    return Figure(key, svg, alt, caption, data)


def _frames(
    axes: tuple[Axis, ...], r: Registration, middle: FloatArray, positions: FloatArray
) -> tuple[dict[str, Pose], FloatArray, FloatArray]:
    """Frames in the camera frame by name, beacon origins at the positions (n, 3), edges of the travel (e, 2, 3), m."""
    rides = r.mount == "beacon_on_carriage"

    def beacon_at(position: FloatArray) -> Pose:
        motion = gantry_from_carriage(axes, position)
        return r.left @ (motion if rides else motion.inverse()) @ r.right

    motion = gantry_from_carriage(axes, middle)
    beacon = beacon_at(middle)
    if rides:
        frames = {"camera": Pose.identity("camera", "camera"), "gantry": r.left, "carriage": r.left @ motion}
    else:
        # The camera rides: the gantry is drawn where it is when the carriage stands at the middle station.
        frames = {
            "camera": Pose.identity("camera", "camera"),
            "carriage": r.left,
            "gantry": r.left @ motion.inverse(),
        }
    frames["beacon"] = beacon
    origins = np.array([beacon_at(position).t_m for position in positions])
    return frames, origins, _travel(axes, frames["gantry"])


def _travel(axes: tuple[Axis, ...], camera_from_gantry: Pose) -> FloatArray:
    """Edges of the box the carriage can reach, camera frame, shape (e, 2, 3), m; rotary axes add none."""
    linear = [i for i, axis in enumerate(axes) if axis.kind == "linear"]
    ends = [(axes[i].lower, axes[i].upper) for i in linear]
    if not linear or not np.isfinite(ends).all():
        return np.empty((0, 2, 3))
    edges = []
    for corner in np.ndindex(*(2,) * len(linear)):
        for k, side in enumerate(corner):
            if side:
                continue
            pair = []
            for end in (0, 1):
                at = np.zeros(len(axes))
                for j, i in enumerate(linear):
                    at[i] = ends[j][end if j == k else corner[j]]
                pair.append(gantry_from_carriage(axes, at).t_m)
            edges.append(pair)
    return camera_from_gantry.apply(np.array(edges).reshape(-1, 3)).reshape(-1, 2, 3)


def _field(lens: Lens, depth_m: float) -> FloatArray:
    """Corners of the field of view at a depth, camera frame, shape (4, 3), m; at most 60 degrees off the axis."""
    u, v = lens.width_px - 0.5, lens.height_px - 0.5
    rays = lens.unproject(np.array([[-0.5, -0.5], [u, -0.5], [u, v], [-0.5, v]]))
    flat = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * np.tan(np.pi / 3.0)
    known = np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.5)
    slope = np.where(known[:, None], rays[:, :2] / np.where(known, rays[:, 2], 1.0)[:, None], flat)
    corners: FloatArray = np.concatenate([depth_m * slope, np.full((4, 1), depth_m)], axis=1)
    return corners


def _merged(frames: dict[str, Pose], near_m: float) -> dict[str, Pose]:
    """Frames by label; those that lie on one another share it, or neither could be read."""
    merged: dict[str, Pose] = {}
    for name, pose in frames.items():
        same = next((label for label, other in merged.items() if np.linalg.norm(other.t_m - pose.t_m) < near_m), None)
        if same is None:
            merged[name] = pose
        else:
            merged = {f"{label}, {name}" if label == same else label: other for label, other in merged.items()}
    return merged


def _draw_frame(view: SpaceView, pose: Pose, size_m: float) -> None:
    for k, colour in enumerate(_TRIAD):
        tip = pose.t_m + size_m * pose.R[:, k]
        view.axes.plot(*view.of(np.stack([pose.t_m, tip])), "-", color=colour, lw=2.0)
        x, y = view.of(pose.t_m + 1.15 * size_m * pose.R[:, k])
        view.axes.text(float(x), float(y), "xyz"[k], color=colour, fontsize=7.5, ha="center", va="center")


def _draw_names(view: SpaceView, frames: dict[str, Pose]) -> None:
    """Name frames where they are; a name that would cover another goes to the other side."""
    taken: list[FloatArray] = []
    for name, pose in frames.items():
        place = view.of(pose.t_m)
        at_px = view.axes.transData.transform(place)
        is_near = any((np.abs(at_px - other) < _NAME_PX).all() for other in taken)
        taken.append(at_px)
        shift, va = ((4, 12), "bottom") if is_near else ((4, -6), "top")
        view.axes.annotate(
            name, (float(place[0]), float(place[1])), shift, textcoords="offset points", fontsize=8.5, va=va
        )


def _place(pose: Pose) -> str:
    x, y, z = pose.t_m
    return f"x {x:.3f} m, y {y:.3f} m, z {z:.3f} m"
