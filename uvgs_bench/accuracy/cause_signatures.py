"""What every known cause would do to the residuals of a registration: one signature each, to first order.

A cause of the gantry moves the carriage, so its signature is a shift seen through the registration. A cause of the
camera or the beacon moves LED pixels, and the sensor turns pixels into a pose by its least squares: the signature is
that gain times the shift of the pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.pose_sensitivity import pose_pixel_jacobian
from uvgs_bench.accuracy.registration import Registration
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import mm_from_m, mrad_from_rad, ms_from_s, s_from_ns

# Shares of the run after which the beacon may have slipped.
_SLIPS = tuple(0.1 * k for k in range(1, 10))
_PERCENT = 100.0
_PER_HOUR = 3600.0
# Anything that moves captures less than this many times the largest signature does nothing.
_NOTHING = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Signature:
    """One thing that may be wrong, and what it would do.

    Args:
        cause: Stable word, as in ``blind_bench.PLANTABLE``.
        title: What would be wrong, in words.
        unit: Unit people read its size in.
        per_unit: Size in that unit of one SI unit.
        effect: Change of the left tangent of each pose by its parameters, shape (N, 6, p), SI.
        sign: What one sees of it in the residuals.
        check: What would confirm it.
        rivals: How many signatures its cause has.
    """

    cause: str
    title: str
    unit: str
    per_unit: float
    effect: FloatArray
    sign: str
    check: str
    rivals: int = 1


def signatures(
    obs: Observations,
    registration: Registration,
    lens: Lens,
    leds_m: FloatArray,
    led_names: tuple[str, ...],
    blamed: tuple[int, ...],
) -> tuple[Signature, ...]:
    """Signatures of all causes that could show in these captures.

    Args:
        obs: Captures, all with a pose.
        registration: Their registration.
        lens: The lens the sensor was told.
        leds_m: LED positions it was told, beacon frame, shape (L, 3), m.
        led_names: Names of the LEDs, length L.
        blamed: Numbers of the LEDs that may be misplaced.

    Returns:
        The signatures; causes the captures were not exposed to (no motion, one approach) are left out.
    """
    found = _of_gantry(obs, registration) + _of_time(obs, registration)
    found += _of_sensor(obs, registration, lens, leds_m, {k: led_names[k] for k in blamed})
    counts = {s.cause: sum(o.cause == s.cause for o in found) for s in found}
    return tuple(
        Signature(s.cause, s.title, s.unit, s.per_unit, s.effect, s.sign, s.check, counts[s.cause])
        for s in found
        if float(np.abs(s.effect).max(initial=0.0)) > _NOTHING
    )


def _of_gantry(obs: Observations, registration: Registration) -> list[Signature]:
    shifted = _shifter(obs, registration)
    at, names = obs.t_gs_m, "xyz"
    found = []
    for k, name in enumerate(names):
        found.append(
            Signature(
                "axis_scale",
                f"gantry axis {name} travels farther or less than reported",
                "%",
                _PERCENT,
                shifted(_along(at[:, k], k)),
                f"errors along gantry {name} grow with travel along {name}",
                f"compare a long travel along {name} with a dial gauge or a scale (uvgs gantry characterise)",
            )
        )
    for earlier, later in ((0, 1), (0, 2), (1, 2)):
        pair = names[earlier] + names[later]
        found.append(
            Signature(
                "squareness",
                f"gantry axes {pair[0]} and {pair[1]} are not square",
                "mrad",
                float(mrad_from_rad(1.0)),
                shifted(_along(at[:, later], earlier)),
                f"errors along gantry {pair[0]} grow with travel along {pair[1]}",
                f"measure the angle between {pair[0]} and {pair[1]} with a square and a dial gauge, or both diagonals",
            )
        )
    direction = _directions(obs)
    both = [k for k in range(obs.approach.shape[1]) if {-1, 1} <= set(np.unique(obs.approach[:, k]).tolist())]
    play = (
        np.stack([-0.5 * obs.approach[:, k, None] * direction[k] for k in both])
        if both
        else np.zeros((0, obs.count, 3))
    )
    backlash = [(f"axis {k + 1} of the gantry has play", play[i]) for i, k in enumerate(both)]
    if len(both) > 1:
        backlash.append(("all axes of the gantry have play", play.sum(axis=0)))
    for title, shift in backlash:
        found.append(
            Signature(
                "backlash",
                title,
                "mm",
                float(mm_from_m(1.0)),
                shifted(shift[:, :, None]),
                "errors change sign with the side a place is approached from",
                "approach one place from both sides with a dial gauge on the carriage",
            )
        )
    found.append(
        Signature(
            "latency",
            "captures and gantry positions do not belong to the same instant",
            "ms",
            float(ms_from_s(1.0)),
            shifted(-obs.velocity_gs_mps[:, :, None]),
            "errors lie along the velocity and grow with it",
            "pass one place at several speeds, both ways; check how captures are stamped",
        )
    )
    return found


def _of_time(obs: Observations, registration: Registration) -> list[Signature]:
    elapsed_s = np.array([s_from_ns(t) for t in (obs.t_ns - obs.t_ns.min()).tolist()])
    sight = np.zeros((obs.count, 6, 3))
    sight[:, 3:] = np.eye(3)
    found = [
        Signature(
            "drift",
            "camera or gantry drifts with time",
            "mm/h",
            float(mm_from_m(1.0)) * _PER_HOUR,
            -sight * elapsed_s[:, None, None],
            "errors grow with time, wherever the carriage is",
            "stay at one place for an hour after warming up; record the temperature",
        )
    ]
    riding = _carried(obs, registration)
    _, visit = np.unique(obs.station, return_inverse=True)
    started = np.sort(np.array([obs.t_ns[visit == v].min() for v in range(int(visit.max(initial=-1)) + 1)]))
    for share in _SLIPS:
        after = (obs.t_ns >= started[int(share * len(started))]).astype(np.float64)
        found.append(
            Signature(
                "slip",
                f"the beacon or the camera has slipped on its mount about {share:.0%} into the run",
                "mm",
                float(mm_from_m(1.0)),
                riding * after[:, None, None],
                "errors before and after that instant differ by a constant shift",
                "tighten both mounts, mark them, and visit the first places again",
            )
        )
    return found


def _of_sensor(
    obs: Observations, registration: Registration, lens: Lens, leds_m: FloatArray, led_names: dict[int, str]
) -> list[Signature]:
    N, L = obs.count, len(leds_m)
    # At the predicted poses: at the found ones signatures would go with the noise.
    R, t = registration.predict(obs)
    J, px = pose_pixel_jacobian(lens, leds_m, R, t)
    flat = J.reshape(N, 2 * L, 6)
    gain = np.linalg.solve(flat.transpose(0, 2, 1) @ flat, flat.transpose(0, 2, 1))

    def moved(shift_px: FloatArray) -> FloatArray:
        answer: FloatArray = gain @ shift_px.reshape(N, 2 * L, -1)
        return answer

    points = np.einsum("nij,lj->nli", R, leds_m) + t[:, None]
    _, by_point, by_lens = lens.project_with_jacobians(points.reshape(-1, 3))
    by_lens = by_lens.reshape(N, L, 2, -1)
    by_led = np.einsum("nlui,nij->nluj", by_point.reshape(N, L, 2, 3), R)
    focal = by_lens[..., 0] * lens.fx_px + by_lens[..., 1] * lens.fy_px
    found = [
        Signature(
            "focal_length",
            "the focal length is not the camera's",
            "%",
            _PERCENT,
            moved(focal[..., None]),
            "errors along the line of sight grow with range",
            "calibrate the camera again at the working distance, focus locked, and compare (uvgs camera diff)",
        )
    ]
    found += [
        Signature(
            "principal_point",
            f"the principal point is off along the picture's {name}",
            "px",
            1.0,
            moved(by_lens[..., 2 + k, None]),
            "depth errors go with the place in the picture, and attitude errors with range",
            "calibrate again with the board tilted and turned on its side; check that the lens sits firmly",
        )
        for k, name in enumerate(("columns", "rows"))
    ]
    radial = [k for k, name in enumerate(lens.parameter_names) if name in ("k1", "k2", "w")]
    found.append(
        Signature(
            "distortion",
            "the distortion does not hold where the beacon is seen",
            "",
            1.0,
            moved(by_lens[..., radial]),
            "errors grow steeply towards the picture's edge",
            "calibrate with boards out to where the beacon is seen, and look at the coverage map",
        )
    )
    found += [
        Signature(
            "led_offset",
            f"LED {name} is not where the beacon file says",
            "mm",
            float(mm_from_m(1.0)),
            moved(_of_one(by_led, k)),
            "pose errors follow the attitude and range in which the beacon is seen, whatever the gantry does",
            f"measure the beacon again (uvgs beacon measure), LED {name} first; turn it by 90 degrees and repeat",
        )
        for k, name in led_names.items()
    ]
    found.append(
        Signature(
            "beacon_size",
            "the whole beacon is larger or smaller than its file says",
            "%",
            _PERCENT,
            moved(np.einsum("nluj,lj->nlu", by_led, leds_m)[..., None]),
            "errors grow with distance alike in all directions",
            "measure the distance between two LEDs with a caliper",
        )
    )
    inwards = px.mean(axis=1, keepdims=True) - px
    inwards = inwards / np.maximum(np.linalg.norm(inwards, axis=2, keepdims=True), 1e-9)
    found.append(
        Signature(
            "saturation",
            "saturated captures pull the centroids",
            "px",
            1.0,
            moved((inwards * obs.is_saturated[:, None, None])[..., None]),
            "captures with clipped LEDs differ in range from the others",
            "repeat the near places with a shorter exposure",
        )
    )
    return found


def _shifter(obs: Observations, registration: Registration) -> Callable[[FloatArray], FloatArray]:
    """From shifts of the carriage in gantry axes, (N, 3, p), m, to left tangents of the pose, (N, 6, p)."""
    R = registration.left.R
    turn = (
        np.broadcast_to(R, (obs.count, 3, 3)) if obs.mount == "beacon_on_carriage" else -R @ obs.R_gs.transpose(0, 2, 1)
    )

    def shifted(shift_m: FloatArray) -> FloatArray:
        out = np.zeros((obs.count, 6, shift_m.shape[2]))
        out[:, 3:] = turn @ shift_m
        return out

    return shifted


def _carried(obs: Observations, registration: Registration) -> FloatArray:
    """Left tangents of unit shifts of what rides the carriage, in carriage axes, shape (N, 6, 3)."""
    out = np.zeros((obs.count, 6, 3))
    out[:, 3:] = registration.left.R @ obs.R_gs if obs.mount == "beacon_on_carriage" else registration.left.R
    return out


def _along(amount: FloatArray, axis: int) -> FloatArray:
    """Shifts by an amount along one gantry axis, shape (N, 3, 1)."""
    out = np.zeros((len(amount), 3, 1))
    out[:, axis, 0] = amount
    return out


def _of_one(by_led: FloatArray, led: int) -> FloatArray:
    """Pixel shifts by the three coordinates of one LED, shape (N, L, 2, 3)."""
    out = np.zeros_like(by_led)
    out[:, led] = by_led[:, led]
    return out


def _directions(obs: Observations) -> FloatArray:
    """Travel of the carriage per unit of each axis in gantry axes, shape (A, 3); 0 for axes that do not shift it."""
    q = obs.axis_position - obs.axis_position.mean(axis=0)
    t = obs.t_gs_m - obs.t_gs_m.mean(axis=0)
    found: FloatArray = np.linalg.lstsq(q, t, rcond=1e-9)[0]
    return found


def is_turned_away(residual: FloatArray, distance: FloatArray, usual: float) -> NDArray[np.bool_]:
    """Captures whose pose is another one altogether, as exchanged labels give: far off, and turned.

    Args:
        residual: Left tangents, shape (N, 6), rad and m.
        distance: Their whitened lengths, shape (N,).
        usual: Robust scale of the distances.

    Returns:
        Mask, shape (N,).
    """
    turn = np.linalg.norm(residual[:, :3], axis=1)
    mask: NDArray[np.bool_] = (distance > 6.0 * np.sqrt(6.0) * usual) & (turn > 0.05)
    return mask
