"""The page of a calibration: the same figures three times, the rules it was judged by, and honest gaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers.rendered import check_three_agree
from tests.helpers.synthetic_run import HOSTILE, beacon
from uvgs_bench.camera import Calibration
from uvgs_bench.camera.angular_scale import angle_per_pixel
from uvgs_bench.camera.boards import BoardMiss, BoardView
from uvgs_bench.camera.calibration import Verdict
from uvgs_bench.camera.fitting import CalibrationResult, calibrate
from uvgs_bench.camera.lens import Lens
from uvgs_bench.camera.lens_choice import LensTrial
from uvgs_bench.camera.pose_doubt import doubt_ahead
from uvgs_bench.camera.view_trends import Streak, ViewTrends
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.report import build_calibration_document, calibration_page
from uvgs_bench.report.calibration_evidence import CalibrationEvidence, kept_masks, worst_views
from uvgs_bench.report.cells import Mark
from uvgs_bench.report.document import Document, Table
from uvgs_bench.report.html import render_html
from uvgs_bench.report.json_export import render_json
from uvgs_bench.report.maps import band_levels
from uvgs_bench.report.sections import CALIBRATION_SECTIONS
from uvgs_bench.report.sections.calibration_verdict import rules

pytestmark = pytest.mark.opencv

LENS = Lens("plumb_bob", 640, 480, np.array([600.0, 601.0, 321.0, 238.0, -0.2, 0.06, 4e-4, -3e-4, 0.0]))
BOARD_M = np.array([[0.025 * i, 0.025 * j, 0.0] for j in range(6) for i in range(9)])
SIGMA_PX = 0.1
NOTES = {"created_utc": "2026-01-02T03:04:05Z", "source": "images:pictures", "board": HOSTILE}


def views(count: int = 12, tilt_rad: float = 0.7, seed: int = 3) -> list[BoardView]:
    """Noisy corners of boards all over the picture; corner 7 of the second view is 5 px off."""
    rng = np.random.default_rng(seed)
    middle = BOARD_M.mean(axis=0)
    found: list[BoardView] = []
    while len(found) < count:
        R = so3_exp(np.array([*rng.uniform(-tilt_rad, tilt_rad, 2), rng.uniform(-0.3, 0.3)]))
        place = np.array([*rng.uniform(-0.11, 0.11, 2), rng.uniform(0.3, 0.5)])
        px = LENS.project(BOARD_M @ R.T + place - R @ middle)
        if LENS.contains(px, 3.0).all():
            px = px + SIGMA_PX * rng.standard_normal(px.shape)
            if len(found) == 1:
                px[7] += [4.0, -3.0]
            found.append(BoardView(f"{HOSTILE} {len(found)}.png", px, BOARD_M, 640, 480))
    return found


@pytest.fixture(scope="module")
def result() -> CalibrationResult:
    found = calibrate(views(), "plumb_bob", camera_name=HOSTILE, notes=NOTES)
    trials = (LensTrial("plumb_bob", 0.14, 0.16, np.array([0.16]), ""), LensTrial("fov", 0.2, np.inf, np.array([]), ""))
    misses = (BoardMiss(HOSTILE, "board_not_found", "nothing there"),)
    return replace(found, lens_trials=trials, misses=misses)


@pytest.fixture(scope="module")
def evidence(result: CalibrationResult) -> CalibrationEvidence:
    rng = np.random.default_rng(1)
    image = rng.integers(0, 255, (480, 640), dtype=np.uint8)
    pictures = {result.view_names[i]: image for i in worst_views(result, 2)}
    return CalibrationEvidence(result.calibration, result, beacon(), pictures)


@pytest.fixture(scope="module")
def document(evidence: CalibrationEvidence) -> Document:
    return build_calibration_document(evidence)


def words(document: Document) -> str:
    return render_json(document)


def chapters(monkeypatch: pytest.MonkeyPatch, *keys: str) -> None:
    """Draw only what a test looks at."""
    monkeypatch.setattr(calibration_page, "CALIBRATION_SECTIONS", {key: CALIBRATION_SECTIONS[key] for key in keys})


def test_page_pdf_and_json_show_the_same_figures(document: Document, result: CalibrationResult) -> None:
    data = check_three_agree(document)
    assert [s["key"] for s in data["sections"]] == list(CALIBRATION_SECTIONS)
    shown = {figure["label"]: figure["number"]["value"] for figure in data["key_figures"]}
    assert shown["Residual, RMS of lengths"] == result.calibration.rms_px
    assert shown["Residual, RMS per axis"] == pytest.approx(shown["Residual, RMS of lengths"] / np.sqrt(2.0))
    assert data["created_utc"] == NOTES["created_utc"]
    assert "<script>alert" not in render_html(document)


def test_building_twice_gives_the_same_bytes(evidence: CalibrationEvidence, monkeypatch: pytest.MonkeyPatch) -> None:
    # One of each kind of drawing: arrows, bands, in space, pictures.
    chapters(monkeypatch, "residuals", "uncertainty", "boards", "views")
    first, again = (build_calibration_document(evidence) for _ in range(2))
    assert render_html(first) == render_html(again)
    assert render_json(first) == render_json(again)


def test_the_planted_outlier_is_listed_and_crossed_out(document: Document, result: CalibrationResult) -> None:
    second = result.view_names[1]
    assert not kept_masks(result)[1][7]
    section = next(s for s in document.sections if s.key == "views")
    tables = [b for b in section.blocks if isinstance(b, Table)]
    worst = tables[1].rows[0]
    assert worst[0] == second
    # 5 px planted, noise 0.1 px.
    assert float(worst[4].shown) == pytest.approx(5.0, abs=0.4)  # type: ignore[union-attr]
    assert tables[2].rows[0][1:] == ("board not found", "nothing there")


def failed(result: CalibrationResult) -> list[str]:
    return [str(row[0]) for row in rules(result) if isinstance(row[3], Mark) and row[3].state == "fail"]


def test_no_rule_fails_on_a_usable_calibration_and_one_does_on_another(
    result: CalibrationResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    chapters(monkeypatch, "verdict")
    verdict = result.calibration.verdict
    assert verdict is not None
    assert verdict.is_usable
    assert failed(result) == []
    flat = calibrate(views(tilt_rad=0.05), "plumb_bob", notes=NOTES)
    assert flat.calibration.verdict is not None
    assert flat.calibration.verdict.word == "not_usable"
    assert "Largest tilt of a board" in failed(flat)
    document = build_calibration_document(CalibrationEvidence(flat.calibration, flat))
    assert document.verdict == "fail"
    assert document.verdict_word == "not usable"


def test_what_changed_over_the_pictures_is_judged_and_drawn(
    evidence: CalibrationEvidence, result: CalibrationResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    count = len(result.views)
    change = np.linspace(-0.01, 0.01, count)
    change[3] = np.nan
    trends = ViewTrends(change, np.full(count, 2e-4), 0.02, 1e-3, (Streak(2, 3.5, 0.5),))
    moving = replace(result, trends=trends)
    assert [row for row in failed(moving) if row.startswith("Drift of the focal length")]
    within = replace(result, trends=replace(trends, drift_sigma=0.01))
    assert failed(within) == []
    assert failed(replace(result, is_at_rest=False)) == ["The adjustment came to rest"]
    chapters(monkeypatch, "views")
    document = build_calibration_document(replace(evidence, result=moving))
    drawn = next(figure for figure in document.figures() if figure.key == "focal-order")
    assert "+2.000 ± 0.100 %" in drawn.alt
    assert result.view_names[2] in drawn.alt


def test_a_refusal_never_stands_over_passes_alone(result: CalibrationResult) -> None:
    refused = Verdict("not_usable", 0.0, ("a rule nobody told the page about",))
    known = replace(result, calibration=replace(result.calibration, verdict=refused))
    assert failed(known) == ["Another reason, given in words below"]


def test_few_views_leave_the_halves_open(monkeypatch: pytest.MonkeyPatch) -> None:
    chapters(monkeypatch, "verdict", "pose", "halves", "views")
    few = calibrate(views(5), "plumb_bob", notes=NOTES)
    document = build_calibration_document(CalibrationEvidence(few.calibration, few))
    assert document.verdict == "inconclusive"
    text = words(document)
    assert "too few to calibrate two halves" in text
    assert "No beacon was named" in text
    assert "were not at hand" in text
    assert all("Halves" not in figure.label for figure in document.key_figures)


def test_the_camera_file_alone_gives_maps_and_says_what_is_missing(result: CalibrationResult) -> None:
    document = build_calibration_document(CalibrationEvidence(result.calibration, beacon=beacon()))
    assert [s.key for s in document.sections] == ["verdict", "pose", "uncertainty", "lens", "definitions"]
    assert any("camera file alone" in banner.text for banner in document.banners)
    check_three_agree(document)
    bare = build_calibration_document(CalibrationEvidence(Calibration(LENS, "bare")))
    assert bare.verdict == "none"
    assert "carries no covariance" in words(bare)


def test_disagreeing_halves_widen_what_people_sign(
    evidence: CalibrationEvidence, result: CalibrationResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    chapters(monkeypatch, "pose")
    assert result.split_half is not None
    honest, doubted = (
        replace(result, calibration=replace(result.calibration, halves_ratio=ratio)) for ratio in (0.8, 3.0)
    )
    widths = []
    for known in (honest, doubted):
        document = build_calibration_document(replace(evidence, calibration=known.calibration, result=known))
        focal = next(figure for figure in document.key_figures if figure.label == "Focal length fx")
        assert focal.interval is not None
        widths.append(focal.interval.high - focal.interval.low)  # type: ignore[operator]
        assert any("3.0 times more" in banner.text for banner in document.banners) == (known is doubted)
        assert ("calibration, times 3.00" in words(document)) == (known is doubted)
    assert widths[1] == pytest.approx(3.0 * widths[0])


def test_simulated_pictures_are_named_before_anything_else(
    result: CalibrationResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    notes = NOTES | {"source": "sim-board:charuco_9x6"}
    drawn = replace(result.calibration, notes=notes)
    chapters(monkeypatch, "definitions")
    assert build_calibration_document(CalibrationEvidence(drawn)).banners[0].text.startswith("SIMULATED CAMERA")


def test_a_beacon_outside_the_picture_is_not_forecast(result: CalibrationResult) -> None:
    assert doubt_ahead(result.calibration, beacon().positions_m, 0.09) is None
    doubt = doubt_ahead(result.calibration, beacon().positions_m, 1.0)
    assert doubt is not None
    assert (doubt.calibration_sigmas > 0.0).all()


def test_the_map_of_two_halves_adds_up_to_their_figure(result: CalibrationResult) -> None:
    halves = result.split_half
    assert halves is not None
    assert np.sqrt(np.mean(halves.grid_difference_px**2)) == pytest.approx(halves.difference_px)
    assert np.sqrt(np.mean(halves.grid_predicted_px**2)) == pytest.approx(halves.predicted_px)


def test_a_pixel_in_the_middle_of_a_pinhole_is_one_over_the_focal_length() -> None:
    pinhole = Lens("plumb_bob", 640, 480, np.array([600.0, 600.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    angles = angle_per_pixel(pinhole, [[320.0, 240.0], [620.0, 240.0]])
    # The finite step of one pixel errs by its square.
    assert angles[0] == pytest.approx(1.0 / 600.0, rel=1e-6)
    # Off the axis a pixel is smaller: cos^3 of the angle is its solid angle, the root of it its side.
    assert angles[1] == pytest.approx(np.cos(np.arctan(0.5)) ** 1.5 / 600.0, rel=1e-5)


@pytest.mark.parametrize("values", [np.array([0.1, 7.0]), np.full(9, 0.3), np.array([np.nan, 2.0]), np.array([np.nan])])
def test_levels_rise_and_lie_among_the_values(values: np.ndarray) -> None:
    levels = band_levels(values)
    assert len(levels) >= 2
    assert (np.diff(levels) > 0.0).all()


def test_poses_carry_boards_to_where_they_were_seen(result: CalibrationResult) -> None:
    pose = result.camera_from_board[0]
    assert isinstance(pose, Pose)
    px = result.calibration.lens.project(pose.apply(result.views[0].board_m))
    # Residuals are observed minus projected.
    np.testing.assert_allclose(result.views[0].px - px, result.residuals_px[0], atol=1e-9)
