from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers import beacon_views as bv
from tests.helpers import spots
from uvgs_bench.beacon import Beacon
from uvgs_bench.beacon.frames import FrameChoice, fit_rigid, place
from uvgs_bench.beacon.measure import Caliper, MeasureConfig, measure_beacon
from uvgs_bench.camera.boards import BoardView
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.errors import CalibrationError, ConfigError, TooFewViews
from uvgs_bench.geometry import Pose

NOMINAL = spots.beacon()
CAMERA = Calibration(bv.LENS, "simulated")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(2)


def test_few_tilts_are_refused_with_the_angle(rng):
    poses = [bv.tilted_pose(rng, 0.6, 4.0) for _ in range(10)]
    ahead = [Pose(pose.R, np.array([0.0, 0.0, 0.6]), "camera", "beacon") for pose in poses]
    views = [bv.led_view(f"v{i}", NOMINAL, pose, rng, 0.1) for i, pose in enumerate(ahead)]
    with pytest.raises(TooFewViews, match=r"seen from directions within \d+\.\d deg, at least 15 deg"):
        measure_beacon(views, NOMINAL, CAMERA, MeasureConfig("free"))


def test_few_stations_are_refused_with_their_number(rng):
    with pytest.raises(TooFewViews, match="4 stations with named LEDs, at least 6"):
        measure_beacon(bv.gantry_views(NOMINAL, rng)[:4], NOMINAL, CAMERA, MeasureConfig("gantry"))


def test_stations_along_a_line_are_refused(rng):
    views = bv.gantry_views(NOMINAL, rng, half_m=(0.2, 0.0, 0.0))
    with pytest.raises(TooFewViews, match="along one line"):
        measure_beacon(views, NOMINAL, CAMERA, MeasureConfig("gantry"))


def test_a_short_travel_is_refused_by_its_doubt(rng):
    views = bv.gantry_views(NOMINAL, rng, half_m=(0.03, 0.03, 0.0), side=3)
    with pytest.raises(TooFewViews, match=r"open to ± \d+\.\d+ mm"):
        measure_beacon(views, NOMINAL, CAMERA, MeasureConfig("gantry"))


def test_views_without_the_board_are_refused(rng):
    with pytest.raises(TooFewViews, match="v0: the board is not seen"):
        measure_beacon(bv.free_views(NOMINAL, 8, rng), NOMINAL, CAMERA, MeasureConfig("board"))


def test_axes_declared_mirrored_are_named(rng):
    views = [replace(v, carriage_m=v.carriage_m * [1, -1, 1]) for v in bv.gantry_views(NOMINAL, rng)]
    with pytest.raises(CalibrationError, match="declared mirrored"):
        measure_beacon(views, NOMINAL, CAMERA, MeasureConfig("gantry"))


def test_a_nominal_in_a_left_handed_frame_is_named(rng):
    flip = np.diag([1.0, 1.0, -1.0])
    leds = tuple(replace(led, position_m=flip @ led.position_m, axis=None) for led in NOMINAL.leds)
    mirrored = Beacon("mirrored", leds)
    # Started from the mirror image with the poses it suggests, the adjustment ends in the mirror minimum.
    turned = []
    for v in bv.free_views(NOMINAL, 12, rng):
        p = v.camera_from_beacon
        look = p.t_m / np.linalg.norm(p.t_m)
        R = (np.eye(3) - 2.0 * np.outer(look, look)) @ p.R @ flip
        turned.append(replace(v, camera_from_beacon=Pose(R, p.t_m, "camera", "beacon")))
    with pytest.raises(CalibrationError, match=r"mirror image .* fits better"):
        measure_beacon(turned, mirrored, CAMERA, MeasureConfig("free"))


def test_a_mirror_image_that_fits_as_well_is_inconclusive(rng):
    # From 12 m a beacon 130 mm across shows no perspective: 0.03 px of depth against 0.1 px of noise.
    views = [bv.led_view(f"v{i}", NOMINAL, bv.tilted_pose(rng, 12.0, 45.0), rng, 0.1) for i in range(12)]
    with pytest.raises(TooFewViews, match="mirror image"):
        measure_beacon(views, NOMINAL, CAMERA, MeasureConfig("free", nominal_sigma_m=5e-3, worst_sigma_m=1.0))


def test_a_wrong_square_size_is_named_by_the_calipers(rng):
    views = [
        replace(v, board=BoardView(v.name, v.board.px, v.board.board_m * 1.02, 1280, 960))
        for v in bv.board_views(NOMINAL, 8, rng)
    ]
    hand = []
    for i, j in ((0, 1), (1, 2)):
        a, b = NOMINAL.leds[i], NOMINAL.leds[j]
        hand.append(Caliper(a.name, b.name, float(np.linalg.norm(a.position_m - b.position_m))))
    found = measure_beacon(views, NOMINAL, CAMERA, MeasureConfig("board", calipers=tuple(hand)))
    assert any("against the calipers: the size of the squares" in line for line in found.warnings)
    assert "board" in found.scale_source


def test_two_leds_off_leave_the_nominal_scale_open(rng):
    off = np.zeros((4, 3))
    off[2], off[3] = [2e-3, 0.0, 0.0], [0.0, -3e-3, 0.0]
    views = bv.free_views(bv.moved(NOMINAL, off), 12, rng)
    with pytest.raises(TooFewViews, match="cannot give the scale"):
        measure_beacon(views, NOMINAL, CAMERA, MeasureConfig("free"))


def test_unknown_names_are_refused(rng):
    views = bv.free_views(NOMINAL, 8, rng)
    with pytest.raises(ConfigError, match="no LED is called 'top'"):
        measure_beacon(views, NOMINAL, CAMERA, MeasureConfig("free", calipers=(Caliper("top", "led0", 0.1),)))
    with pytest.raises(ConfigError, match="needs a measurement by gantry"):
        measure_beacon(views, NOMINAL, CAMERA, MeasureConfig("free", FrameChoice("gantry")))
    with pytest.raises(ConfigError, match="three LED names"):
        FrameChoice.parse("led0,led1")


@pytest.mark.parametrize("frame", ["nominal", "led0,led1,led2"])
def test_distances_and_their_doubt_do_not_depend_on_the_frame(rng, frame):
    views = bv.board_views(bv.displaced(NOMINAL, rng), 6, rng)
    by_board = measure_beacon(views, NOMINAL, CAMERA, MeasureConfig("board", FrameChoice("board")))
    other = measure_beacon(views, NOMINAL, CAMERA, MeasureConfig("board", FrameChoice.parse(frame)))
    for a, b in zip(by_board.distances, other.distances, strict=True):
        assert b.distance_m == pytest.approx(a.distance_m, abs=1e-12)
        assert b.sigma_m == pytest.approx(a.sigma_m, rel=1e-6)


def test_three_leds_set_the_frame_and_have_no_doubt_along_it(rng):
    views = bv.board_views(bv.displaced(NOMINAL, rng), 6, rng)
    found = measure_beacon(views, NOMINAL, CAMERA, MeasureConfig("board", FrameChoice.parse("led0,led1,led2")))
    p, C = found.beacon.positions_m, np.diag(found.beacon.covariance_m2)
    # Zero by definition, to rounding of metres and of m^2.
    np.testing.assert_allclose([*p[0], p[1, 1], p[1, 2], p[2, 2]], 0.0, atol=1e-15)
    np.testing.assert_allclose(C[[0, 1, 2, 4, 5, 8]], 0.0, atol=1e-18)
    assert p[1, 0] > 0.0
    assert p[2, 1] > 0.0
    assert (C[[3, 6, 7, 9, 10, 11]] > 0.0).all()
    # The emission axes turn with the frame.
    R, _ = fit_rigid(NOMINAL.positions_m, p)
    np.testing.assert_allclose(found.beacon.leds[0].axis, R @ [0.0, 0.0, -1.0], atol=1e-12)


def test_placing_keeps_no_doubt_along_rigid_motions(rng):
    A = rng.normal(size=(12, 12))
    points, C = place(NOMINAL.positions_m, A @ A.T, NOMINAL.positions_m, FrameChoice(), NOMINAL.led_names)
    np.testing.assert_allclose(points, NOMINAL.positions_m, atol=1e-14)
    assert np.linalg.matrix_rank(C, tol=1e-9) == 6


def test_noise_free_views_give_the_beacon_back(rng):
    true = bv.displaced(NOMINAL, rng)
    views = [replace(v, sigma_px=np.full(4, 0.1)) for v in bv.board_views(true, 6, rng, sigma_px=0.0)]
    found = measure_beacon(views, NOMINAL, CAMERA, MeasureConfig("board", FrameChoice("board")))
    # Where the adjustment stops: a thousandth of the deviation that 1e-3 px would give.
    np.testing.assert_allclose(found.beacon.positions_m, true.positions_m, atol=1e-7)


def test_a_wandering_emission_centre_is_reported(rng):
    views = []
    for i in range(40):
        pose = bv.tilted_pose(rng, 0.6, 50.0)
        view = bv.led_view(f"v{i}", NOMINAL, pose, rng, 0.02)
        look = pose.R.T @ pose.t_m
        cosine = look[2] / np.linalg.norm(look)
        shifted = NOMINAL.positions_m.copy()
        shifted[3, 2] -= 2e-3 * (1.0 - cosine)
        noise = rng.normal(0.0, 0.02, (4, 2))
        corners = bv.LENS.project(pose.apply(bv.board_points())) + rng.normal(0.0, 0.02, (30, 2))
        board = BoardView(view.name, corners, bv.board_points(), 1280, 960)
        views.append(replace(view, px=bv.LENS.project(pose.apply(shifted)) + noise, board=board))
    found = measure_beacon(views, NOMINAL, CAMERA, MeasureConfig("board"))
    wander = {row.name: row.shift_m / row.shift_sigma_m for row in found.leds}
    assert wander["led3"] > 8.0
    assert any("LED led3 seems to wander" in line for line in found.warnings)
