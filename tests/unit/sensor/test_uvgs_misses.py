"""Everything that can go wrong with one picture has its own stage and reason."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.errors import CalibrationError, ConfigError
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.sensor import Capture, Miss, PoseEstimate, Uvgs, UvgsConfig

FACING = Pose(so3_exp(np.array([0.1, -0.2, 0.3])), np.array([0.05, -0.02, 0.8]), "camera", "beacon")


def led_px(pose: Pose = FACING) -> np.ndarray:
    return np.array(spots.lens().project(pose.apply(spots.beacon().positions_m)))


def sensor(**changes) -> Uvgs:
    return Uvgs(spots.calibration(), spots.beacon(), UvgsConfig(**changes))


def look(centres: np.ndarray, uvgs: Uvgs | None = None) -> Miss | PoseEstimate:
    image = spots.draw(centres, np.random.default_rng(3))
    return (uvgs or sensor()).solve(Capture(image, 77, "x.png"))


def test_a_pose_carries_its_picture_and_its_doubt():
    got = look(led_px())
    assert isinstance(got, PoseEstimate)
    assert got.t_ns == 77
    assert got.beacon == "test"
    assert got.led_px.shape == (4, 2)
    assert got.margin > 6.0
    assert got.camera_from_beacon.is_close(FACING, 2e-3, 2e-3)
    assert (np.linalg.eigvalsh(got.covariance) > 0).all()
    # Depth is the weakest direction of one small beacon.
    assert got.position_sigma_m[2] > 3 * got.position_sigma_m[:2].max()


@pytest.mark.parametrize("hidden", range(4))
def test_a_hidden_led_is_too_few_blobs(hidden):
    got = look(np.delete(led_px(), hidden, axis=0))
    assert isinstance(got, Miss)
    assert (got.stage, got.reason) == ("selection", "too_few_blobs")
    assert got.blob_count == 3


@pytest.mark.parametrize("hidden", range(4))
def test_a_glint_in_place_of_a_led_is_no_pose(hidden):
    px = led_px()
    px[hidden] += [47.0, -31.0]
    got = look(px)
    assert isinstance(got, Miss)
    assert got.reason in ("no_labeling", "residual_too_large", "ambiguous", "chance_fit", "not_facing")


def test_a_glint_beside_four_leds_is_seen_through():
    for glint in ([500.0, 300.0], [700.0, 460.0], [660.0, 520.0]):
        got = look(np.vstack([led_px(), [glint]]))
        assert isinstance(got, PoseEstimate)
        assert got.camera_from_beacon.is_close(FACING, 2e-3, 2e-3)
        assert got.blob_count == 5


def test_a_dark_picture_and_a_crowd_of_lights():
    got = look(np.zeros((0, 2)))
    assert isinstance(got, Miss)
    assert (got.stage, got.reason) == ("preprocess", "no_contrast")
    crowd = np.stack(np.meshgrid(np.arange(100, 1200, 200.0), np.arange(100, 900, 150.0)), -1).reshape(-1, 2)
    got = look(crowd)
    assert isinstance(got, Miss)
    assert (got.stage, got.reason) == ("selection", "too_many_blobs")


def test_four_lights_that_are_no_beacon():
    got = look(np.array([[100.0, 100], [300, 110], [500, 120], [700, 131]]))
    assert isinstance(got, Miss)
    assert got.stage == "correspondence"


def test_a_beacon_out_of_range_is_not_believed():
    got = look(led_px(), sensor(max_range_m=0.5))
    assert isinstance(got, Miss)
    got = look(led_px(), sensor(min_range_m=1.2, max_range_m=3.0))
    assert isinstance(got, Miss)


def test_a_beacon_file_that_is_wrong_by_millimetres_is_refused():
    from dataclasses import replace

    beacon = spots.beacon()
    leds = list(beacon.leds)
    leds[3] = replace(leds[3], position_m=leds[3].position_m + np.array([0.012, -0.02, 0.0]))
    got = look(led_px(), Uvgs(spots.calibration(), replace(beacon, leds=tuple(leds))))
    assert isinstance(got, Miss)
    assert got.reason in ("residual_too_large", "no_labeling", "ambiguous", "chance_fit")


def test_another_picture_size_names_both():
    image = np.zeros((480, 640), dtype=np.uint8)
    with pytest.raises(CalibrationError, match=r"640x480.*1280x960"):
        sensor().solve(Capture(image, 0, "small.png"))


def test_an_unknown_solver_is_refused_when_built():
    with pytest.raises(ConfigError, match="unknown solver"):
        sensor(solver="magic")


@pytest.mark.opencv
def test_the_papers_pipeline_and_sort_find_the_same_pose():
    both = look(led_px(), sensor(detection="paper", correspondence="paper"))
    ours = look(led_px())
    assert isinstance(ours, PoseEstimate)
    if isinstance(both, Miss):  # the sort holds only while the longest projected edge is the longest edge
        assert both.stage == "correspondence"
    else:
        assert both.camera_from_beacon.is_close(ours.camera_from_beacon, 1e-3, 1e-3)
    head_on = Pose(np.eye(3), np.array([0.0, 0.0, 0.9]), "camera", "beacon")
    got = look(led_px(head_on), sensor(detection="paper", correspondence="paper"))
    assert isinstance(got, PoseEstimate)
    assert got.camera_from_beacon.is_close(head_on, 2e-3, 2e-3)


def test_the_papers_sort_refuses_more_than_four():
    got = look(np.vstack([led_px(), [[500.0, 300.0]]]), sensor(correspondence="paper"))
    assert isinstance(got, Miss)
    assert (got.stage, got.reason) == ("correspondence", "no_subset")


def test_stage_times_come_from_the_clock_handed_in():
    ticks = iter(range(100))
    uvgs = Uvgs(spots.calibration(), spots.beacon(), clock=lambda: float(next(ticks)))
    got = look(led_px(), uvgs)
    assert got.stage_s == dict.fromkeys(("blobs", "selection", "correspondence", "solve", "validate"), 1.0)


def test_warm_up_leaves_nothing_behind():
    uvgs = sensor()
    before = look(led_px(), uvgs)
    uvgs.warm_up()
    after = look(led_px(), uvgs)
    assert isinstance(before, PoseEstimate)
    assert isinstance(after, PoseEstimate)
    assert (before.camera_from_beacon.R == after.camera_from_beacon.R).all()
