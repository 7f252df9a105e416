"""Retroreflective targets among strong steady lights: poses from light on minus light off, with honest doubt."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from tests.helpers import spots
from uvgs_bench.errors import CaptureError
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import se3_log
from uvgs_bench.sensor import Capture, Miss, PoseEstimate, Uvgs
from uvgs_bench.sensor.difference import DifferenceConfig, difference, difference_pairs

pytestmark = pytest.mark.opencv


def steady_lights(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Many lights, some as bright as they get, far from the picture's middle where the target is."""
    px = np.column_stack([rng.uniform(40, 1240, 90), rng.uniform(40, 920, 90)])
    far = np.abs(px - [640, 480]).max(axis=1) > 330
    px = px[far][:30]
    return px, rng.uniform(120, 400, len(px)), rng.uniform(1.2, 6.0, len(px))


def pair(rng: np.random.Generator, motion_px: tuple[float, float]) -> tuple[Capture, Capture, Pose]:
    while True:
        pose = spots.random_pose(rng, near_m=0.7, far_m=1.1)
        target = spots.lens().project(pose.apply(spots.beacon().positions_m))
        apart = np.linalg.norm(target[:, None] - target[None], axis=2)[np.triu_indices(4, 1)]
        if np.abs(target - [640, 480]).max() < 300 and apart.min() > 12.0:
            break
    lights, peaks, sigmas = steady_lights(rng)
    on = spots.draw(
        np.vstack([target, lights]), rng, np.concatenate([np.full(4, 150.0), peaks]),
        np.concatenate([np.full(4, 1.3), sigmas]),
    )  # fmt: skip
    off = spots.draw(lights - np.array(motion_px), rng, peaks, sigmas)
    return Capture(on, 1000, "on", 0, 0.004), Capture(off, 2000, "off", 1, 0.004), pose


@pytest.mark.parametrize("motion_px", [(0.0, 0.0), (2.0, 0.0), (-1.4, 1.4), (0.5, -2.0)])
def test_targets_are_solved_among_steady_lights(motion_px):
    rng = np.random.default_rng(11)
    uvgs = Uvgs(spots.calibration(), spots.beacon())
    solved = plain = 0
    for _ in range(10):
        on, off, pose = pair(rng, motion_px)
        got = uvgs.solve(difference(on, off).capture)
        plain += isinstance(uvgs.solve(on), PoseEstimate)
        if isinstance(got, PoseEstimate):
            solved += 1
            assert got.camera_from_beacon.is_close(pose, 5e-3, 4e-3)
            assert got.t_ns == on.t_ns
            assert got.blob_count == 4
    assert solved == 10
    assert plain < 10


def test_poses_of_differences_are_as_uncertain_as_they_say():
    rng = np.random.default_rng(12)
    uvgs = Uvgs(spots.calibration(), spots.beacon())
    squares = []
    for _ in range(90):
        on, off, pose = pair(rng, (1.0, -2.0))
        got = uvgs.solve(difference(on, off).capture)
        if isinstance(got, PoseEstimate):
            Rd = np.ascontiguousarray(got.camera_from_beacon.R @ pose.R.T)
            xi = se3_log(Rd, got.camera_from_beacon.t_m - Rd @ pose.t_m)
            squares.append(float(xi @ np.linalg.solve(got.covariance, xi)))
    assert len(squares) >= 57
    low, high = chi2.ppf([0.005, 0.995], 6 * len(squares)) / (6 * len(squares))
    assert low < np.mean(squares) / 6.0 < high


def test_the_noise_handed_on_is_the_noise_there_is():
    rng = np.random.default_rng(13)
    lights = np.array([[300.0, 300.0]])
    results = []
    for _ in range(24):
        on, off = (spots.draw(lights, rng, 180.0, 40.0, size=(600, 600)) for _ in range(2))
        results.append(difference(Capture(on, 0), Capture(off, 1), DifferenceConfig(pedestal_dn=12)))
    values = np.array([r.capture.image for r in results]).astype(np.float64)
    stated = np.mean([r.variance_dn2() for r in results], axis=0)
    flat = np.s_[:, 500:580, 20:580]
    # 24 pictures and thousands of pixels: the sample deviation is right to a per cent; quantisation adds its twelfth.
    assert values[flat].var(axis=0, ddof=1).mean() == pytest.approx(stated[flat[1:]].mean(), rel=0.1)
    lit = np.s_[:, 285:315, 285:315]
    assert values[lit].var(axis=0, ddof=1).mean() == pytest.approx(stated[lit[1:]].mean(), rel=0.25)
    assert stated[lit[1:]].mean() > 3.0 * stated[flat[1:]].mean()


def test_nothing_is_left_of_a_scene_without_targets():
    rng = np.random.default_rng(14)
    lights, peaks, sigmas = steady_lights(rng)
    uvgs = Uvgs(spots.calibration(), spots.beacon())
    for motion in ((0.0, 0.0), (2.0, 1.0), (1.5, -0.5)):
        on = Capture(spots.draw(lights, rng, peaks, sigmas), 0)
        off = Capture(spots.draw(lights - np.array(motion), rng, peaks, sigmas), 1)
        got = uvgs.solve(difference(on, off).capture)
        assert isinstance(got, Miss)


def test_clipped_targets_stay_clipped():
    rng = np.random.default_rng(15)
    px = np.array([[100.3, 80.2]])
    on = spots.draw(px, rng, 900.0, 2.0, size=(200, 190))
    off = spots.draw(np.empty((0, 2)), rng, size=(200, 190))
    image = difference(Capture(on, 0), Capture(off, 1)).capture.image
    assert ((image == 255) == (on == 255)).all()
    # A steady light that clips in both is gone.
    both = difference(Capture(on, 0), Capture(spots.draw(px, rng, 900.0, 2.0, size=(200, 190)), 1)).capture.image
    assert both.max() < 60


def test_pairs_find_out_themselves_which_one_is_lit():
    rng = np.random.default_rng(16)
    captures = []
    for _ in range(3):
        on, off, _ = pair(rng, (1.0, 0.0))
        captures += [off, on]
    uvgs = Uvgs(spots.calibration(), spots.beacon())
    differences = list(difference_pairs(captures[:5]))
    assert len(differences) == 2
    assert all(isinstance(uvgs.solve(d.capture), PoseEstimate) for d in differences)
    assert all(d.capture.source == "on - off" for d in differences)


def test_a_lost_capture_turns_the_pairs_round_and_is_noticed():
    on, off, _ = pair(np.random.default_rng(17), (0.0, 0.0))
    uvgs = Uvgs(spots.calibration(), spots.beacon())
    captures = [on, off] * 4
    del captures[3]
    # on off | on ON | off on | off: from the third pair on the dark capture comes first.
    solved = [isinstance(uvgs.solve(d.capture), PoseEstimate) for d in difference_pairs(captures)]
    assert solved == [True, False, True]
    told = [isinstance(uvgs.solve(d.capture), PoseEstimate) for d in difference_pairs(captures, is_first_on=True)]
    assert told == [True, False, False]


def test_a_moved_target_lit_in_both_captures_is_told_from_a_switched_one():
    rng = np.random.default_rng(18)
    uvgs = Uvgs(spots.calibration(), spots.beacon())
    wrong = 0
    # Small spots, and spots so large that they still overlap when they moved far.
    for sigma_px, steps_px in ((2.2, (1.5, 3.0, 6.0)), (2.2, (1.5, 3.0, 6.0)), (9.0, (6.0, 14.0, 24.0, 30.0))):
        pose = spots.random_pose(rng, near_m=0.5, far_m=0.6)
        target = spots.lens().project(pose.apply(spots.beacon().positions_m))
        on = Capture(spots.draw(target, rng, 150.0, sigma_px), 0)
        assert difference(on, Capture(spots.draw(target[:0], rng), 1)).is_switched_at(target)
        for moved_px in steps_px:
            moved = target + np.array([moved_px, 0.0])
            again = Capture(spots.draw(moved, rng, 150.0, sigma_px), 1)
            got = difference(on, again, DifferenceConfig(motion_px=0))
            outcome = uvgs.solve(got.capture)
            if isinstance(outcome, PoseEstimate):
                off_m = np.abs(outcome.camera_from_beacon.t_m - pose.t_m)
                wrong += bool((off_m > 10.0 * outcome.position_sigma_m).any())
                assert not got.is_switched_at(outcome.led_px)
    # Crescents fit as well as LEDs and are off by tens of deviations: without the check these would be believed.
    assert wrong >= 6


@pytest.mark.parametrize("change", ["size", "type", "exposure"])
def test_pairs_that_do_not_fit_are_refused(change):
    dark = np.zeros((100, 120), dtype=np.uint8)
    off = {
        "size": Capture(dark[:90], 0, "off", 0, 0.004),
        "type": Capture(dark.astype(np.uint16), 0, "off", 0, 0.004),
        "exposure": Capture(dark, 0, "off", 0, 0.002),
    }[change]
    with pytest.raises(CaptureError, match="on"):
        difference(Capture(dark, 0, "on", 0, 0.004), off)
