"""How often the sensor names LEDs wrongly or refuses to: seeded views at the level of centroids, with stray lights.

Each view: a pose within a cone about facing at a random range and place in the picture; LEDs inside their emission
cones give centroids with noise and brightness that varies from part to part; stray lights are strewn over the picture
or near the beacon, of any brightness within a factor of 30. What the sensor makes of it is compared with the truth.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from math import cos, pi
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import rotation_angle, so3_exp
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.correspondence import LedMatch, LedTable, match_leds
from uvgs_bench.units import rad_from_deg

# A published pose is wrong when a light is named wrongly and the pose is off by more than this; a glint that stands in
# for an LED a pixel beside it is not an error of labels.
WRONG_TURN_RAD = 0.1
WRONG_SHIFT = 0.05
_PER_CHUNK = 500
_STRAY_LOG = (np.log(0.1), np.log(3.0))


@dataclass(frozen=True, slots=True)
class LabelConditions:
    """What is drawn.

    Args:
        focal_px: Focal length of a 1280 x 960 camera without distortion, px.
        noise_px: Centroid noise per axis, px; also what the sensor assumes.
        cone_deg: Widest angle between beacon and line of sight, degrees.
        near_m: Nearest range, m.
        far_m: Farthest range, m.
        lights: Stray lights strewn evenly over the picture.
        glints: Stray lights strewn evenly over a disc about the beacon that just holds it.
        hidden: LEDs hidden in each view.
        brightness_sigma: Deviation of the logarithm of LED brightness from part to part.
        knows_brightness: Whether the sensor is told the brightness of lights.
        is_alike: Whether stray lights are as bright as LEDs, instead of any brightness.
    """

    focal_px: float = 608.0
    noise_px: float = 0.2
    cone_deg: float = 60.0
    near_m: float = 0.5
    far_m: float = 3.0
    lights: int = 0
    glints: int = 0
    hidden: int = 0
    brightness_sigma: float = 0.3
    knows_brightness: bool = True
    is_alike: bool = False


@dataclass(slots=True)
class LabelFigures:
    """What came out.

    Args:
        views: Number of views.
        published: Poses published.
        wrong: Published poses that are wrong.
        wrong_unflagged: Those without a warning of weak evidence.
        flagged: Published poses with that warning.
        refused: Refusals by reason.
        view_s: Time of the search in each view, s.
        wrong_ranges_m: Range of each view with a wrong pose, m.
    """

    views: int = 0
    published: int = 0
    wrong: int = 0
    wrong_unflagged: int = 0
    flagged: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    view_s: list[float] = field(default_factory=list)
    wrong_ranges_m: list[float] = field(default_factory=list)

    @property
    def wrong_share(self) -> float:
        """Wrong poses per view."""
        return self.wrong / max(self.views, 1)

    @property
    def refused_share(self) -> float:
        """Refusals per view."""
        return sum(self.refused.values()) / max(self.views, 1)

    def summary(self) -> dict[str, object]:
        """The figures for a machine, without the single times."""
        return {
            "views": self.views,
            "published": self.published,
            "wrong": self.wrong,
            "wrong_unflagged": self.wrong_unflagged,
            "flagged": self.flagged,
            "refused": dict(self.refused),
            "median_s": float(np.median(self.view_s)) if self.view_s else None,
            "wrong_ranges_m": self.wrong_ranges_m,
        }

    def add(self, other: LabelFigures) -> None:
        """Count another part in."""
        for name in ("views", "published", "wrong", "wrong_unflagged", "flagged"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.refused += other.refused
        self.view_s += other.view_s
        self.wrong_ranges_m += other.wrong_ranges_m


def standard_scenes(lights: int = 3) -> dict[str, tuple[LabelConditions, float]]:
    """The scenes that are reported: name to conditions and the share of the clean views worth drawing.

    Args:
        lights: Other lights strewn over the picture in the scene that has them.
    """
    return {
        "clean": (LabelConditions(), 1.0),
        "clean, brightness not known": (LabelConditions(knows_brightness=False), 0.2),
        "clean, cone to 85 deg": (LabelConditions(cone_deg=85.0), 0.2),
        f"{lights} other lights": (LabelConditions(lights=lights), 0.2),
        "3 glints within the beacon's image": (LabelConditions(glints=3), 0.02),
        "one LED hidden, one glint": (LabelConditions(hidden=1, glints=1), 0.2),
        "one LED hidden, one glint as bright": (LabelConditions(hidden=1, glints=1, is_alike=True), 0.2),
    }


DEFINITIONS = (
    "view: 60 deg cone about facing, 0.5 to 3 m, f = 608 px, 1280 x 960, 0.2 px centroid noise, LED brightness varies "
    "by 30 % from part to part, stray lights by a factor of 30",
    "wrong: a pose was published with a light named wrongly, off by more than 0.1 rad or 5 % of range",
    "flagged: published with the warning weak_evidence; unflagged: wrong without it",
)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One drawn view.

    Args:
        pose: The true camera_from_beacon.
        px: Centroids in random order, shape (m, 2), px.
        looks: Logarithms of brightness and width (unknown), shape (m, 2).
        led_of_blob: LED of each light, or -1, shape (m,).
    """

    pose: Pose
    px: FloatArray
    looks: FloatArray
    led_of_blob: NDArray[np.int64]


def study_lens(conditions: LabelConditions) -> Lens:
    """The camera of the study."""
    f = conditions.focal_px
    return Lens("plumb_bob", 1280, 960, np.array([f, f, 639.5, 479.5, 0.0, 0.0, 0.0, 0.0, 0.0]))


def draw_view(beacon: Beacon, lens: Lens, conditions: LabelConditions, rng: np.random.Generator) -> View:
    """Draw until all LEDs that shine towards the camera, at least four before any is hidden, are in the picture."""
    positions = beacon.positions_m
    n = len(positions)
    while True:
        tilt = np.arccos(rng.uniform(cos(rad_from_deg(conditions.cone_deg)), 1.0))
        azimuth = rng.uniform(0.0, 2.0 * pi)
        turn = so3_exp(np.array([0.0, 0.0, rng.uniform(-pi, pi)])) @ so3_exp(
            tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        )
        ray = lens.unproject(rng.uniform([100.0, 100.0], [1180.0, 860.0])[None])[0]
        across = np.cross([0.0, 0.0, 1.0], ray)
        sine = float(np.linalg.norm(across))
        aim = so3_exp(across / sine * np.arctan2(sine, ray[2])) if sine > 0.0 else np.eye(3)
        centre = ray * rng.uniform(conditions.near_m, conditions.far_m)
        pose = Pose(aim @ turn, centre, "camera", "beacon")
        points = pose.apply(positions)
        distance = np.linalg.norm(points, axis=1)
        log_light = -2.0 * np.log(distance) + conditions.brightness_sigma * rng.standard_normal(n)
        lit = np.ones(n, dtype=bool)
        for i, led in enumerate(beacon.leds):
            if led.axis is None:
                continue
            cosine = -float(pose.R @ led.axis @ points[i]) / distance[i]
            limit = -1.0 if led.half_angle_rad is None else cos(led.half_angle_rad)
            lit[i] = cosine >= max(limit, 0.02)
            log_light[i] += np.log(max(cosine, 0.02))
        true = lens.project(points)
        if lit.sum() < 4 or not lens.contains(true[lit], 3.0).all():
            continue
        break
    shown = rng.permutation(np.flatnonzero(lit))[conditions.hidden :]
    middle = true[lit].mean(axis=0)
    radius = float(np.linalg.norm(true[lit] - middle, axis=1).max())
    r, phi = radius * np.sqrt(rng.uniform(size=conditions.glints)), rng.uniform(0.0, 2.0 * pi, conditions.glints)
    near = middle + np.column_stack([r * np.cos(phi), r * np.sin(phi)])
    far = rng.uniform([0.0, 0.0], [1279.0, 959.0], (conditions.lights, 2))
    strays = np.vstack([near, far])
    mean_light = float(log_light[lit].mean())
    if conditions.is_alike:
        stray_light = mean_light + conditions.brightness_sigma * rng.standard_normal(len(strays))
    else:
        stray_light = mean_light + rng.uniform(*_STRAY_LOG, len(strays))
    px = np.vstack([true[shown] + rng.normal(size=(len(shown), 2)) * conditions.noise_px, strays])
    names = np.concatenate([shown, np.full(len(strays), -1)])
    light = np.concatenate([log_light[shown], stray_light])
    order = rng.permutation(len(px))
    looks = np.column_stack([light[order], np.full(len(px), np.nan)])
    return View(pose, np.ascontiguousarray(px[order]), looks, names[order])


def is_wrong(match: LedMatch, view: View) -> bool:
    """Whether a published pose is wrong: a light is named wrongly and the pose is off."""
    named = view.led_of_blob[match.blob_of_led[match.blob_of_led >= 0]]
    if (named == np.flatnonzero(match.blob_of_led >= 0)).all():
        return False
    shift = float(np.linalg.norm(match.start.t_m - view.pose.t_m) / np.linalg.norm(view.pose.t_m))
    return rotation_angle(match.start.R.T @ view.pose.R) > WRONG_TURN_RAD or shift > WRONG_SHIFT


def _study_chunk(
    beacon: Beacon, conditions: LabelConditions, config: UvgsConfig, count: int, seed: tuple[int, int]
) -> LabelFigures:
    rng = np.random.default_rng(seed)
    lens = study_lens(conditions)
    leds = LedTable.of(beacon, config)
    out = LabelFigures(views=count)
    for _ in range(count):
        view = draw_view(beacon, lens, conditions, rng)
        if len(view.px) < 4:
            out.refused["too_few_blobs"] += 1
            continue
        sigma = np.full(len(view.px), conditions.noise_px)
        start = perf_counter()
        match = match_leds(
            view.px, sigma, lens, leds, config, None, view.looks if conditions.knows_brightness else None
        )
        out.view_s.append(perf_counter() - start)
        if not isinstance(match, LedMatch):
            out.refused[match.reason] += 1
            continue
        out.published += 1
        out.flagged += match.is_weak
        if is_wrong(match, view):
            out.wrong += 1
            out.wrong_unflagged += not match.is_weak
            out.wrong_ranges_m.append(float(np.linalg.norm(view.pose.t_m)))
    return out


def study_labels(
    beacon: Beacon,
    conditions: LabelConditions,
    config: UvgsConfig | None = None,
    *,
    count: int,
    seed: int = 0,
    workers: int = 1,
    progress: Callable[[int], None] | None = None,
) -> LabelFigures:
    """Draw views and count what becomes of them.

    Args:
        beacon: The beacon.
        conditions: What is drawn.
        config: Sensor parameters.
        count: Number of views.
        seed: Seed; the views do not depend on the number of workers.
        workers: Processes.
        progress: Called with the number of views done.

    Returns:
        The figures.
    """
    config = UvgsConfig() if config is None else config
    sizes = [_PER_CHUNK] * (count // _PER_CHUNK) + ([count % _PER_CHUNK] if count % _PER_CHUNK else [])
    jobs = [(beacon, conditions, config, size, (seed, i)) for i, size in enumerate(sizes)]
    total = LabelFigures()

    def take(part: LabelFigures) -> None:
        total.add(part)
        if progress is not None:
            progress(total.views)

    if workers <= 1:
        for job in jobs:
            take(_study_chunk(*job))
    else:
        with ProcessPoolExecutor(workers) as pool:
            for part in pool.map(_study_chunk, *zip(*jobs, strict=True)):
                take(part)
    return total
