"""Blind benches: a bench with planted causes as plain numbers, seen by the sensor's own solver, without pictures.

The true LEDs are projected through the true lens from where the carriage truly was; the solver then works with the
lens and beacon it was told. So a planted cause acts on poses as it would in reality.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.bench_model import predicted
from uvgs_bench.accuracy.observations import Mount, Observations, Role
from uvgs_bench.accuracy.pose_sensitivity import pose_pixel_jacobian
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.sensor.batch import solve_batch
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.units import m_from_mm, ns_from_s, rad_from_deg

_Three = tuple[float, float, float]
_ZERO: _Three = (0.0, 0.0, 0.0)
# The shipped tetrahedron, which faces the camera at identity.
_LEDS_MM = ((5.0, 77.0, -2.0), (-50.0, -68.0, -16.0), (54.0, -9.0, -13.0), (33.0, -48.0, -62.0))
_HALF_CONE_RAD = rad_from_deg(70.0)
_SHOT_INTERVAL_S = 0.1
PLANTABLE = (
    "axis_scale",
    "squareness",
    "backlash",
    "latency",
    "focal_length",
    "principal_point",
    "distortion",
    "led_offset",
    "slip",
    "drift",
    "saturation",
    "wrong_labels",
)
"""Causes ``planted`` knows."""


@dataclass(frozen=True, slots=True, eq=False)
class BlindBench:
    """One true bench. With every cause at its neutral value the sensor is told the truth.

    Args:
        lens: The lens the sensor is told.
        leds_m: LED positions the sensor is told, beacon frame, shape (L, 3), m.
        left: True left pose at the start of the run, as in a registration.
        right: True right pose.
        mount: Which part rides the carriage.
        centroid_sigma_px: Standard deviation of each centroid coordinate, new in every capture, px; known to the
            sensor.
        place_sigma_px: The same for what all captures of a place share, px; not known to the sensor.
        gantry_repeatability_m: Standard deviation per axis of where a visit stops, m.
        axis_scale: Excess of the true travel of each axis over the reported one, relative.
        shear_rad: Lean of the axes xy, xz, yz towards one another, rad.
        backlash_m: Whole reversal of each axis, m.
        delay_s: How much later than mid-exposure captures are stamped, s.
        focal_factor: True focal length over the one told.
        principal_offset_px: True principal point less the one told, px.
        distortion_offset: True first distortion coefficients less those told, any length up to the lens'.
        led_offset_m: True LED positions less those told, shape (L, 3), m.
        drift_mps: Velocity of the camera's mount, in camera axes, m/s.
        slip_m: How far the beacon slips on its mount half-way through the run, carried axes, m.
        saturation_px: How far saturated centroids are drawn towards their common centre, px.
        saturation_range_m: Range below which LEDs saturate, m.
        swapped_fraction: Share of captures with two LEDs named wrongly.
    """

    lens: Lens
    leds_m: FloatArray
    left: Pose
    right: Pose
    mount: Mount = "beacon_on_carriage"
    centroid_sigma_px: float = 0.05
    place_sigma_px: float = 0.0
    gantry_repeatability_m: float = 1e-5
    axis_scale: _Three = _ZERO
    shear_rad: _Three = _ZERO
    backlash_m: _Three = _ZERO
    delay_s: float = 0.0
    focal_factor: float = 1.0
    principal_offset_px: tuple[float, float] = (0.0, 0.0)
    distortion_offset: tuple[float, ...] = ()
    led_offset_m: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    drift_mps: _Three = _ZERO
    slip_m: _Three = _ZERO
    saturation_px: float = 0.0
    saturation_range_m: float = 0.0
    swapped_fraction: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "leds_m", read_only(self.leds_m, (-1, 3)))
        offset = self.led_offset_m if len(self.led_offset_m) else np.zeros_like(self.leds_m)
        object.__setattr__(self, "led_offset_m", read_only(offset, self.leds_m.shape))

    @property
    def true_lens(self) -> Lens:
        """The lens that makes the pictures."""
        parameters = self.lens.parameters.copy()
        parameters[:2] *= self.focal_factor
        parameters[2:4] += self.principal_offset_px
        parameters[4 : 4 + len(self.distortion_offset)] += self.distortion_offset
        return self.lens.with_parameters(parameters)

    @property
    def axes_matrix(self) -> FloatArray:
        """True travel from reported travel, gantry axes, shape (3, 3): columns are what the axes truly do."""
        xy, xz, yz = self.shear_rad
        M = np.array([[1.0, xy, xz], [0.0, 1.0, yz], [0.0, 0.0, 1.0]])
        scaled: FloatArray = M / np.linalg.norm(M, axis=0) * (1.0 + np.array(self.axis_scale))
        return scaled


@dataclass(frozen=True, slots=True, eq=False)
class PlannedStations:
    """S stations to observe, in the order of visiting; a moving capture is a station of its own.

    Args:
        position_m: Reported carriage positions, gantry axes, shape (S, 3), m.
        velocity_mps: Carriage velocities at the capture, shape (S, 3), m/s; 0 at rest.
        approach: Sign of each axis' last motion, shape (S, 3); 0 unknown.
        t_s: Instants from the start of the run, shape (S,), s.
        shots: Captures at each station, shape (S,).
        place: Place of each station, shape (S,); stations that revisit a place share it.
        role: Role of each station, length S.
        session: Session of each station, shape (S,).
        R_gs: Rotation gantry_from_carriage at each station, shape (S, 3, 3).
    """

    position_m: FloatArray
    velocity_mps: FloatArray
    approach: NDArray[np.int8]
    t_s: FloatArray
    shots: NDArray[np.int64]
    place: NDArray[np.int64]
    role: tuple[Role, ...]
    session: NDArray[np.int64]
    R_gs: FloatArray

    @property
    def count(self) -> int:
        """Number of stations."""
        return len(self.position_m)


def random_bench(rng: np.random.Generator, *, is_oblique: bool = True) -> BlindBench:
    """A clean bench as laboratories build them: somewhere before a camera, nothing planted.

    Args:
        rng: Source of randomness.
        is_oblique: Whether the camera looks obliquely to all axes; else nearly along y. Along an axis an error of the
            focal length looks like one of that axis' scale, and a lean towards it hides in the depth errors.

    Returns:
        The bench; gantry zero lies in the middle of the volume.
    """
    parameters = np.array([1002.0, 1002.0, 640.0, 478.0, -0.08, 0.045, 0.0, 0.0, 0.0])
    parameters[:4] += rng.normal(scale=(8.0, 0.0, 6.0, 6.0))
    parameters[1] = parameters[0] * (1.0 + rng.normal(scale=5e-4))
    # Gantry x to the right, y away from the camera, z up.
    R_cg = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    if is_oblique:
        yaw, pitch = (rad_from_deg(rng.uniform(20.0, 35.0)) * rng.choice((-1.0, 1.0)) for _ in range(2))
        R_cg = so3_exp(np.array([pitch, 0.0, 0.0])) @ so3_exp(np.array([0.0, yaw, 0.0])) @ R_cg
    else:
        R_cg = so3_exp(rng.normal(scale=0.01, size=3)) @ R_cg
    t_cg = np.array([*rng.normal(scale=0.02, size=2), rng.uniform(0.8, 1.1)])
    tilt, roll = rng.uniform(0.1, 0.4), rng.uniform(-np.pi, np.pi)
    about = rng.uniform(-np.pi, np.pi)
    R_cb = so3_exp(tilt * np.array([np.cos(about), np.sin(about), 0.0])) @ so3_exp(np.array([0.0, 0.0, roll]))
    return BlindBench(
        lens=Lens("plumb_bob", 1280, 960, parameters),
        leds_m=m_from_mm(np.array(_LEDS_MM)),
        left=Pose(R_cg, t_cg, "camera", "gantry"),
        right=Pose(R_cg.T @ R_cb, rng.normal(scale=0.02, size=3), "carriage", "beacon"),
        centroid_sigma_px=float(rng.uniform(0.03, 0.08)),
        place_sigma_px=float(rng.uniform(0.0, 0.03)),
        gantry_repeatability_m=float(rng.uniform(5e-6, 3e-5)),
    )


def planted(bench: BlindBench, cause: str, size: float, index: int = 0) -> BlindBench:
    """The bench with one cause added.

    Args:
        bench: A bench.
        cause: One of ``PLANTABLE``.
        size: Relative for axis_scale, focal_length and wrong_labels (share of captures), rad for squareness, s for
            latency, px for principal_point and saturation, m/s for drift, m for the rest; added to k1 for distortion.
        index: Which axis, pair of axes, LED or direction, where there are several; backlash is on all axes.

    Returns:
        Another bench.

    Raises:
        ValueError: An unknown cause.
    """
    one = [0.0, 0.0, 0.0]
    one[index % 3] = size
    three: _Three = (one[0], one[1], one[2])
    if cause == "axis_scale":
        return replace(bench, axis_scale=three)
    if cause == "squareness":
        return replace(bench, shear_rad=three)
    if cause == "backlash":
        return replace(bench, backlash_m=(size, size, size))
    if cause == "latency":
        return replace(bench, delay_s=size)
    if cause == "focal_length":
        return replace(bench, focal_factor=1.0 + size)
    if cause == "principal_point":
        return replace(bench, principal_offset_px=(size, 0.0) if index % 2 == 0 else (0.0, size))
    if cause == "distortion":
        return replace(bench, distortion_offset=(size,))
    if cause == "led_offset":
        offset = np.zeros_like(bench.leds_m)
        offset[index // 3 % len(offset), index % 3] = size
        return replace(bench, led_offset_m=offset)
    if cause == "slip":
        return replace(bench, slip_m=three)
    if cause == "drift":
        return replace(bench, drift_mps=three)
    if cause == "saturation":
        return replace(bench, saturation_px=size, saturation_range_m=float(np.linalg.norm(bench.left.t_m)))
    if cause == "wrong_labels":
        return replace(bench, swapped_fraction=size)
    raise ValueError(f"unknown cause '{cause}', expected one of {', '.join(PLANTABLE)}")


def standard_stations(
    rng: np.random.Generator,
    *,
    places: int = 36,
    revisits: int = 12,
    moving: int = 12,
    shots: int = 3,
    half_m: _Three = (0.14, 0.14, 0.12),
    is_turning: bool = False,
) -> PlannedStations:
    """Stations that tell the causes apart: spread over the volume, from all sides, some again, some in motion.

    Args:
        rng: Source of randomness.
        places: Places visited at rest, approached from either side of every axis at random.
        revisits: Places visited a second time at the end, from the opposite side.
        moving: Captures taken in passing, both ways along each axis.
        shots: Captures per visit at rest.
        half_m: Half edges of the box around gantry zero, m.
        is_turning: Whether a rotary axis turns the carriage by up to 20 degrees about gantry z.

    Returns:
        The stations; every third place registers.
    """
    half = np.array(half_m)
    # Each axis is cut into as many slices as there are places and every slice used once, so that few places fill a box.
    at = (np.array([rng.permutation(places) for _ in range(3)]).T + rng.uniform(size=(places, 3))) / places
    resting = (2.0 * at - 1.0) * half
    sides = rng.choice(np.array([-1, 1], dtype=np.int8), size=(places, 3))
    again = rng.permutation(places)[:revisits]
    passing = rng.uniform(-1.0, 1.0, (moving, 3)) * half
    velocity = np.zeros((moving, 3))
    axis = np.arange(moving) % 3
    velocity[np.arange(moving), axis] = np.where(np.arange(moving) // 3 % 2 == 0, 1.0, -1.0) * rng.uniform(
        0.04, 0.06, moving
    )
    came = rng.choice(np.array([-1, 1], dtype=np.int8), size=(moving, 3))
    came[np.arange(moving), axis] = np.sign(velocity[np.arange(moving), axis])
    position = np.concatenate([resting, resting[again], passing])
    speed = np.concatenate([np.zeros((places + revisits, 3)), velocity])
    approach = np.concatenate([sides, -sides[again], came]).astype(np.int8)
    place = np.concatenate([np.arange(places), again, places + np.arange(moving)])
    count = np.concatenate([np.full(places + revisits, shots), np.ones(moving, dtype=np.int64)])
    turn = rng.uniform(-0.35, 0.35, places + moving)[place] if is_turning else np.zeros(len(place))
    # Passing captures lie between visits, so that time and motion are not one thing; revisits stay late, for drift.
    order = np.argsort(
        np.concatenate([rng.uniform(0.0, 0.8, places), rng.uniform(0.8, 1.0, revisits), rng.uniform(size=moving)])
    )
    S = len(position)
    return PlannedStations(
        position_m=read_only(position[order]),
        velocity_mps=read_only(speed[order]),
        approach=approach[order],
        t_s=read_only(4.0 * np.arange(S)),
        shots=count[order].astype(np.int64),
        place=place[order].astype(np.int64),
        role=tuple("register" if p % 3 == 0 else "judge" for p in place[order].tolist()),
        session=np.zeros(S, dtype=np.int64),
        R_gs=read_only(np.array([so3_exp(np.array([0.0, 0.0, angle])) for angle in turn[order]]).reshape(S, 3, 3)),
    )


def observe(bench: BlindBench, stations: PlannedStations, rng: np.random.Generator) -> Observations:
    """What gantry and sensor say of a bench.

    Args:
        bench: The truth.
        stations: Where captures are taken.
        rng: Source of randomness.

    Returns:
        One row per capture in the order of taking; views with an LED out of the picture or its cone are misses, and so
        are fits the sensor would refuse.
    """
    S, shots = stations.count, stations.shots
    of_station = np.repeat(np.arange(S), shots)
    N, L = len(of_station), len(bench.leds_m)
    number = np.arange(N) - np.repeat(np.cumsum(shots) - shots, shots)
    t_s = stations.t_s[of_station] + _SHOT_INTERVAL_S * number

    stop = stations.position_m - stations.velocity_mps * bench.delay_s - 0.5 * stations.approach * bench.backlash_m
    stop = stop + rng.normal(scale=bench.gantry_repeatability_m, size=(S, 3))
    R_g, t_g = stations.R_gs[of_station], (stop @ bench.axes_matrix.T)[of_station]
    if bench.mount == "camera_on_carriage":
        R_g = R_g.transpose(0, 2, 1)
        t_g = -np.einsum("nij,nj->ni", R_g, t_g)
    R, t = predicted(bench.left, bench.right, R_g, t_g)
    late = t_s > 0.5 * t_s[-1]
    if bench.mount == "beacon_on_carriage":
        t = t + late[:, None] * np.einsum("nij,j->ni", bench.left.R @ R_g, np.array(bench.slip_m))
    else:
        t = t + late[:, None] * np.array(bench.slip_m)
    t = t - t_s[:, None] * np.array(bench.drift_mps)

    points = np.einsum("nij,lj->nli", R, bench.leds_m + bench.led_offset_m) + t[:, None]
    px = bench.true_lens.project(points.reshape(-1, 3)).reshape(N, L, 2)
    is_inside = bench.lens.contains(px.reshape(-1, 2), 5.0).reshape(N, L).all(axis=1)
    sight = points / np.linalg.norm(points, axis=2, keepdims=True)
    # LEDs shine towards -z of the beacon.
    is_facing = (np.einsum("nli,ni->nl", sight, R[:, :, 2]) > np.cos(_HALF_CONE_RAD)).all(axis=1)
    is_saturated = np.linalg.norm(t, axis=1) < bench.saturation_range_m
    inwards = px.mean(axis=1, keepdims=True) - px
    inwards = inwards / np.maximum(np.linalg.norm(inwards, axis=2, keepdims=True), 1e-9)
    px = px + (bench.saturation_px * is_saturated)[:, None, None] * inwards
    _, of_place = np.unique(stations.place[of_station], return_inverse=True)
    px = px + rng.normal(scale=bench.place_sigma_px, size=(int(of_place.max()) + 1, L, 2))[of_place]
    px = px + rng.normal(scale=bench.centroid_sigma_px, size=(N, L, 2))
    swapped = np.flatnonzero(rng.uniform(size=N) < bench.swapped_fraction)
    px[swapped, :2] = px[swapped, 1::-1]
    return _answered(bench, stations, of_station, t_s, px, is_inside & is_facing, is_saturated)


def _answered(
    bench: BlindBench,
    stations: PlannedStations,
    of_station: NDArray[np.intp],
    t_s: FloatArray,
    px: FloatArray,
    is_seen: NDArray[np.bool_],
    is_saturated: NDArray[np.bool_],
) -> Observations:
    """The sensor's answers to centroids, with the gantry's side of the captures."""
    N, L = px.shape[:2]
    config = UvgsConfig()
    sigma = np.full(L, bench.centroid_sigma_px)
    shown = np.where(is_seen[:, None, None], px, 0.5 * bench.lens.width_px)
    found = solve_batch(bench.lens, bench.leds_m, shown, sigma)
    is_solved = is_seen & found.converged
    R = np.where(is_solved[:, None, None], found.R_cb, np.nan)
    t = np.where(is_solved[:, None], found.t_cb_m, np.nan)
    covariance = np.full((N, 6, 6), np.nan)
    squares = np.full(N, np.inf)
    rows = np.flatnonzero(is_solved)
    J, at = pose_pixel_jacobian(bench.lens, bench.leds_m, R[rows], t[rows])
    covariance[rows] = bench.centroid_sigma_px**2 * np.linalg.inv(np.einsum("nkui,nkuj->nij", J, J))
    squares[rows] = ((px[rows] - at) ** 2).sum(axis=(1, 2))
    variance = bench.centroid_sigma_px**2 + config.model_error_px**2
    is_refused = is_solved & ~(squares <= config.max_chi2_per_dof * (2 * L - 6) * variance)
    is_solved &= ~is_refused
    for values in (R, t, covariance):
        values[~is_solved] = np.nan
    words = np.where(is_solved, "", np.where(is_refused, "validate/residual_too_large", "selection/too_few_blobs"))
    return Observations(
        station=of_station.astype(np.int64),
        role=tuple(stations.role[s] for s in of_station.tolist()),
        t_ns=np.array([ns_from_s(value) for value in t_s.tolist()], dtype=np.int64),
        axis_position=read_only(stations.position_m[of_station]),
        R_gs=read_only(stations.R_gs[of_station]),
        t_gs_m=read_only(stations.position_m[of_station]),
        R_cb=read_only(R),
        t_cb_m=read_only(t),
        covariance=read_only(covariance),
        is_solved=is_solved,
        reason=tuple(words.tolist()),
        mount=bench.mount,
        place=stations.place[of_station],
        velocity_gs_mps=read_only(stations.velocity_mps[of_station]),
        approach=stations.approach[of_station],
        session=stations.session[of_station],
        is_saturated=is_saturated,
        rms_px=read_only(np.where(is_solved, np.sqrt(squares / (2 * L)), np.nan)),
        blob_count=np.where(is_seen, L, 0).astype(np.int64),
        led_px=read_only(np.where(is_seen[:, None, None], px, np.nan)),
    )
