"""A gantry with planted errors, judged: what comes back, and whether the intervals tell the truth about it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from tests.helpers.gantry_judges import BOARD, PLANTED, JudgedBench
from uvgs_bench.accuracy.axis_calibration import fit_axis_errors, true_directions
from uvgs_bench.camera.boards import BoardView
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.gantry.axes import Axis, gantry_from_carriage
from uvgs_bench.devices.sim.bench import true_axes
from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.errors import RegistrationError
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.sessions.characterise import Options, Reading, Visit
from uvgs_bench.sessions.judge_gantry import Judge, judge_gantry
from uvgs_bench.store.gantry_records import GantryRecord, measured_axes

pytestmark = pytest.mark.opencv

SCALE = np.array([2e-3, -2e-3, 2e-3])
SHEAR_RAD = np.array([1e-3, -1e-3, 1e-3])
PARAMETERS = (1002.4, 1001.7, 643.2, 476.9, -0.08, 0.045, 0.0004, -0.0003, 0.0)
LENS = Lens("plumb_bob", 1280, 960, np.array(PARAMETERS))


def views_of(seed: int, mount: str, noise_px: float, repeat_m: float, counts: tuple[int, ...] = (4, 4, 3)):
    """Corners of a board at a grid of places 0.9 m before the camera, and the places."""
    rng = np.random.default_rng(seed)
    places = np.stack(np.meshgrid(*[np.linspace(-0.15, 0.15, c) for c in counts], indexing="ij"), -1).reshape(-1, 3)
    R_cg = so3_exp(np.array([np.pi / 2, 0.0, 0.0]) + rng.normal(0.0, 0.02, 3))
    R_cb = so3_exp(rng.normal(0.0, 0.15, 3))
    true = true_directions(np.eye(3), SCALE, SHEAR_RAD)
    sign = 1.0 if mount == "beacon_on_carriage" else -1.0
    middle = np.array([0.0, 0.0, 0.9]) - R_cb @ BOARD.points_m.mean(axis=0)
    views = []
    for i, place in enumerate(places):
        shift = sign * R_cg @ (true.T @ place + rng.normal(0.0, repeat_m, 3))
        px = LENS.project(BOARD.points_m @ R_cb.T + shift + middle)
        views.append(BoardView(str(i), px + rng.normal(0.0, noise_px, px.shape), BOARD.points_m, 1280, 960))
    return views, places


@pytest.mark.parametrize("mount", ["beacon_on_carriage", "camera_on_carriage"])
def test_without_noise_the_planted_errors_come_back(mount) -> None:
    views, places = views_of(1, mount, 0.0, 0.0, (3, 3, 2))
    errors = fit_axis_errors(views, places, np.eye(3), Calibration(LENS, "true"), mount=mount)
    np.testing.assert_allclose(errors.scale, SCALE, atol=1e-9)
    np.testing.assert_allclose(errors.shear_rad, SHEAR_RAD, atol=1e-9)
    assert errors.rms_px < 1e-6


def study(seeds: range) -> tuple[np.ndarray, np.ndarray]:
    """Errors and standard deviations of scales and shears, (trials, 6)."""
    off, sigmas = [], []
    for seed in seeds:
        views, places = views_of(seed, "beacon_on_carriage", 0.1, 1e-5)
        errors = fit_axis_errors(views, places, np.eye(3), Calibration(LENS, "true"))
        off.append(np.concatenate([errors.scale - SCALE, errors.shear_rad - SHEAR_RAD]))
        sigmas.append(errors.sigmas)
    return np.array(off), np.array(sigmas)


def test_scale_and_squareness_to_ten_percent() -> None:
    """48 places, 0.1 px of corner noise, 10 um of repeatability."""
    off, sigmas = study(range(12))
    # 10 % of 0.2 % and of 1 mrad; along the view of the camera doubts are three times those across it.
    lateral = [0, 2, 4]
    assert np.abs(off[:, lateral]).max() < 2e-4
    assert np.sqrt(np.mean(off**2, axis=0)).max() < 2e-4
    # 72 values of 95 % intervals: fewer than 60 inside has a chance below 1e-4.
    assert np.sum(np.abs(off) < 1.96 * sigmas) >= 60


@pytest.mark.slow
def test_intervals_of_scale_and_squareness_cover() -> None:
    off, sigmas = study(range(300))
    z = off / sigmas
    print("rms error", np.sqrt(np.mean(off**2, axis=0)), "cover", np.mean(np.abs(z) < 1.96, axis=0))
    # 300 trials know a coverage of 95 % to 1.3 %; three times that, and 48 places for 15 unknowns cost some.
    assert np.all(np.mean(np.abs(z) < 1.96, axis=0) > 0.90)


def test_the_doubts_of_board_and_lens_are_in_the_covariance() -> None:
    views, places = views_of(1, "beacon_on_carriage", 0.1, 1e-5)
    sure = fit_axis_errors(views, places, np.eye(3), Calibration(LENS, "true"))
    board = fit_axis_errors(views, places, np.eye(3), Calibration(LENS, "true"), board_sigma=1e-3)
    np.testing.assert_allclose(board.sigmas[:3] ** 2 - sure.sigmas[:3] ** 2, 1e-6, rtol=1e-6)
    np.testing.assert_allclose(board.sigmas[3:], sure.sigmas[3:])
    focal = np.zeros((9, 9))
    focal[0, 0] = focal[1, 1] = 1.0
    focal[0, 1] = focal[1, 0] = 1.0
    lens = fit_axis_errors(views, places, np.eye(3), Calibration(LENS, "true", covariance=focal))
    # One px of 1002 px in both focal lengths makes the way along the view longer or shorter by a part in 1002.
    added = np.sqrt(lens.sigmas**2 - sure.sigmas**2)
    assert added[1] == pytest.approx(1.0 / 1002.0, rel=0.05)
    assert added[[0, 2]].max() < 0.2 / 1002.0


def bent_views(seed: int, bend_m: float) -> tuple[list[BoardView], np.ndarray]:
    """Pictures, and places as told by axes of which the first is off by a parabola."""
    views, places = views_of(seed, "beacon_on_carriage", 0.04, 1e-5)
    u = places[:, 0] / 0.15
    return views, places + np.column_stack([bend_m * (0.5 - 1.5 * u * u), np.zeros_like(u), np.zeros_like(u)])


def bends(seed: int, bend_m: float) -> tuple[np.ndarray, np.ndarray]:
    views, told = bent_views(seed, bend_m)
    errors = fit_axis_errors(views, told, np.eye(3), Calibration(LENS, "true"))
    return errors.bend_m, errors.bend_chance


def test_a_scale_that_changes_along_an_axis_is_noticed_and_others_are_not() -> None:
    for seed in range(2):
        bend_m, chance = bends(seed, 5e-5)
        # m; four levels of X with 10 um of repeatability, 12 pictures each.
        assert bend_m[0] == pytest.approx(5e-5, abs=1.5e-5)
        assert chance[0] < 1e-3
        assert np.all(chance[1:] > 1e-3)
    straight = np.array([bends(seed, 0.0)[1] for seed in range(10, 16)])
    # 18 chances: one below 1e-3 has a chance of 2 %, and the seeds are fixed.
    assert np.all(straight > 1e-3)


def test_the_record_says_that_a_changing_scale_is_not_corrected() -> None:
    views, told = bent_views(3, 5e-5)
    axes = [Axis(name, "linear", row, -0.2, 0.2, 0.05, 0.2) for name, row in zip("XYZ", np.eye(3), strict=True)]
    readings = [
        Reading(Visit("squareness", -1, place, (place,)), 0.0, place, view=view)
        for view, place in zip(views, told, strict=True)
    ]
    judge = Judge("corners", Calibration(LENS, "true"), board_sigma=0.0)
    record = judge_gantry(readings, axes, judge, Options(tests=("squareness",)), "bench", "2026-01-01T00:00:00Z")
    assert record.axes[0].bend_mm == pytest.approx(0.05, abs=0.015)
    assert record.axes[1].bend_mm is record.axes[2].bend_mm is None
    assert [remark for remark in record.remarks if "axis X has no constant scale" in remark]


def test_places_on_a_plane_are_refused() -> None:
    views, places = views_of(1, "beacon_on_carriage", 0.1, 1e-5, (4, 4, 1))
    with pytest.raises(RegistrationError, match="spread along every linear axis"):
        fit_axis_errors(views, places, np.eye(3), Calibration(LENS, "true"))
    with pytest.raises(RegistrationError, match="8 places or more"):
        fit_axis_errors(views[:5], places[:5], np.eye(3), Calibration(LENS, "true"))


TESTED = Options(tests=("still", "reversal", "squareness"), runs=3)


def errors_of(record: GantryRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Off by, half of the 95 % interval, and what is 10 % of the planted: scales, squarenesses, dead bands."""
    axes, pairs = record.axes, record.pairs
    scale = np.array([axis.scale_ppm for axis in axes]) - PLANTED.scale_ppm
    lean = np.array([pair.squareness_mrad for pair in pairs]) - PLANTED.squareness_mrad
    band = np.array([(axis.backlash_mm, axis.backlash_low_mm, axis.backlash_high_mm) for axis in axes]) - 0.1
    off = np.concatenate([scale, lean, band[:, 0]])
    # An interval of a dead band need not be even: its half is the one on the side of the truth.
    reach = np.where(band[:, 0] > 0.0, band[:, 0] - band[:, 1], band[:, 2] - band[:, 0])
    sigmas = [*(axis.scale_sigma_ppm for axis in axes), *(pair.squareness_sigma_mrad for pair in pairs)]
    return off, np.concatenate([1.96 * np.array(sigmas), reach]), np.repeat([200.0, 0.1, 0.01], 3)


@pytest.fixture(scope="module")
def judged() -> Iterator[tuple[JudgedBench, GantryRecord]]:
    bench = JudgedBench()
    yield bench, bench.characterise(TESTED)
    bench.close()


def test_a_gantry_with_planted_errors_is_recognised(judged) -> None:
    off, reach, tenth = errors_of(judged[1])
    # Y looks along the camera's view: its dead band is the dial gauge's, and the record says so.
    told = np.arange(9) != 7
    assert np.all(np.abs(off)[told] < tenth[told])
    assert np.all(np.abs(off) < 1.7 * reach)
    assert any("dead band of Y" in remark and "dial gauge" in remark for remark in judged[1].remarks)
    assert not any("dead band of X" in remark for remark in judged[1].remarks)


def test_measured_axes_put_the_carriage_where_it_is(judged) -> None:
    bench, record = judged
    axes = bench.described.nominal_axes
    corrected = measured_axes(record, axes, "here")
    vectors = np.array([v for _, v in true_axes(replace(SimulatedTruth(), gantry=PLANTED), axes)])
    q = np.array([-0.3, -0.25, -0.2])
    true_m = q @ vectors
    # m; nominal axes are off by half a millimetre, measured ones by doubts of 30 ppm across and 120 ppm along the view.
    assert np.linalg.norm(gantry_from_carriage(axes, q).t_m - true_m) > 5e-4
    assert np.linalg.norm(gantry_from_carriage(corrected, q).t_m - true_m) < 1e-4


@pytest.mark.slow
def test_many_gantries() -> None:
    found = []
    for seed in range(2, 42):
        bench = JudgedBench(seed=seed)
        found.append(errors_of(bench.characterise(TESTED)))
        bench.close()
    off, reach = np.array([o for o, _, _ in found]), np.array([r for _, r, _ in found])
    tenth = found[0][2]
    inside = np.abs(off) < reach
    print("\nscales ppm, squarenesses mrad, dead bands mm; X Y Z, XY XZ YZ, X Y Z")
    for name, row in (
        ("rms", np.sqrt(np.mean(off**2, axis=0))),
        ("largest", np.abs(off).max(axis=0)),
        ("cover", inside.mean(axis=0)),
    ):
        print(f"{name:>8}", np.round(row, 4))
    told = np.arange(9) != 7
    # Half of the tenth: along the view two standard deviations are the tenth.
    assert np.all(np.sqrt(np.mean(off**2, axis=0))[told] < 0.5 * tenth[told])
    # 360 values of 95 % intervals, nine from each of 40 gantries: below 90 % has a chance of some 1e-3.
    assert inside.mean() > 0.90
