"""Names of LEDs against the truth: other lights, hidden LEDs, many LEDs, three LEDs and a prior, colours."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
import pytest
from scipy.stats import chi2

from tests.helpers import spots
from uvgs_bench.beacon import Beacon, Led
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import rotation_angle, se3_log, so3_exp
from uvgs_bench.sensor import Capture, Miss, PoseEstimate, Uvgs, UvgsConfig
from uvgs_bench.sensor.correspondence import LedMatch, LedTable, NoMatch, match_leds
from uvgs_bench.sensor.evidence_kernels import is_lit
from uvgs_bench.sensor.labelings import STEP_SHIFT, STEP_TURN_RAD
from uvgs_bench.sensor.solution import Solution
from uvgs_bench.sensor.solvers.lambda_twist import solve_p3p
from uvgs_bench.sensor.solvers.uvgs_lm import solve
from uvgs_bench.sensor.stray_kernels import stray_odds
from uvgs_bench.sensor.three_leds import fuse, match_three
from uvgs_bench.sessions.label_study import LabelConditions, View, is_wrong, study_labels
from uvgs_bench.store.beacons import read_beacon


@pytest.fixture(scope="module")
def beacon(pytestconfig: pytest.Config) -> Beacon:
    return read_beacon(pytestconfig.rootpath / "calib/beacons/tetra_small.toml")


def test_clean_views_are_named_rightly(beacon):
    figures = study_labels(beacon, LabelConditions(), count=1000, seed=21)
    assert figures.wrong == 0
    # 0.5 % expected; 1.2 % is three standard deviations above it, and the promise is 1 % of many views.
    assert figures.refused_share < 0.012


def test_views_beyond_the_usual_cone_are_not_named_wrongly(beacon):
    assert study_labels(beacon, LabelConditions(cone_deg=85.0), count=300, seed=22).wrong == 0


def test_three_other_lights_do_not_mislead(beacon):
    figures = study_labels(beacon, LabelConditions(lights=3), count=300, seed=23)
    assert figures.wrong == 0
    assert figures.refused_share < 0.03


def test_a_glint_for_a_hidden_led_is_mostly_refused_and_else_mostly_flagged(beacon):
    figures = study_labels(beacon, LabelConditions(hidden=1, glints=1), count=1000, seed=24)
    # Four lights leave two redundant numbers: 0.7 % fit by chance beyond what any test of one picture can see.
    assert figures.wrong_share < 0.016
    # 0.09 % expected: one in a thousand views is promised over many, five in a thousand is five deviations.
    assert figures.wrong_unflagged <= 5
    assert figures.wrong > figures.wrong_unflagged


def test_the_warning_is_given_to_few_clean_views_and_most_wrong_ones(beacon):
    clean = study_labels(beacon, LabelConditions(), count=600, seed=27)
    # 14 % expected; 19 % is three and a half deviations above it.
    assert clean.flagged < 0.19 * clean.published
    alike = study_labels(beacon, LabelConditions(hidden=1, glints=1, is_alike=True), count=1500, seed=28)
    # 17 wrong are expected, a quarter of them without a warning: no test of one picture does better.
    assert alike.wrong_unflagged <= 12
    assert alike.wrong > alike.wrong_unflagged


def test_more_glints_give_more_fours_to_choose_from_and_the_warning_knows(beacon):
    figures = study_labels(beacon, LabelConditions(hidden=1, glints=3), count=600, seed=29)
    # 17 wrong are expected, 0.2 of them without a warning; 6 when the choice among 15 fours is not counted.
    assert figures.wrong > 5
    assert figures.wrong_unflagged <= 2


def test_the_odds_of_a_stray_are_those_of_drawn_poses(beacon):
    """The closed form against sums of determinants from the normal equations, pose by pose."""
    rng = np.random.default_rng(61)
    lens, config = spots.lens(), UvgsConfig()
    table = LedTable.of(beacon, config)
    sigma, unknown = np.full(4, 0.2), np.full((4, 2), np.nan)
    compared = 0
    for _ in range(6):
        pose = spots.random_pose(rng)
        px = lens.project(pose.apply(beacon.positions_m)) + rng.normal(size=(4, 2)) * 0.2
        named = solve(lens, beacon.positions_m, px, sigma, pose, 50)
        at = named.camera_from_beacon
        four = np.exp(-0.5 * named.chi2) / np.sqrt(np.linalg.det(named.information)) / float(at.t_m @ at.t_m)
        rays = np.ascontiguousarray(lens.unproject(px))
        total = 0.0
        for lights in combinations(range(4), 3):
            for leds in permutations(range(4), 3):
                Rs, ts = np.empty((4, 3, 3)), np.empty((4, 3))
                points = np.ascontiguousarray(beacon.positions_m[list(leds)])
                for i in range(solve_p3p(np.ascontiguousarray(rays[list(lights)]), points, Rs, ts)):
                    other = Pose(Rs[i], ts[i], "camera", "beacon")
                    corners = other.apply(points)
                    square = float((corners**2).sum() / 3.0)
                    if not config.min_range_m**2 < square < config.max_range_m**2:
                        continue
                    if not all(
                        is_lit(Rs[i], ts[i], beacon.positions_m[k], table.axes[k], table.cos_loose[k]) for k in leds
                    ):
                        continue
                    if leds == lights and rotation_angle(Rs[i].T @ at.R) < 0.1:
                        continue
                    H = Solution.at(lens, points, px[list(lights)], sigma[:3], other, 0, True).information
                    total += 1.0 / np.sqrt(np.linalg.det(H)) / square
        got = stray_odds(
            lens.model_id, lens.kernel_parameters, rays, px, sigma, unknown, table.look_sigma, 1.0, table.positions_m,
            table.axes, table.cos_loose, np.array(list(permutations(range(4), 3)), dtype=np.int64), at.R.copy(),
            at.t_m.copy(), named.chi2, config.min_range_m, config.max_range_m, 1e4,
        )  # fmt: skip
        # Turns are told by edges there and by angle here, so a pose at the limit may count in one sum only.
        compared += got == pytest.approx(total / four * 2.0 * np.pi * 0.2**2 / 1e4, rel=0.02)
    assert compared >= 5


@pytest.mark.slow
def test_promised_shares_over_many_views(beacon):
    clean = study_labels(beacon, LabelConditions(), count=100_000, seed=25)
    assert clean.wrong_share <= 1e-4
    assert clean.refused_share <= 0.01
    lights = study_labels(beacon, LabelConditions(lights=3), count=20_000, seed=26)
    assert lights.wrong_share <= 5e-4


def test_brightness_in_another_unit_changes_nothing(beacon):
    rng = np.random.default_rng(5)
    lens, config = spots.lens(), UvgsConfig()
    table = LedTable.of(beacon, config)
    px = lens.project(spots.random_pose(rng).apply(beacon.positions_m))
    px = np.vstack([px, px.mean(axis=0) + rng.uniform(-40.0, 40.0, (2, 2))])
    looks = rng.normal(size=(6, 2)) * 0.3
    answers = [match_leds(px, np.full(6, 0.15), lens, table, config, None, looks + shift) for shift in (0.0, 5.0)]
    assert type(answers[0]) is type(answers[1])
    if isinstance(answers[0], LedMatch) and isinstance(answers[1], LedMatch):
        # The same sums in another order of rounding.
        assert answers[1].margin == pytest.approx(answers[0].margin, rel=1e-9)
        assert answers[1].chance_fits == pytest.approx(answers[0].chance_fits, rel=1e-6)
        assert answers[1].stray_odds == pytest.approx(answers[0].stray_odds, rel=1e-6)


def test_a_nearly_symmetric_beacon_is_refused_not_guessed():
    rng = np.random.default_rng(6)
    corners = 0.06 * np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
    # A regular tetrahedron but for 0.3 mm: from a metre that is a third of a pixel, two deviations.
    corners[0, 0] += 3e-4
    twins = Beacon("regular", tuple(Led(f"l{i}", p) for i, p in enumerate(corners)))
    lens, config = spots.lens(), UvgsConfig()
    table = LedTable.of(twins, config)
    refused = 0
    for _ in range(40):
        pose = spots.random_pose(rng, 179.0, 0.8, 1.5)
        px = lens.project(pose.apply(corners)) + rng.normal(size=(4, 2)) * 0.1
        got = match_leds(px, np.full(4, 0.18), lens, table, config)
        if isinstance(got, LedMatch):
            assert got.blob_of_led.tolist() == [0, 1, 2, 3]
        else:
            refused += 1
    assert refused > 30


@pytest.mark.parametrize("count", [6, 8])
def test_beacons_of_more_leds_work_with_those_seen(count):
    rng = np.random.default_rng(count)
    positions = rng.uniform(-0.08, 0.08, (count, 3)) * [1.0, 1.0, 0.6]
    leds = tuple(Led(f"l{i}", p, np.array([0.0, 0.0, -1.0]), np.radians(70.0)) for i, p in enumerate(positions))
    many = Beacon("many", leds)
    lens, config = spots.lens(), UvgsConfig()
    table = LedTable.of(many, config)
    solved = {True: 0, False: 0}
    for k in range(16):
        pose = spots.random_pose(rng)
        # Half the views keep two LEDs more than needed, the others hide all but four; up to three glints.
        is_rich = k % 2 == 0
        shown = rng.permutation(count)[: max(6, count - 2) if is_rich else 4]
        px = lens.project(pose.apply(positions)) + rng.normal(size=(count, 2)) * 0.1
        glints = px.mean(axis=0) + rng.uniform(-1.0, 1.0, (k % 4, 2)) * np.abs(px - px.mean(axis=0)).max()
        order = rng.permutation(len(shown) + len(glints))
        named = np.concatenate([shown, np.full(len(glints), -1)])[order]
        lights = np.ascontiguousarray(np.vstack([px[shown], glints])[order])
        got = match_leds(lights, np.full(len(lights), 0.18), lens, table, config)
        if isinstance(got, LedMatch):
            solved[is_rich] += 1
            assert not is_wrong(got, View(pose, lights, lights, named))
        else:
            assert got.reason in ("ambiguous", "chance_fit", "no_labeling")
    assert solved[True] == 8
    # Four of eight can be had in so many ways that chance explains most of them unless they are seen large.
    assert solved[False] >= 1


def moved(pose: Pose, rng: np.random.Generator) -> Pose:
    turn, shift = rng.normal(size=3) * 0.05, rng.normal(size=3) * 0.03 * float(np.linalg.norm(pose.t_m))
    return Pose(so3_exp(turn) @ pose.R, pose.t_m + shift, "camera", "beacon")


def test_three_leds_and_a_prior_give_a_flagged_pose_that_knows_its_doubt(beacon):
    rng = np.random.default_rng(31)
    lens = spots.lens()
    uvgs = Uvgs(spots.calibration(), beacon)
    squares = []
    for _ in range(36):
        pose = spots.random_pose(rng)
        prior = uvgs.solve(Capture(spots.draw(lens.project(pose.apply(beacon.positions_m)), rng), 0))
        if isinstance(prior, Miss):
            continue
        now = moved(pose, rng)
        px = np.delete(lens.project(now.apply(beacon.positions_m)), rng.integers(4), axis=0)
        capture = Capture(spots.draw(px, rng), 1)
        alone = uvgs.solve(capture)
        assert isinstance(alone, Miss)
        got = uvgs.solve(capture, prior)
        if isinstance(got, Miss):
            continue
        assert got.flags == ("three_leds_with_prior",)
        assert np.isnan(got.led_px[:, 0]).sum() == 1
        assert got.position_sigma_m[2] > 0.5 * prior.position_sigma_m[2]
        R = np.ascontiguousarray(got.camera_from_beacon.R @ now.R.T)
        xi = se3_log(R, got.camera_from_beacon.t_m - R @ now.t_m)
        squares.append(float(xi @ np.linalg.solve(got.covariance, xi)))
    assert len(squares) > 26
    # The prior's part is wider than what was planted, so the mean may be small; a median resists one wrong root.
    assert chi2.ppf(0.2, 6) < np.median(squares) < chi2.ppf(0.8, 6)
    assert np.mean(np.array(squares) < chi2.ppf(0.9999, 6)) > 0.95


def test_with_a_prior_a_glint_for_a_hidden_led_is_seen_through(beacon):
    rng = np.random.default_rng(32)
    lens = spots.lens()
    uvgs = Uvgs(spots.calibration(), beacon)
    solved = 0
    for _ in range(40):
        pose = spots.random_pose(rng)
        prior = uvgs.solve(Capture(spots.draw(lens.project(pose.apply(beacon.positions_m)), rng), 0))
        if isinstance(prior, Miss):
            continue
        now = moved(pose, rng)
        px = lens.project(now.apply(beacon.positions_m))
        glint = px.mean(axis=0) + rng.uniform(-0.8, 0.8, 2) * np.abs(px - px.mean(axis=0)).max()
        px = np.vstack([np.delete(px, rng.integers(4), axis=0), glint])
        got = uvgs.solve(Capture(spots.draw(px, rng), 1), prior)
        if isinstance(got, PoseEstimate):
            solved += 1
            assert rotation_angle(np.ascontiguousarray(got.camera_from_beacon.R.T @ now.R)) < 0.1
    assert solved > 25


@pytest.mark.parametrize(
    ("cone_deg", "peak_dn", "hidden", "glints", "least"),
    [
        (40.0, 170.0, 1, 0, 0),
        (40.0, 170.0, 1, 1, 0),
        (40.0, 170.0, 0, 2, 7),
        (40.0, 600.0, 0, 0, 10),
        (69.0, 170.0, 0, 0, 7),
    ],
    ids=["occluded", "occluded with glint", "glints", "saturated", "grazing"],
)
def test_drawn_pictures_give_the_right_pose_or_a_reason(beacon, cone_deg, peak_dn, hidden, glints, least):
    rng = np.random.default_rng(51)
    lens = spots.lens()
    uvgs = Uvgs(spots.calibration(), beacon)
    solved = 0
    for _ in range(12):
        while True:
            pose = spots.random_pose(rng, cone_deg)
            facing = float(-(pose.R @ [0.0, 0.0, -1.0]) @ pose.t_m / np.linalg.norm(pose.t_m))
            # Grazing: the last ten degrees before the LEDs cannot be seen any more.
            if cone_deg < 60.0 or facing < np.cos(np.radians(59.0)):
                break
        px = lens.project(pose.apply(beacon.positions_m))
        reach = np.abs(px - px.mean(axis=0)).max()
        strays = px.mean(axis=0) + rng.uniform(-1.5, 1.5, (glints, 2)) * reach
        lights = np.vstack([rng.permutation(px)[hidden:], strays])
        got = uvgs.solve(Capture(spots.draw(lights, rng, peak_dn=peak_dn), 0))
        if isinstance(got, Miss):
            assert got.reason
            continue
        if "weak_evidence" in got.flags:
            continue
        solved += 1
        # Far beyond any deviation of a rightly named pose here; a truly different pose is farther off.
        assert got.camera_from_beacon.is_close(pose, 0.1, 0.02 * float(np.linalg.norm(pose.t_m)))
    assert solved >= least


def in_colour(centres_px: np.ndarray, bgr: np.ndarray, peak_dn: float, rng: np.random.Generator) -> np.ndarray:
    """A colour picture: each channel sees each spot by its share; more than 255 clips."""
    channels = [spots.draw(centres_px, rng, peak_dn=np.maximum(peak_dn * bgr[:, c], 1e-3)) for c in range(3)]
    return np.ascontiguousarray(np.stack(channels, axis=2))


@pytest.mark.opencv
@pytest.mark.parametrize("peak_dn", [170.0, 500.0])
def test_beacons_of_other_colours_are_told_apart_even_with_clipped_cores(beacon, peak_dn):
    rng = np.random.default_rng(41)
    lens = spots.lens()
    red_pose = Pose(so3_exp(np.array([0.2, 0.1, 0.3])), np.array([-0.15, 0.0, 0.9]), "camera", "beacon")
    blue_pose = Pose(so3_exp(np.array([-0.2, 0.3, -0.9])), np.array([0.16, 0.05, 1.0]), "camera", "beacon")
    px = np.vstack([lens.project(pose.apply(beacon.positions_m)) for pose in (red_pose, blue_pose)])
    # Reds on both sides of hue 0, under a white balance that lifts the other channels.
    bgr = np.array([[0.10, 0.2, 1.0], [0.25, 0.1, 1.0], [0.15, 0.15, 1.0], [0.1, 0.2, 1.0]] + [[1.0, 0.25, 0.1]] * 4)
    capture = Capture(in_colour(px, bgr, peak_dn, rng), 0)
    for hue, pose in (("red", red_pose), ("blue", blue_pose), ((345.0, 20.0), red_pose)):
        got = Uvgs(spots.calibration(), replace(beacon, hue=hue)).solve(capture)
        assert isinstance(got, PoseEstimate), hue
        # A clipped core moves a centroid by up to 0.06 px.
        assert got.camera_from_beacon.is_close(pose, 0.01, 0.02)
        assert got.blob_count == 4
    green = Uvgs(spots.calibration(), replace(beacon, hue="green")).solve(capture)
    assert isinstance(green, Miss)
    assert green.reason == "too_few_blobs"


@pytest.mark.shared_data
@pytest.mark.opencv
def test_a_device_of_34_leds_is_found_where_it_was_rendered(pytestconfig):
    import csv

    from uvgs_bench.camera.calibration import Calibration
    from uvgs_bench.camera.lens import Lens
    from uvgs_bench.devices.cameras.images import read_image

    folder = pytestconfig.rootpath.parent / "shared/data/leds_hdk_rendered"
    if not folder.is_dir():
        pytest.skip("../shared/data/leds_hdk_rendered is not here")
    with (folder / "HDK_LED_locations_3rmt.csv").open() as file:
        rows = list(csv.reader(file))[1:]
    # Six LEDs are on the back.
    leds = tuple(Led(r[1], np.array([float(v) for v in r[2:5]]) / 1e3) for r in rows if float(r[4]) > 5.0)
    lens = Lens("plumb_bob", 640, 480, np.array([700.0, 700.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    config = UvgsConfig(max_blobs=48, min_separation_px=2.0, model_error_px=0.5, min_range_m=0.15, max_range_m=1.5)
    uvgs = Uvgs(Calibration(lens), Beacon("hdk", leds), config)
    for name in ("0001.tif", "0009.tif", "0025.tif", "0032.tif"):
        got = uvgs.solve(Capture(read_image(folder / name), 0))
        assert isinstance(got, PoseEstimate)
        # Rendered with X -0.035 to 0.115 m, Y 0.025 m, Z 0.30 m; the renderer's spots are coarse.
        assert -0.04 < got.camera_from_beacon.t_m[0] < 0.12
        assert got.camera_from_beacon.t_m[1:] == pytest.approx([0.025, 0.30], abs=0.02)
        assert np.isfinite(got.led_px[:, 0]).sum() > 20


def test_three_leds_and_a_prior_are_as_far_off_as_their_covariance_says(beacon):
    rng = np.random.default_rng(33)
    lens, config, sigma = spots.lens(), UvgsConfig(), np.full(4, 0.1)
    table, nothing = LedTable.of(beacon, config), np.zeros((4, 2))
    squares, refused = [], 0
    for _ in range(120):
        pose = spots.random_pose(rng)
        px = lens.project(pose.apply(beacon.positions_m)) + rng.normal(size=(4, 2)) * sigma[:, None]
        last = solve(lens, beacon.positions_m, px, sigma, pose, 30)
        covariance = np.linalg.inv(last.information)
        prior = PoseEstimate(last.camera_from_beacon, covariance, 0, "b", nothing, nothing, 0.1, 9.0, 4)
        # As far as a step is expected to be.
        turn, shift = rng.normal(size=3) * STEP_TURN_RAD, rng.normal(size=3) * STEP_SHIFT * np.linalg.norm(pose.t_m)
        now = Pose(so3_exp(turn) @ pose.R, pose.t_m + shift, "camera", "beacon")
        seen = np.delete(np.arange(4), rng.integers(4))
        px = lens.project(now.apply(beacon.positions_m))[seen] + rng.normal(size=(3, 2)) * 0.1
        match = match_three(px, sigma[:3], lens, table, config, prior)
        if isinstance(match, NoMatch):
            refused += 1
            continue
        named = np.flatnonzero(match.blob_of_led >= 0)
        assert named.tolist() == seen.tolist()
        got = fuse(lens, beacon.positions_m[named], px[match.blob_of_led[named]], sigma[:3], match.start, prior)
        R = np.ascontiguousarray(got.camera_from_beacon.R @ now.R.T)
        xi = se3_log(R, got.camera_from_beacon.t_m - R @ now.t_m)
        squares.append(float(xi @ got.information @ xi))
    # A quarter is refused: two roots within reach of so wide a step.
    assert refused < 50
    low, high = chi2.ppf([0.005, 0.995], 6 * len(squares)) / len(squares)
    assert low < np.mean(squares) < high
    # Among 120 values of six degrees of freedom one beyond this has a chance of 1e-6.
    assert max(squares) < chi2.ppf(1.0 - 1e-8, 6)


def test_many_leds_without_a_fit_say_so():
    lens, config = spots.lens(), UvgsConfig()
    leds = tuple(Led(f"l{i}", p) for i, p in enumerate(np.random.default_rng(1).uniform(-0.05, 0.05, (6, 3))))
    px = np.array([[100.0, 100.0], [1100.0, 120.0], [600.0, 800.0], [640.0, 20.0]])
    got = match_leds(px, np.full(4, 0.15), lens, LedTable.of(Beacon("b", leds), config), config)
    assert isinstance(got, NoMatch)
