"""The simulated camera shows lights, trails and boards where plain projection says they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.beacon.geometry import Beacon, Led
from uvgs_bench.camera.boards import Board, BoardView, find_board
from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.sim.board_views import SimulatedBoardSource, ray_slopes
from uvgs_bench.devices.sim.camera import SimulatedCamera
from uvgs_bench.devices.sim.truth import Glints, Occlusion, SimulatedTruth, TrueCamera, TrueLight
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.units import s_from_ns

AXIS = np.array([0.0, 0.0, -1.0])
BEACON = Beacon(
    "test",
    tuple(
        Led(name, np.array(position), AXIS, np.radians(70.0), 0.005)
        for name, position in (
            ("a", (-0.05, 0.04, 0.0)),
            ("b", (0.05, 0.04, 0.0)),
            ("c", (0.0, -0.06, 0.0)),
            ("d", (0.01, 0.01, -0.05)),
        )
    ),
)
# Fine digits and little noise: what is left is how the picture is made.
FINE = replace(
    TrueCamera(),
    bit_depth=16,
    peak_dn_at_1m=30000.0,
    gain_e_per_dn=1000.0,
    full_well_e=1e9,
    read_noise_dn=0.1,
    black_dn=10.0,
)


class MovingBeacon:
    """A scene that moves steadily."""

    def __init__(
        self, truth: SimulatedTruth, start: Pose, velocity_mps: tuple[float, float, float] = (0, 0, 0)
    ) -> None:
        self.truth, self.seed, self.true_beacon = truth, truth.seed, BEACON
        self.companions: tuple[tuple[Pose, Beacon], ...] = ()
        camera = truth.camera
        self.true_lens = Lens(camera.model, camera.width_px, camera.height_px, np.array(camera.parameters_px))
        self._start, self._velocity_mps = start, np.array(velocity_mps)

    def true_camera_from_beacon(self, t_ns: int) -> Pose:
        return Pose(self._start.R, self._start.t_m + s_from_ns(t_ns) * self._velocity_mps, "camera", "beacon")

    def true_camera_from(self, frame: str, t_ns: int) -> Pose:
        return Pose.identity("camera", frame)


def pose(x: float, y: float, z: float, *turn_deg: float) -> Pose:
    return Pose(so3_exp(np.radians(np.array(turn_deg or (0.0, 0.0, 0.0)))), np.array([x, y, z]), "camera", "beacon")


def moments(image: np.ndarray, px: np.ndarray, floor: float, half: int = 14) -> tuple[np.ndarray, np.ndarray, float]:
    """Centroid, covariance and sum of the light around a pixel."""
    j, i = np.round(px).astype(int)
    window = image[i - half : i + half + 1, j - half : j + half + 1].astype(np.float64) - floor
    v, u = np.mgrid[i - half : i + half + 1, j - half : j + half + 1]
    places = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
    weight = window.ravel()
    centre = weight @ places / weight.sum()
    apart = places - centre
    return centre, (weight[:, None] * apart).T @ apart / weight.sum(), float(weight.sum())


@pytest.mark.parametrize(
    "where", [pose(0, 0, 0.9), pose(-0.35, 0.25, 0.8, 20.0, -15.0, 10.0), pose(0.1, -0.1, 0.5, -25.0, 20.0, 0.0)]
)
def test_centroids_are_the_projected_leds(where: Pose) -> None:
    scene = MovingBeacon(SimulatedTruth(camera=FINE), where)
    image = SimulatedCamera(scene, "sim:x", None).grab().image
    floor = FINE.black_dn + FINE.background_dn
    for px in scene.true_lens.project(where.apply(BEACON.positions_m)):
        # A tilted disc of 5 mm at 0.5 m is seen off its centre by f r^2 sin(2 tilt) / 4 z^2 = 0.005 px; noise is below.
        assert moments(image, px, floor)[0] == pytest.approx(px, abs=0.01)


def test_moving_light_leaves_a_trail_as_long_as_speed_times_exposure() -> None:
    truth = SimulatedTruth(camera=replace(FINE, exposure_ms=20.0, peak_dn_at_1m=6000.0))
    speed_mps, z_m = 0.4, 1.0
    still = SimulatedCamera(MovingBeacon(truth, pose(0, 0, z_m)), "sim:x", None).grab()
    camera = SimulatedCamera(MovingBeacon(truth, pose(0, 0, z_m), (speed_mps, 0.0, 0.0)), "sim:x", None)
    moving = camera.grab()
    floor = FINE.black_dn + FINE.background_dn * 5.0
    lens = MovingBeacon(truth, pose(0, 0, z_m)).true_lens
    middle_m = BEACON.positions_m[0] + np.array([0.0, 0.0, z_m])
    trail_m = speed_mps * 0.020
    at_mid = lens.project(middle_m + np.array([trail_m / 2, 0.0, 0.0]))[0]
    ends = lens.project(middle_m + np.array([[0.0, 0.0, 0.0], [trail_m, 0.0, 0.0]]))
    centre, blurred, light = moments(moving.image, at_mid, floor, 16)
    _, sharp, still_light = moments(still.image, ends[0], floor, 16)
    length_px = np.sqrt(12.0 * (blurred[0, 0] - sharp[0, 0]))
    # A uniform trail has the variance L^2 / 12; here L is 8 px, and its middle is where the light is at mid-exposure.
    assert length_px == pytest.approx(np.linalg.norm(ends[1] - ends[0]), rel=0.01)
    assert centre == pytest.approx(at_mid, abs=0.01)
    assert blurred[1, 1] == pytest.approx(sharp[1, 1], abs=0.02)
    assert light == pytest.approx(still_light, rel=0.005)
    assert moving.t_ns == 10_000_000


def test_delay_stamps_later_than_mid_exposure() -> None:
    truth = SimulatedTruth(camera=replace(TrueCamera(), exposure_ms=6.0, delay_ms=35.0))
    capture = SimulatedCamera(MovingBeacon(truth, pose(0, 0, 1)), "sim:x", None).grab()
    assert capture.t_ns == 38_000_000
    assert capture.exposure_s == pytest.approx(0.006)


def bright(image: np.ndarray, px: np.ndarray) -> bool:
    j, i = np.round(px).astype(int)
    return bool(image[i, j] > 100)


def test_default_led_is_bright_but_not_saturated_and_occluded_leds_are_gone() -> None:
    where = pose(0, 0, 1.0)
    truth = SimulatedTruth(occlusion=Occlusion(leds=("b",)))
    scene = MovingBeacon(truth, where)
    image = SimulatedCamera(scene, "sim:x", None).grab().image
    px = scene.true_lens.project(where.apply(BEACON.positions_m))
    assert [bright(image, p) for p in px] == [True, False, True, True]
    assert 160 < image.max() < 220


def test_occlusion_by_chance_has_its_rate() -> None:
    where = pose(0, 0, 1.0)
    scene = MovingBeacon(SimulatedTruth(occlusion=Occlusion(probability=0.3)), where)
    camera = SimulatedCamera(scene, "sim:x", None, count=60)
    px = scene.true_lens.project(where.apply(BEACON.positions_m))
    seen = [bright(capture.image, p) for capture in camera for p in px]
    # 240 draws: sigma sqrt(0.3 * 0.7 / 240) = 0.03, three times that.
    assert np.mean(seen) == pytest.approx(0.7, abs=0.09)


def test_other_lights_and_glints_appear() -> None:
    light = TrueLight("camera", (200.0, 100.0, 1000.0), peak_dn_at_1m=150.0)
    truth = SimulatedTruth(lights=(light,), glints=Glints(probability=1.0, count=3, peak_dn=200.0))
    plain = MovingBeacon(SimulatedTruth(), pose(0, 0, 1.0))
    scene = MovingBeacon(truth, pose(0, 0, 1.0))
    image = SimulatedCamera(scene, "sim:x", None).grab().image.astype(int)
    without = SimulatedCamera(plain, "sim:x", None).grab().image
    assert bright(image, scene.true_lens.project(np.array([0.2, 0.1, 1.0]))[0])
    assert not bright(without, scene.true_lens.project(np.array([0.2, 0.1, 1.0]))[0])
    far = np.abs(image - without) > 12
    assert far.sum() > 20


@pytest.mark.opencv
@pytest.mark.parametrize(
    "board", [Board("charuco", "charuco", 9, 6, 0.03, 0.022, "DICT_5X5_100"), Board("chess", "chessboard", 9, 6, 0.025)]
)
def test_board_corners_are_found_where_they_are(board: Board) -> None:
    source = SimulatedBoardSource(SimulatedTruth(), board, 4)
    lens = Lens("plumb_bob", 1280, 960, np.array(TrueCamera().parameters_px))
    errors = []
    for capture, camera_from_board in zip(source, source.true_camera_from_board, strict=True):
        view = find_board(capture.image, board, capture.source)
        assert isinstance(view, BoardView), view
        assert len(view.px) == len(board.points_m)
        errors.append(view.px - lens.project(camera_from_board.apply(view.board_m)))
    error = np.concatenate(errors)
    # Noise of 1-2 DN against a step of 160 DN leaves corners with about 0.02 px; half a pixel of convention would show.
    assert np.abs(error.mean(axis=0)).max() < 0.01
    assert np.sqrt((error**2).mean()) < 0.04


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("plumb_bob", TrueCamera().parameters_px),
        ("fov", (610.0, 608.0, 630.0, 500.0, 0.92)),
        ("equidistant", (420.0, 420.0, 640.0, 480.0, 0.01, -0.003, 0.001, 0.0)),
    ],
)
def test_ray_slopes_lead_back_to_their_pixels(model: str, parameters: tuple[float, ...]) -> None:
    lens = Lens(model, 1280, 960, np.array(parameters))
    slopes = ray_slopes(lens)
    assert slopes.shape == (960, 1280, 2)
    rng = np.random.default_rng(8)
    i, j = rng.integers(0, 960, 500), rng.integers(0, 1280, 500)
    points = np.column_stack([slopes[i, j], np.ones(500)])
    px = lens.project(points)
    there = np.isfinite(points).all(axis=1)
    assert there.sum() > 300
    # As the function says: 1e-4 px of interpolation.
    assert np.abs(px[there] - np.column_stack([j, i])[there]).max() < 1e-4


@pytest.mark.opencv
def test_board_views_are_diverse_and_repeat() -> None:
    board = Board("chess", "chessboard", 9, 6, 0.025)
    first, again = (SimulatedBoardSource(SimulatedTruth(), board, 12) for _ in range(2))
    lens = Lens("plumb_bob", 1280, 960, np.array(TrueCamera().parameters_px))
    px = np.array([lens.project(p.apply(board.points_m)) for p in first.true_camera_from_board])
    assert lens.contains(px.reshape(-1, 2)).all()
    # Inner corners (a square and a half from the paper's edge) reach into the outer eighth on every side.
    assert (px.min(axis=(0, 1)) < [160.0, 120.0]).all()
    assert (px.max(axis=(0, 1)) > [1120.0, 840.0]).all()
    tilt_deg = [np.degrees(np.arccos(p.R[2, 2])) for p in first.true_camera_from_board]
    assert max(tilt_deg) < 45.0
    assert max(tilt_deg) - min(tilt_deg) > 15.0
    assert np.array_equal(first.grab().image, again.grab().image)
    other = SimulatedBoardSource(SimulatedTruth(), board, 1, seed=9)
    assert not other.true_camera_from_board[0].is_close(first.true_camera_from_board[0], 1e-3, 1e-4)
