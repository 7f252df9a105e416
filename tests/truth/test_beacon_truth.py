"""Beacons measured from simulated centroids: the LEDs come back, and the stated doubt is the true one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from tests.helpers import beacon_views as bv
from tests.helpers import spots
from uvgs_bench.beacon import Beacon
from uvgs_bench.beacon.frames import FrameChoice, fit_rigid
from uvgs_bench.beacon.measure import BeaconMeasurement, Caliper, LedView, MeasureConfig, measure_beacon
from uvgs_bench.camera.boards import BoardView
from uvgs_bench.camera.calibration import Calibration

NOMINAL = spots.beacon()
CAMERA = Calibration(bv.LENS, "simulated")
LENS_SIGMA = np.array([0.5, 0.5, 0.4, 0.4, 1e-3, 3e-3, 1e-4, 1e-4, 2e-3])


def true_length(true: Beacon, first: str, second: str) -> float:
    names = true.led_names
    return float(np.linalg.norm(true.positions_m[names.index(first)] - true.positions_m[names.index(second)]))


def normalised(found: BeaconMeasurement, true: Beacon) -> np.ndarray:
    return np.array([(d.distance_m - true_length(true, d.first, d.second)) / d.sigma_m for d in found.distances])


def calipers(true: Beacon, rng: np.random.Generator, sigma_m: float = 5e-5) -> tuple[Caliper, ...]:
    names = true.led_names
    return tuple(
        Caliper(a, b, true_length(true, a, b) + rng.normal(0.0, sigma_m), sigma_m)
        for i, a in enumerate(names)
        for b in names[i + 1 :]
    )


def with_print_scale(views: list[LedView], factor: float) -> list[LedView]:
    """The board is declared ``factor`` times as large as it is."""
    return [
        replace(v, board=BoardView(v.name, v.board.px, v.board.board_m * factor, v.board.width_px, v.board.height_px))
        for v in views
        if v.board is not None
    ]


def simulate(by: str, seed: int) -> tuple[BeaconMeasurement, Beacon]:
    """One measurement with everything drawn from its declared deviation."""
    rng = np.random.default_rng(seed)
    true = bv.displaced(NOMINAL, rng)
    if by == "board":
        views = with_print_scale(bv.board_views(true, 20, rng), 1.0 + rng.normal(0.0, 2e-4))
        return measure_beacon(views, NOMINAL, CAMERA, MeasureConfig("board", FrameChoice("board"))), true
    if by == "gantry":
        return measure_beacon(bv.gantry_views(true, rng), NOMINAL, CAMERA, MeasureConfig("gantry")), true
    config = MeasureConfig("free", calipers=calipers(true, rng))
    return measure_beacon(bv.free_views(true, 20, rng), NOMINAL, CAMERA, config), true


def check_coverage(by: str, count: int, worst_mm: float, tolerance: float) -> None:
    z, worst = [], []
    for seed in range(count):
        found, true = simulate(by, 500 + seed)
        z.append(normalised(found, true))
        worst.append(found.worst_sigma_m)
    assert np.median(worst) * 1e3 <= worst_mm
    share = float(np.mean(np.abs(np.array(z)) < 1.96))
    print(f"{by}: worst distance {np.median(worst) * 1e3:.4f} mm, 95 % intervals cover {share:.4f} of {6 * count}")
    assert abs(share - 0.95) < tolerance


@pytest.mark.parametrize(("by", "worst_mm"), [("board", 0.05), ("gantry", 0.07), ("free", 0.05)])
def test_distances_are_as_good_as_they_say(by, worst_mm):
    # 12 draws of some 5 independent distances each: three and a half deviations of a share of 0.95 are 0.1.
    check_coverage(by, 12, worst_mm, 0.1)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("by", "worst_mm"), [("board", 0.05), ("gantry", 0.07), ("free", 0.05)])
def test_distances_are_as_good_as_they_say_in_long(by, worst_mm):
    check_coverage(by, 500, worst_mm, 0.015)


def test_positions_in_the_board_frame_are_as_good_as_they_say():
    total, count = 0.0, 12
    for seed in range(count):
        found, true = simulate("board", 900 + seed)
        off = (found.beacon.positions_m - true.positions_m).ravel()
        total += float(off @ np.linalg.solve(found.beacon.covariance_m2, off))
    # The sum of squared Mahalanobis distances of honest covariances is chi-square; 99.9 % of seeds lie between.
    low, high = chi2.ppf([0.0005, 0.9995], 12 * count)
    assert low < total < high


def test_a_doubtful_lens_is_adjusted_and_its_doubt_counted():
    rng = np.random.default_rng(3)
    z = []
    for _ in range(8):
        true = bv.displaced(NOMINAL, rng)
        views = bv.board_views(true, 20, rng)
        off = bv.LENS.with_parameters(bv.LENS.parameters + rng.normal(0.0, LENS_SIGMA))
        doubtful = Calibration(off, "off", np.diag(LENS_SIGMA**2))
        found = measure_beacon(views, NOMINAL, doubtful, MeasureConfig("board", board_scale_sigma=1e-6))
        z.append(normalised(found, true))
    # 48 values of which some 35 are independent: the mean square of honest ones lies within 1 +- 0.8.
    assert np.mean(np.square(z)) == pytest.approx(1.0, abs=0.8)


@pytest.mark.parametrize("with_calipers", [True, False])
def test_an_led_two_millimetres_off_is_found_to_a_tenth(with_calipers):
    rng = np.random.default_rng(5)
    off = np.zeros((4, 3))
    off[3] = np.array([1.2, -1.0, 1.25]) * 1e-3  # 2 mm
    true = bv.moved(NOMINAL, off)
    config = MeasureConfig("free", calipers=calipers(true, rng) if with_calipers else ())
    found = measure_beacon(bv.free_views(true, 20, rng), NOMINAL, CAMERA, config)
    R, t = fit_rigid(found.beacon.positions_m[:3], NOMINAL.positions_m[:3])
    place = R @ found.beacon.positions_m[3] + t
    assert np.linalg.norm(place - true.positions_m[3]) < 1e-4
    deviations = [row.deviation_m for row in found.leds]
    assert max(deviations[:3]) < 1e-4
    assert deviations[3] == pytest.approx(2e-3, abs=1e-4)
    assert any("led3" in line for line in found.warnings) is not with_calipers


@pytest.mark.parametrize("is_carried", [True, False])
def test_either_mount_measures_the_same_beacon(is_carried):
    rng = np.random.default_rng(8)
    true = bv.displaced(NOMINAL, rng)
    views = bv.gantry_views(true, rng, is_carried=is_carried)
    found = measure_beacon(views, NOMINAL, CAMERA, MeasureConfig("gantry", is_carried=is_carried))
    assert np.abs(normalised(found, true)).max() < 4.0


def test_the_lens_can_be_adjusted_with_a_gantry():
    rng = np.random.default_rng(9)
    true = bv.displaced(NOMINAL, rng)
    off = bv.LENS.with_parameters(bv.LENS.parameters + rng.normal(0.0, LENS_SIGMA))
    found = measure_beacon(
        bv.gantry_views(true, rng), NOMINAL, Calibration(off, "off", np.diag(LENS_SIGMA**2)), MeasureConfig("gantry")
    )
    assert np.abs(normalised(found, true)).max() < 4.0


def test_wrong_labels_are_set_aside_and_listed():
    rng = np.random.default_rng(11)
    true = bv.displaced(NOMINAL, rng)
    views = bv.board_views(true, 20, rng)
    px = views[7].px.copy()
    px[[1, 2]] = px[[2, 1]]
    views[7] = replace(views[7], px=px)
    found = measure_beacon(views, NOMINAL, CAMERA, MeasureConfig("board"))
    assert {(view, led) for view, led, _ in found.rejected} >= {("v7", "led1"), ("v7", "led2")}
    assert np.abs(normalised(found, true)).max() < 4.0


def wandering_views(true: Beacon, shifts_m: np.ndarray, rng: np.random.Generator, sigma_px: float) -> list[LedView]:
    """Views with a board, of LEDs whose emission centres travel along their axes as they are seen from the side."""
    out = []
    for i in range(20):
        pose = bv.tilted_pose(rng, 0.6, 50.0)
        view = bv.led_view(f"v{i}", true, pose, rng, sigma_px)
        look = true.positions_m - pose.inverse().t_m
        look /= np.linalg.norm(look, axis=1)[:, None]
        axes = np.array([led.axis for led in true.leds])
        travel = shifts_m * (1.0 + np.einsum("ni,ni->n", look, axes))
        seen = true.positions_m + axes * travel[:, None]
        px = bv.LENS.project(pose.apply(seen)) + rng.normal(0.0, sigma_px, (4, 2))
        corners = bv.LENS.project(pose.apply(bv.board_points())) + rng.normal(0.0, sigma_px, (30, 2))
        board = BoardView(view.name, corners, bv.board_points(), bv.LENS.width_px, bv.LENS.height_px)
        out.append(replace(view, px=px, board=board))
    return out


def test_travelling_emission_centres_bias_distances_unless_they_are_adjusted():
    rng = np.random.default_rng(21)
    z, stubborn, shifts = [], [], []
    for _ in range(4):
        true, planted = bv.displaced(NOMINAL, rng), np.array([0.0, 1e-3, 0.0, -1e-3])
        views = wandering_views(true, planted, rng, 0.05)
        config = MeasureConfig("board", FrameChoice("board"), board_scale_sigma=1e-6)
        stubborn.append(normalised(measure_beacon(views, NOMINAL, CAMERA, config), true))
        found = measure_beacon(views, NOMINAL, CAMERA, replace(config, is_shift_free=True))
        z.append(normalised(found, true))
        shifts.append(
            [(row.shift_m - shift) / row.shift_sigma_m for row, shift in zip(found.leds, planted, strict=True)]
        )
    # 24 distances and 16 shifts, correlated: mean squares of honest ones lie within 1 +- 0.9.
    assert np.mean(np.square(z)) == pytest.approx(1.0, abs=0.9)
    assert np.mean(np.square(shifts)) == pytest.approx(1.0, abs=0.9)
    # A millimetre of travel seen at up to 50 deg is a tenth of a millimetre and more, many deviations.
    assert np.mean(np.square(stubborn)) > 4.0
