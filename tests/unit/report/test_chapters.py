"""What the report says about runs that are not as they should be."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.synthetic_run import (
    LIMIT_VERDICTS,
    empty_judgement,
    observations_of,
    synthetic_judgement,
    synthetic_run,
    with_pictures,
)
from uvgs_bench.accuracy.judgement import QUANTITIES, Alert, Judgement, Limit, LimitVerdict
from uvgs_bench.accuracy.pose_error import error_table
from uvgs_bench.accuracy.registration import fit_registration
from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.report import build, build_document
from uvgs_bench.report.cells import Number
from uvgs_bench.report.document import Document, Figure, Paragraph, Section, Table
from uvgs_bench.report.pictures import overlay_png, read_picture
from uvgs_bench.report.quantities import station_means
from uvgs_bench.report.sections import SECTIONS, distribution, errors, limits, misses, registration, worst
from uvgs_bench.sensor.outcome import Miss
from uvgs_bench.store.run import Run

BUILT_ON_ERRORS = ("errors", "volume", "distribution", "worst", "quantities", "budget", "motion", "gantry")
"""Chapters left out when there are no errors; the last two when nothing was driven and the gantry was never judged."""


def section(document: Document, key: str) -> Section:
    return next(s for s in document.sections if s.key == key)


def tables(section: Section) -> list[Table]:
    return [block for block in section.blocks if isinstance(block, Table)]


@pytest.fixture(scope="module")
def run() -> Run:
    return synthetic_run(stations=15, shots=2)


@pytest.fixture(scope="module")
def judgement(run: Run) -> Judgement:
    return synthetic_judgement(run)


def test_the_simulated_bench_is_named_before_anything_else(run: Run) -> None:
    document = build_document(run, empty_judgement(run, "nothing to see"))
    assert document.banners[0].text.startswith("SIMULATED BENCH")
    real = replace(run, manifest=replace(run.manifest, simulated=False))
    assert build_document(real, empty_judgement(real, "nothing to see")).banners == ()


@pytest.mark.parametrize(
    ("ended", "words"), [("interrupted", "was interrupted"), ("failed", "failed"), ("", "has no recorded end")]
)
def test_a_run_that_did_not_complete_is_reported_as_such(run: Run, ended: str, words: str) -> None:
    short = replace(run, ended=ended, end_reason="Ctrl-C", samples=run.samples[:10])  # type: ignore[arg-type]
    document = build_document(short, empty_judgement(short, "too few stations"))
    banner = next(b for b in document.banners if b.text.startswith("INCOMPLETE"))
    assert words in banner.text
    assert "5 of 15 stations" in banner.text
    assert banner.level == "danger"


def test_a_run_that_cannot_be_registered_says_why(run: Run) -> None:
    document = build_document(run, empty_judgement(run, "needs at least 3 stations, got 2"))
    assert document.verdict == "inconclusive"
    assert document.headline == "No accuracy can be stated: needs at least 3 stations, got 2"
    assert [s.key for s in document.sections] == [key for key in SECTIONS if key not in BUILT_ON_ERRORS]
    (said,) = section(document, "diagnosis").blocks
    assert isinstance(said, Paragraph)
    assert "without a registration" in said.text


def test_a_run_without_samples_has_a_report(run: Run) -> None:
    nothing = replace(run, samples=(), ended="failed")
    document = build_document(nothing, replace(empty_judgement(run, "no captures")))
    assert "0 of 15 stations" in " ".join(b.text for b in document.banners)


def test_the_headline_names_the_limits_that_are_missed(judgement: Judgement) -> None:
    missed = replace(judgement, verdict="fail", verdicts=LIMIT_VERDICTS)
    assert build.headline(missed) == "1 of 3 limits is missed: availability (97.2 % at most, below 99 %)."


def test_the_headline_of_a_run_that_passes_limit_by_limit_but_is_open_says_so(judgement: Judgement) -> None:
    opened = replace(judgement, verdict="inconclusive", verdicts=LIMIT_VERDICTS[:1])
    assert "cannot be judged" in build.headline(opened)


def test_every_quantity_a_limit_may_name_has_words_and_its_unit(run: Run) -> None:
    verdicts = tuple(
        LimitVerdict(Limit.of(name, 1.5), 1.234, 1.1, math.inf, 9, "inconclusive", "open") for name in QUANTITIES
    )
    judgement = replace(empty_judgement(run, "x"), verdicts=verdicts)
    built = limits.build(run, judgement)
    assert built is not None
    rows = tables(built)[0].rows
    assert len({row[0] for row in rows}) == len(QUANTITIES)
    for row, name in zip(rows, QUANTITIES, strict=True):
        assert isinstance(row[2], Number)
        assert row[2].unit == {"mm": "mm", "deg": "deg", "percent": "%", "ms": "ms"}[QUANTITIES[name][2]]
        assert str(row[4]).startswith("≥" if name == "availability_percent" else "≤")


def test_a_procedure_without_limits_is_not_called_passed(run: Run) -> None:
    built = limits.build(run, replace(empty_judgement(run, "x"), verdicts=()))
    assert built is not None
    assert isinstance(built.blocks[0], Paragraph)
    assert "no limits" in built.blocks[0].text


def test_misses_are_counted_by_stage_and_reason(run: Run) -> None:
    built = misses.build(run, empty_judgement(run, "x"))
    assert built is not None
    count = sum(isinstance(s.outcome, Miss) for s in run.samples)
    stage, reason, captures, share = tables(built)[0].rows[0]
    assert (stage, reason) == ("blobs", "too few blobs")
    assert isinstance(captures, Number)
    assert captures.value == count
    assert isinstance(share, Number)
    assert share.value == pytest.approx(100.0 * count / len(run.samples))


def test_the_worst_captures_come_first(run: Run, judgement: Judgement) -> None:
    built = worst.build(run, judgement)
    assert built is not None
    assert judgement.table is not None
    sizes = [row[3].value for row in tables(built)[0].rows if isinstance(row[3], Number)]
    assert sizes == sorted(sizes, reverse=True)  # type: ignore[type-var]
    assert sizes[0] == pytest.approx(1000.0 * float(np.nanmax(judgement.table.position_error_m)))


def test_a_direction_the_gauge_holds_has_no_doubt_printed(run: Run, judgement: Judgement) -> None:
    built = registration.build(run, judgement)
    assert built is not None
    left, right = tables(built)[:2]
    assert all(isinstance(row[2], Number) for row in left.rows)
    assert [row[2] for row in right.rows] == ["held"] * 3


def test_normalised_errors_of_an_honest_sensor_have_unit_spread() -> None:
    run = synthetic_run(stations=240, shots=2, miss_every=0, seed=3)
    obs = observations_of(run)
    registration = fit_registration(obs, obs.has_role("register"))
    table = error_table(obs.select(obs.has_role("judge")), registration)
    z = distribution.normalised(run, table, registration.gantry_sigma_m)
    # 320 held-out captures: the standard deviation of a standard deviation is 0.04; four of them. Depth (last column)
    # carries a planted slope and the lateral axes the gantry's assumed doubt, which this bench does not have.
    assert np.all(np.abs(z[:, :3].std(axis=0) - 1.0) < 0.16)
    assert np.all(np.abs(z[:, 3:5].std(axis=0) - 0.95) < 0.16)


def test_a_rotary_axis_is_shown_in_degrees(run: Run, judgement: Judgement) -> None:
    turning = Axis("A", "rotary", np.array([0.0, 0.0, 1.0]), -1.0, 1.0, 0.1, 0.1)
    axes = (*run.manifest.axes[:2], turning)
    turned = replace(run, manifest=replace(run.manifest, axes=axes))
    built = errors.build(turned, judgement)
    assert built is not None
    figure = next(f for f in built.blocks if isinstance(f, Figure) and f.key == "position-axis-3")
    assert figure.series[0].unit == "deg"
    assert max(figure.series[0].values) == pytest.approx(np.rad2deg(max(s.position[2] for s in run.samples)), rel=0.3)


def test_an_alert_keeps_its_weight(run: Run) -> None:
    alerts = (Alert("error", "a"), Alert("warning", "b"), Alert("note", "c"))
    built = limits.build(run, replace(empty_judgement(run, "x"), alerts=alerts))
    assert built is not None
    assert [item.level for item in built.blocks[-1].items] == ["danger", "warning", "info"]  # type: ignore[union-attr,misc]


def test_means_of_stations_leave_out_misses() -> None:
    station = np.array([2, 2, 5, 7, 7])
    values = np.array([[1.0, 2.0], [3.0, 4.0], [np.nan, 1.0], [9.0, 9.0], [np.nan, np.nan]])
    means = station_means(station, values)
    np.testing.assert_array_equal(means, [[2.0, 3.0], [np.nan, np.nan], [9.0, 9.0]])


def test_fits_and_judges_are_told_apart_by_role(run: Run) -> None:
    assert observations_of(run).has_role("register").sum() == 10


@pytest.mark.opencv
def test_pictures_that_are_gone_or_broken_are_left_out(tmp_path: Path) -> None:
    assert read_picture(tmp_path / "none.png") is None
    (tmp_path / "empty.png").write_bytes(b"")
    assert read_picture(tmp_path / "empty.png") is None
    (tmp_path / "torn.png").write_bytes(b"\x89PNG\r\n\x1a\nnope")
    assert read_picture(tmp_path / "torn.png") is None


@pytest.mark.opencv
def test_overlays_are_cut_around_the_beacon_even_at_the_border(tmp_path: Path) -> None:
    run = with_pictures(synthetic_run(tmp_path / "run", stations=3, shots=1, miss_every=0))
    image = read_picture(run.path / run.samples[0].capture_file)
    assert image is not None
    assert image.shape == (480, 640, 3)
    names = ("L1", "L2")
    corner = np.array([[2.0, 3.0], [20.0, 11.0]])
    for px in (
        corner,
        corner + np.array([610.0, 460.0]),
        np.full((2, 2), np.nan),
        np.array([[-50.0, 9.0], [3.0, 900.0]]),
    ):
        assert overlay_png(image, px, px + 0.5, names).startswith(b"\x89PNG")


@pytest.mark.opencv
@pytest.mark.parametrize(("dtype", "level", "shown"), [("uint8", 200, 255), ("uint8", 8, 32), ("uint16", 4000, 255)])
def test_dim_captures_stay_dim(tmp_path: Path, dtype: str, level: int, shown: int) -> None:
    import cv2

    cv2.imwrite(str(tmp_path / "a.png"), np.full((4, 4), level, dtype=dtype))
    image = read_picture(tmp_path / "a.png")
    assert image is not None
    # One grey level of rounding.
    assert abs(int(image[0, 0, 0]) - shown) <= 1


def test_the_largest_seen_is_no_interval_of_no_width(run: Run, judgement: Judgement) -> None:
    limit = Limit.of("position_max_mm", 2.0)
    met = LimitVerdict(limit, 1.3, 1.3, 1.3, 80, "pass", "95 % interval 1.3 to 1.3 mm is within the limit")
    missed = replace(met, limit=Limit.of("position_max_mm", 1.0), verdict="fail")
    rows = tables(limits.build(run, replace(judgement, verdicts=(met, missed))))[0].rows
    assert [row[3] for row in rows] == ["the largest seen", "the largest seen"]
    assert "95 % of all lie below it" in str(rows[0][6])
    assert "beyond" in build.headline(replace(judgement, verdict="fail", verdicts=(missed,)))
    of_errors = tables(section(build_document(run, judgement), "accuracy"))[0]
    assert [column.label for column in of_errors.columns][-1] == "Largest"
    assert all(isinstance(row[-1], Number) for row in of_errors.rows)


def test_the_map_tells_stations_that_judge_from_those_that_fitted(run: Run, judgement: Judgement) -> None:
    (figure,) = [f for f in section(build_document(run, judgement), "volume").blocks if getattr(f, "live", "")]
    assert isinstance(figure, Figure)
    *columns, times = [np.array(series.values) for series in figure.series]
    assert {len(column) for column in columns} == {15}
    assert int(columns[7].sum()) == 5
    assert judgement.table is not None
    # The mean error of the first station that judges, in mm.
    first = judgement.table.station == judgement.table.station.min()
    expected = 1e3 * judgement.table.translation_error_m[first].mean(axis=0)
    np.testing.assert_allclose([columns[k][0] for k in (3, 4, 5)], expected, rtol=1e-12)
    assert f"{times[0]:g} times as long as true" in figure.caption


def test_stations_judged_by_folds_are_drawn_once(run: Run, judgement: Judgement) -> None:
    folded = replace(judgement, in_sample_table=judgement.table)
    (figure,) = [f for f in section(build_document(run, folded), "volume").blocks if getattr(f, "live", "")]
    assert isinstance(figure, Figure)
    assert len(figure.series[0].values) == 10
    assert not any(figure.series[7].values)
