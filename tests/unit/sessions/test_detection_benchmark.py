from __future__ import annotations

import json
from dataclasses import replace
from math import sqrt
from pathlib import Path

import numpy as np
import pytest
import typer

from uvgs_bench.devices.sim.bench import true_lens
from uvgs_bench.devices.sim.tag_views import WALL_SHARE, SideBySide, Tag
from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.sessions.detection_benchmark import (
    FAMILIES,
    TAG_NUMBER,
    as_tables,
    make_entrants,
    run_detection_benchmark,
    tag_side_m,
)
from uvgs_bench.sessions.detection_conditions import Condition, default_conditions, picture
from uvgs_bench.sessions.detection_methods import (
    APRILTAG_FAMILY,
    Attempt,
    apriltag_corners,
    aruco_corners,
    pose_of_square,
)
from uvgs_bench.sessions.detection_scores import UVGS, UVGS_ALONE, score
from uvgs_bench.store.beacons import read_beacon

pytestmark = pytest.mark.opencv

EASY = Condition("easy", "1 m", paper_dn=100.0)


@pytest.fixture(scope="module")
def beacon():
    return read_beacon(Path(__file__).parents[3] / "calib" / "beacons" / "tetra_small.toml")


def stage_for(condition, seed=1):
    truth = SimulatedTruth()
    camera = replace(truth.camera, psf_sigma_px=condition.psf_sigma_px, background_dn=WALL_SHARE * condition.paper_dn)
    return SideBySide(true_lens(truth), camera, condition.paper_dn, seed)


@pytest.fixture(scope="module")
def easy_stage():
    return stage_for(EASY)


@pytest.fixture(scope="module")
def small_result(beacon):
    return run_detection_benchmark(beacon, conditions=[EASY], capture_count=2, seed=5)


def corner_errors_px(stage, beacon, family, find, count=4):
    errors = []
    for index in range(count):
        tag = Tag(family, TAG_NUMBER, 0.11)
        image, (_, camera_from_tag) = picture(stage, beacon, tag, EASY, index)
        found_px = find(image)
        assert found_px is not None
        errors.append(found_px - stage.lens.project(camera_from_tag.apply(tag.corners_m())))
    return np.array(errors)


def test_apriltag_corners_lie_where_the_lens_puts_them(beacon, easy_stage):
    pytest.importorskip("pupil_apriltags", reason="pupil-apriltags is not installed")
    errors_px = corner_errors_px(easy_stage, beacon, APRILTAG_FAMILY, apriltag_corners(TAG_NUMBER, 1.0))
    # Its edge fits reach about 0.1 px here; a half pixel of convention or a corner out of order would be far outside.
    assert np.sqrt(np.mean(errors_px**2)) < 0.15
    # Common to all corners nothing may remain but what straight lines in a bent picture cost.
    assert np.abs(errors_px.mean(axis=(0, 1))).max() < 0.07


def test_refined_aruco_corners_lie_where_the_lens_puts_them(beacon, easy_stage):
    find = aruco_corners(APRILTAG_FAMILY, TAG_NUMBER, "APRILTAG")
    errors_px = corner_errors_px(easy_stage, beacon, APRILTAG_FAMILY, find)
    # As for the AprilTag library, whose quad finder OpenCV carries, half pixel included.
    assert np.sqrt(np.mean(errors_px**2)) < 0.2
    assert np.abs(errors_px.mean(axis=(0, 1))).max() < 0.1


@pytest.mark.parametrize("family", FAMILIES)
def test_aruco_corners_lie_where_the_lens_puts_them(beacon, easy_stage, family):
    errors_px = corner_errors_px(easy_stage, beacon, family, aruco_corners(family, TAG_NUMBER))
    # cornerSubPix on the blurred corner of a square is pulled by some 0.2 px along the diagonal, alike for all four.
    assert np.sqrt(np.mean(errors_px**2)) < 0.35
    assert np.abs(errors_px.mean(axis=(0, 1))).max() < 0.1


def test_pose_of_square_returns_the_pose_that_projected_it(beacon, easy_stage):
    _, (_, camera_from_tag) = picture(easy_stage, beacon, None, EASY, 3)
    tag = Tag(APRILTAG_FAMILY, TAG_NUMBER, 0.11)
    found = pose_of_square(easy_stage.lens, tag.side_m, easy_stage.lens.project(camera_from_tag.apply(tag.corners_m())))
    # Exact corners: only the rounding of IPPE and of the lens's inversion (1e-10 px) is left.
    assert found is not None
    assert found.is_close(camera_from_tag, rotation_rad=1e-6, translation_m=1e-6)


def test_true_poses_keep_range_and_view_angle(beacon, easy_stage):
    condition = replace(EASY, view_angle_rad=0.7, range_m=1.7)
    for index in range(4):
        _, poses = picture(easy_stage, beacon, None, condition, index)
        for pose in poses:
            assert np.linalg.norm(pose.t_m) == pytest.approx(1.7, abs=1e-9)
            cosine = pose.R[:, 2] @ pose.t_m / 1.7
            assert np.arccos(cosine) == pytest.approx(0.7, abs=1e-9)


def test_span_of_tag_is_the_longest_led_distance(beacon):
    leds_m = beacon.positions_m
    longest_m = max(np.linalg.norm(a - b) for a in leds_m for b in leds_m)
    assert tag_side_m(beacon, "side") == pytest.approx(longest_m, abs=1e-12)
    assert tag_side_m(beacon, "diagonal") == pytest.approx(longest_m / sqrt(2.0), abs=1e-12)


def test_every_method_recovers_the_planted_pose(small_result):
    rows = {row.method: row for row in small_result.conditions[0][1]}
    assert set(rows) >= {UVGS, UVGS_ALONE, "cv2.aruco 36h11", "cv2.aruco 4x4", "cv2.aruco 5x5"}
    assert len(rows) + len(small_result.not_installed) == 8
    for row in rows.values():
        assert (row.pose_count, row.false_count) == (row.capture_count, 0), row
        # A tag's 0.25 px at 110 px of side and 1 m are some 4 mm; the beacon has 0.02 px centroids.
        assert row.position_rms_m < (0.5e-3 if "uVGS" in row.method else 10e-3), row
        assert row.attitude_rms_rad < (2e-3 if "uVGS" in row.method else 50e-3), row
        assert row.time_s > 0.0
    assert rows[UVGS].capture_count == 3 * rows[UVGS_ALONE].capture_count == 6
    assert rows[UVGS].position_ratio == rows[UVGS].time_ratio == 1.0


def test_a_wrong_tag_size_shows_as_error(beacon, small_result):
    wrong = run_detection_benchmark(beacon, conditions=[EASY], capture_count=2, seed=5, told_side_factor=1.03)
    for right, row in zip(small_result.overall, wrong.overall, strict=True):
        if "uVGS" in row.method:
            assert row.position_rms_m == right.position_rms_m
        else:
            # 3 % of 1 m, less what the finder's own bias gives back.
            assert 0.022 < row.position_rms_m < 0.038, row
            assert row.false_count == 0


def test_a_size_beyond_the_sanity_limit_counts_as_false(beacon):
    wrong = run_detection_benchmark(beacon, conditions=[EASY], capture_count=1, seed=5, told_side_factor=1.2)
    for row in wrong.overall:
        assert row.false_count == (0 if "uVGS" in row.method else 1), row
        assert row.pose_count == (row.capture_count if "uVGS" in row.method else 0), row


def test_same_seed_same_errors_other_seed_other_errors(beacon, small_result):
    again = run_detection_benchmark(beacon, conditions=[EASY], capture_count=2, seed=5)
    other = run_detection_benchmark(beacon, conditions=[EASY], capture_count=2, seed=6)
    figures = [(row.method, row.position_rms_m, row.attitude_rms_rad) for row in small_result.overall]
    assert [(row.method, row.position_rms_m, row.attitude_rms_rad) for row in again.overall] == figures
    assert other.overall[0].position_rms_m != small_result.overall[0].position_rms_m


def test_motion_blurs_beacon_and_tag_about_their_true_place(beacon):
    still, moving = EASY, replace(EASY, motion_px=12.0)
    stage = stage_for(still)
    tag = Tag(APRILTAG_FAMILY, TAG_NUMBER, 0.11)
    sharp, _ = picture(stage, beacon, tag, still, 0)
    smeared, _ = picture(stage, beacon, tag, moving, 0)
    # The trail spreads an LED's light over some 12 px: its brightest pixel must fall, its light stays.
    assert smeared[:, :640].max() < 0.8 * sharp[:, :640].max()
    ground = float(np.median(sharp))
    light = [float((image[:, :640].astype(float) - ground).clip(20.0).sum()) for image in (sharp, smeared)]
    assert light[1] == pytest.approx(light[0], rel=0.1)
    rows, columns = np.nonzero(sharp[:, 640:] > ground + 30.0)
    rows_moved, columns_moved = np.nonzero(smeared[:, 640:] > ground + 30.0)
    # Mid-exposure stays mid-trail: the middle of the white paper moves by far less than the trail.
    assert abs(rows.mean() - rows_moved.mean()) < 1.0
    assert abs(columns.mean() - columns_moved.mean()) < 1.0


def test_score_tells_false_from_missing(beacon, easy_stage):
    _, (true, _) = picture(easy_stage, beacon, None, EASY, 0)
    missing = score(Attempt(None, "tag not found", 0.0, 0.0, {}), true, 1.0)
    assert (missing.is_sane, missing.is_false) == (False, False)
    turned = true.perturbed([0.0, 0.0, 0.3, 0.0, 0.0, 0.0])
    assert score(Attempt(turned, "", 0.0, 0.0, {}), true, 1.0).is_false
    assert score(Attempt(true, "", 0.0, 0.0, {}), true, 1.0).is_sane


def test_absent_library_is_said(monkeypatch, beacon):
    monkeypatch.setitem(__import__("sys").modules, "pupil_apriltags", None)
    entrants = make_entrants(true_lens(SimulatedTruth()), beacon, 0.11)
    assert [e.name for e in entrants if e.solve is None] == [
        "apriltag 36h11, decimate 1",
        "apriltag 36h11, decimate 2",
    ]


def test_tables_are_plain_and_say_their_units(small_result):
    tables = as_tables(small_result)
    assert {"protocol", "conditions", "overall", "not_installed"} == set(tables)
    first = tables["conditions"][0]["methods"][0]
    assert first["method"] == UVGS
    assert first["captures"] == 6
    assert any("155.7 mm" in line for line in tables["protocol"])


def test_quick_takes_one_condition_of_each_kind():
    every = {condition.group for condition in default_conditions()}
    quick = [condition.group for condition in default_conditions(quick=True)]
    assert set(quick) == every
    assert len(quick) == len(every)


def test_command_prints_whole_rows_and_strict_json(monkeypatch, capsys):
    import uvgs_bench.sessions.detection_conditions as conditions
    from uvgs_bench.cli.benchmark_detection import detection

    monkeypatch.setattr(conditions, "default_conditions", lambda *, quick: (EASY,))
    outputs = []
    for as_json in (False, True):
        with pytest.raises(typer.Exit) as ended:
            detection(captures=1, quick=True, as_json=as_json, quiet=True)
        assert ended.value.exit_code == 0
        outputs.append(capsys.readouterr().out)
    line = next(line for line in outputs[0].splitlines() if "refine APRILTAG" in line and "/1 " in line)
    # Whole also where there is no terminal: poses, false, two errors, time, three ratios.
    assert len(line.split()) == 4 + 8
    assert json.loads(outputs[1])["overall"][0]["captures"] == 3
