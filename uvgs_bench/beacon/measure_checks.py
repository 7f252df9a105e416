"""Whether views can tell LED positions at all, and what looks wrong about a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.beacon.frames import FrameChoice, fit_rigid
from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.beacon.measure_start import LedView
from uvgs_bench.beacon.network import Network, State, adjust, points_in_camera
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.errors import CalibrationError, ConfigError, TooFewViews
from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import deg_from_rad, mm_from_m, rad_from_deg

if TYPE_CHECKING:
    from uvgs_bench.beacon.measure_types import Distance

_MIN_VIEWS = {"board": 4, "free": 6, "gantry": 6}
# Views that differ by less than this show depth only through perspective.
_MIN_TILT_RAD = rad_from_deg(15.0)
# The second direction of travel must be at least this long (root mean square), or the attitude of the axes is open.
_MIN_TRAVEL_M = 0.01
# Chi-square by which the mirror image must be worse: about four deviations.
_MIRROR_CHI2 = 16.0


def check_placed(frame: FrameChoice, by: str) -> None:
    """Refuse a frame its source cannot give. Raises ConfigError."""
    if frame.kind in ("board", "gantry") and frame.kind != by:
        raise ConfigError(
            f"the frame '{frame.kind}' needs a measurement by {frame.kind}, this one is by {by}", "--frame"
        )


def check_views(views: Sequence[LedView], nominal: Beacon, by: str, worst_sigma_m: float) -> None:
    """Refuse views that cannot tell, before anything is adjusted.

    Args:
        views: The views.
        nominal: The beacon.
        by: The source.
        worst_sigma_m: Only for the message's sake: what is asked for, m.

    Raises:
        TooFewViews: Too few views or stations, one direction of view, travel along one line, or an LED never seen.
    """
    what = "stations" if by == "gantry" else "views"
    if len(views) < _MIN_VIEWS[by]:
        raise TooFewViews(f"{len(views)} {what} with named LEDs, at least {_MIN_VIEWS[by]} are needed")
    counts = np.bincount(np.concatenate([view.led for view in views]), minlength=len(nominal.leds))
    if (counts < 3).any():
        led = nominal.leds[int(np.argmin(counts))].name
        raise TooFewViews(f"LED {led} is named in {int(counts.min())} blobs only, at least 3 are needed")
    if by == "gantry":
        carriage = np.array([view.carriage_m for view in views if view.carriage_m is not None])
        spread = np.linalg.svd(carriage - carriage.mean(axis=0), compute_uv=False) / np.sqrt(len(carriage))
        if spread[1] < _MIN_TRAVEL_M:
            raise TooFewViews(
                f"the stations lie along one line (second direction {mm_from_m(float(spread[1])):.1f} mm root mean "
                f"square, at least {mm_from_m(_MIN_TRAVEL_M):.0f} mm): the attitude of the gantry stays open"
            )
        return
    looks = np.array([-view.camera_from_beacon.R.T @ view.camera_from_beacon.t_m for view in views])
    looks /= np.linalg.norm(looks, axis=1)[:, None]
    widest = float(np.arccos(np.clip((looks @ looks.T).min(), -1.0, 1.0)))
    if widest < _MIN_TILT_RAD:
        raise TooFewViews(
            f"the beacon is seen from directions within {deg_from_rad(widest):.1f} deg, at least "
            f"{deg_from_rad(_MIN_TILT_RAD):.0f} deg are needed for depth to {mm_from_m(worst_sigma_m):.2f} mm: "
            "tilt it to all sides"
        )


def refuse_vague(distances: Sequence[Distance], worst_sigma_m: float) -> None:
    """Refuse a measurement whose worst distance is too doubtful to be of use. Raises TooFewViews."""
    worst = max(distances, key=lambda d: d.sigma_m)
    if not worst.sigma_m <= worst_sigma_m:
        raise TooFewViews(
            f"the views leave {worst.first}-{worst.second} open to ± {mm_from_m(worst.sigma_m):.2f} mm, at most "
            f"{mm_from_m(worst_sigma_m):.2f} mm is a measurement: come nearer, tilt more, take more views"
        )


def check_mirror(network: Network, state: State, weight: FloatArray) -> float:
    """Adjust the mirror image too.

    Args:
        network: A network of free views.
        state: Its minimum.
        weight: Of each sighting, 0 for those set aside, shape (N,).

    Returns:
        How much more the mirror image costs, chi-square.

    Raises:
        TooFewViews: The mirror image fits almost as well.
        CalibrationError: It fits better.
    """
    centre = state.leds_m.mean(axis=0)
    flip = np.diag([1.0, 1.0, -1.0])
    R, t = np.empty_like(state.R), np.empty_like(state.t_m)
    for i in range(len(R)):
        # Depth about the middle of the LEDs is reversed along the line of sight: from afar it looks the same.
        middle = state.R[i] @ centre + state.t_m[i]
        look = middle / np.linalg.norm(middle)
        R[i] = (np.eye(3) - 2.0 * np.outer(look, look)) @ state.R[i] @ flip
        t[i] = middle - R[i] @ (flip @ centre)
    mirrored = replace(state, leds_m=state.leds_m @ flip, R=R, t_m=t)
    _, cost = adjust(network, state, weight)
    try:
        _, other = adjust(network, mirrored, weight)
    except CalibrationError:
        return float("inf")
    if other < cost - _MIRROR_CHI2:
        raise CalibrationError(
            f"the mirror image of the beacon fits better (chi-square {other:.0f} against {cost:.0f}): the nominal "
            "positions are given in a left-handed frame"
        )
    if other < cost + _MIRROR_CHI2:
        raise TooFewViews(
            f"the mirror image of the beacon fits almost as well (chi-square {other:.1f} against {cost:.1f}, should "
            f"be worse by {_MIRROR_CHI2:.0f}): come nearer or tilt more"
        )
    return other - cost


def pulled_priors(network: Network, state: State, calibration: Calibration) -> list[str]:
    """Lines about declared values that the pictures contradict."""
    out = []
    gantry = network.gantry
    if gantry is not None:
        stops = float(np.sqrt(np.mean(state.stops_m**2)))
        if stops > 1.5 * gantry.station_sigma_m:
            out.append(
                f"stops scatter by {mm_from_m(stops):.3f} mm per axis, {mm_from_m(gantry.station_sigma_m):.3f} mm "
                "were declared: the deviations are too small"
            )
        sigma = np.array([gantry.scale_sigma] * 3 + [gantry.squareness_sigma_rad] * 3)
        names = ("scale of axis 1", "scale of axis 2", "scale of axis 3", "squareness 1-2", "squareness 1-3",
                 "squareness 2-3")  # fmt: skip
        for name, value, doubt in zip(names, state.faults, sigma, strict=True):
            if abs(value) > 3.0 * doubt:
                out.append(f"{name} of the gantry is pulled to {value:+.1e}, {doubt:.1e} was declared")
    if network.board_scale_sigma > 0.0 and abs(state.board_scale) > 3.0 * network.board_scale_sigma:
        out.append(f"the print scale is pulled to {state.board_scale:+.1e}, {network.board_scale_sigma:.1e} declared")
    if network.lens_covariance is not None:
        moved = (state.lens.parameters - calibration.lens.parameters) / np.sqrt(np.diag(network.lens_covariance))
        worst = int(np.argmax(np.abs(moved)))
        if abs(moved[worst]) > 4.0:
            out.append(
                f"{state.lens.parameter_names[worst]} of the lens is pulled by {abs(float(moved[worst])):.1f} of its "
                "deviations: calibrate anew"
            )
    return out


def view_angles(
    network: Network, state: State, seen: NDArray[np.intp], led: int, nominal: Beacon
) -> tuple[FloatArray, FloatArray]:
    """How obliquely an LED is seen.

    Args:
        network: The network.
        state: Its minimum.
        seen: Sightings of the LED, shape (k,).
        led: Its number; it has an axis.
        nominal: The beacon, for the axis.

    Returns:
        Angle between axis and line of sight (k,), rad, and pixels per metre of travel along the axis (k, 2).
    """
    axis = nominal.leds[led].axis
    assert axis is not None
    turn, _ = fit_rigid(nominal.positions_m, state.leds_m)
    p = points_in_camera(network, state)[seen]
    R = state.R[network.sightings.view[seen]] if network.gantry is None else np.repeat(state.R, len(seen), axis=0)
    direction = R @ (turn @ axis)
    _, by_point, _ = state.lens.project_with_jacobians(p)
    cosine = -np.einsum("ni,ni->n", direction, p) / np.linalg.norm(p, axis=1)
    return np.arccos(np.clip(cosine, -1.0, 1.0)), np.einsum("nij,nj->ni", by_point, direction)
