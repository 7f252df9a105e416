"""Named centroids of a beacon whose LEDs are not quite where its drawing has them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.helpers import spots
from uvgs_bench.beacon import Beacon
from uvgs_bench.beacon.measure import LedView
from uvgs_bench.camera.boards import BoardView
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_exp

LENS = Lens("plumb_bob", 1280, 960, np.array([1100.0, 1100.0, 640.0, 480.0, -0.08, 0.03, 4e-4, -3e-4, 0.0]))
CAMERA_FROM_GANTRY = Pose(so3_exp(np.array([0.3, -0.2, 0.15])), np.array([0.02, -0.01, 1.0]), "camera", "gantry")


def displaced(nominal: Beacon, rng: np.random.Generator, sigma_m: float = 3e-4) -> Beacon:
    """The beacon as built: every LED a little off its drawing."""
    return moved(nominal, rng.normal(0.0, sigma_m, (len(nominal.leds), 3)))


def moved(nominal: Beacon, by_m: np.ndarray) -> Beacon:
    """The beacon with its LEDs displaced, (n, 3), m."""
    leds = tuple(replace(led, position_m=led.position_m + d) for led, d in zip(nominal.leds, by_m, strict=True))
    return Beacon(nominal.name, leds, nominal.hue)


def led_view(name: str, true: Beacon, pose: Pose, rng: np.random.Generator, sigma_px: float, **more: object) -> LedView:
    """Centroids of all LEDs at a pose, with a start a little beside it."""
    px = LENS.project(pose.apply(true.positions_m)) + rng.normal(0.0, sigma_px, (len(true.leds), 2))
    start = pose.perturbed(np.concatenate([rng.normal(0.0, 0.01, 3), rng.normal(0.0, 2e-3, 3)]))
    n = len(true.leds)
    return LedView(name, np.arange(n), px, np.full(n, sigma_px), start, **more)  # type: ignore[arg-type]


def tilted_pose(rng: np.random.Generator, range_m: float, tilt_deg: float = 45.0) -> Pose:
    """A pose near the middle of the picture, tilted up to an angle."""
    pose = spots.random_pose(rng, tilt_deg, range_m, range_m)
    return Pose(pose.R, np.array([*(0.4 * pose.t_m[:2]), range_m]), "camera", "beacon")


def board_points() -> np.ndarray:
    """A board of 6 x 5 points, 30 mm apart, around the LEDs."""
    y, x = np.mgrid[0:5, 0:6]
    return np.column_stack([x.ravel() - 2.5, y.ravel() - 2.0, np.full(30, 0.0)]) * 0.03


def board_views(true: Beacon, count: int, rng: np.random.Generator, sigma_px: float = 0.1) -> list[LedView]:
    """LEDs and a board fixed to the beacon; the board frame is the beacon frame."""
    out = []
    for i in range(count):
        pose = tilted_pose(rng, 0.6)
        corners = LENS.project(pose.apply(board_points())) + rng.normal(0.0, sigma_px, (30, 2))
        board = BoardView(f"v{i}", corners, board_points(), LENS.width_px, LENS.height_px)
        out.append(led_view(f"v{i}", true, pose, rng, sigma_px, board=board))
    return out


def free_views(true: Beacon, count: int, rng: np.random.Generator, sigma_px: float = 0.1) -> list[LedView]:
    """LEDs alone."""
    return [led_view(f"v{i}", true, tilted_pose(rng, 0.6), rng, sigma_px) for i in range(count)]


def gantry_views(
    true: Beacon,
    rng: np.random.Generator,
    sigma_px: float = 0.1,
    stop_m: float = 3e-5,
    half_m: tuple[float, float, float] = (0.4, 0.2, 0.2),
    side: int = 5,
    is_carried: bool = True,
) -> list[LedView]:
    """A grid of stations, near and far in turn; scale and squareness of the axes are off by their usual deviations.

    A station whose LEDs would leave the picture is moved inwards.
    """
    A = np.eye(3) + np.diag(rng.normal(0.0, 1e-4, 3)) + np.triu(rng.normal(0.0, 2e-4, (3, 3)), 1)
    sign = 1.0 if is_carried else -1.0
    out: list[LedView] = []
    for x in np.linspace(-half_m[0], half_m[0], side):
        for y in np.linspace(-half_m[1], half_m[1], side):
            carriage = np.array([x, y, half_m[2] * (-1.0) ** len(out)])
            while True:
                stop = A @ carriage + rng.normal(0.0, stop_m, 3)
                pose = CAMERA_FROM_GANTRY @ Pose(np.eye(3), sign * stop, "gantry", "beacon")
                if LENS.contains(LENS.project(pose.apply(true.positions_m)), 10.0).all():
                    break
                carriage = carriage * [0.9, 0.9, 1.0]
            out.append(led_view(f"s{len(out)}", true, pose, rng, sigma_px, carriage_m=carriage))
    return out
