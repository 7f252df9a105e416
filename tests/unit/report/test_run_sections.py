"""What the run's report says of budget, suspects, named figures, documents, gantry and bench."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.rendered import Page, check_three_agree
from tests.helpers.synthetic_run import empty_judgement, observations_of, synthetic_judgement, synthetic_run
from uvgs_bench.accuracy.bench_terms import AxisTerms
from uvgs_bench.accuracy.clusters import Estimate
from uvgs_bench.accuracy.diagnosis import Suspect
from uvgs_bench.accuracy.independent import Link
from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.accuracy.quantity_catalogue import quantity
from uvgs_bench.accuracy.suspects import SightLimit
from uvgs_bench.accuracy.uncertainty import Budget, BudgetLine
from uvgs_bench.report import build_document
from uvgs_bench.report.bench_drawing import bench_figure
from uvgs_bench.report.cells import Measured, Number
from uvgs_bench.report.document import Alerts, Document, Paragraph, Section, Table
from uvgs_bench.report.html import render_html
from uvgs_bench.report.quantities import stations_taken
from uvgs_bench.report.sections import (
    budget,
    diagnosis,
    distribution,
    gantry,
    quantities,
    registration,
    setup,
    traceability,
)
from uvgs_bench.store.gantry_records import AxisRecord, GantryRecord, PairRecord, write_gantry_record
from uvgs_bench.store.run import Run

INF = float("inf")
LINES = (
    BudgetLine("sensor noise", "A", 6e-4, 2e-3, "normal", 74.0, False, "scatter of captures", "expose longer"),
    BudgetLine("gantry position", "B", 3e-4, 0.0, "normal", INF, False, "bench file", "judge it", "reference"),
    BudgetLine("temperature", "B", 0.0, 0.0, "normal", INF, True, "nobody said", "write it down", "reference", False),
)
BUDGET = Budget(
    LINES, 6.7e-4, 2e-3, 3e-4, 0.0, 80.0, 1.92, 1.95, 1.286e-3, 3.9e-3, 1.31e-3, 1e-4, 1.4e-3, 4e-3, True, 6.5e-4,
    2e-3, "sensor noise", ("sensor noise is largest: expose longer", "temperature was not stated"),
)  # fmt: skip
SUSPECTS = (
    Suspect("focal", "focal length off", 3e-6, 4.1e-4, 0.52, 0.43, 0.61, "%", "depth grows", "measure", 1, ("scale",)),
    Suspect("labels", "other poses", 0.0123, float("nan"), 1.1, 0.7, 1.5, "%", "turned", "look", 2),
)
QUANTITIES = (
    quantity("absolute_position_rms", Estimate(7e-4, 6e-4, 8e-4, 40, 113, "", 97.0)),
    quantity("availability", Estimate(0.94, 0.9, 0.97, 40, 120)),
    quantity("lag", Estimate(float("nan"), 0.0, INF, 0, 0, "no capture in motion has a pose")),
    quantity("position_rms", Estimate(6e-4, 5e-4, 8e-4, 20, 60), "range", "0.60 to 0.80 m"),
    quantity("position_rms", Estimate(9e-4, 0.0, INF, 3, 9, "only 3 stations"), "range", "0.80 to 1.00 m"),
)
AXES = tuple(
    AxisRecord(name, tuple(np.eye(3)[k].tolist()), 120.0, 30.0, repeatability_mm=0.021)  # type: ignore[arg-type]
    for k, name in enumerate("XYZ")
)
RECORD = GantryRecord("bench", "2025-12-30T03:04:05Z", "dial gauge 77", AXES, (PairRecord(("X", "Y"), 0.9, 0.1),))


@pytest.fixture(scope="module")
def run() -> Run:
    return synthetic_run(stations=15, shots=2)


@pytest.fixture(scope="module")
def judgement(run: Run) -> Judgement:
    return replace(synthetic_judgement(run), budget=BUDGET, diagnosis=SUSPECTS, quantities=QUANTITIES)


def tables(section: Section | None) -> list[Table]:
    assert section is not None
    return [block for block in section.blocks if isinstance(block, Table)]


def words(section: Section | None) -> str:
    assert section is not None
    found = [b.text for b in section.blocks if isinstance(b, Paragraph)]
    return " ".join(found + [item.text for b in section.blocks if isinstance(b, Alerts) for item in b.items])


def with_record(run: Run, folder: Path, text: str = "") -> Run:
    (folder / "setup").mkdir(parents=True)
    write_gantry_record(folder / "setup" / "gantry.toml", RECORD)
    if text:
        (folder / "setup" / "gantry.toml").write_text(text)
    hashes = run.manifest.hashes | {"gantry.toml": "ab" * 32}
    return replace(run, path=folder, manifest=replace(run.manifest, hashes=hashes))


def test_a_line_nobody_stated_has_no_number(run: Run, judgement: Judgement) -> None:
    rows = tables(budget.build(run, judgement))[0].rows
    assert [row[0] for row in rows] == [line.name for line in LINES]
    position = [row[3].value for row in rows if isinstance(row[3], Number)]
    assert position == [pytest.approx(0.6), pytest.approx(0.3), None]
    assert rows[2][6] == "not stated"
    assert "temperature was not stated" in words(budget.build(run, judgement))


def test_a_monte_carlo_that_disagrees_is_not_hushed_up(run: Run, judgement: Judgement) -> None:
    said = str(tables(budget.build(run, judgement))[1].rows)
    assert "does NOT agree" not in said
    doubted = replace(judgement, budget=replace(BUDGET, is_confirmed=False))
    assert "does NOT agree" in str(tables(budget.build(run, doubted))[1].rows)


def test_suspects_keep_their_order_and_a_tiny_chance_is_no_zero(run: Run, judgement: Judgement) -> None:
    rows = tables(diagnosis.build(run, judgement))[0].rows
    assert [str(row[0])[:2] for row in rows] == ["1.", "2."]
    assert rows[0][3] == "< 0.0001"
    effect = rows[1][2]
    assert isinstance(effect, Number)
    assert effect.value is None


def test_silence_is_said_and_told_from_too_little_data(run: Run, judgement: Judgement) -> None:
    assert "Nothing stands out" in words(diagnosis.build(run, replace(judgement, diagnosis=())))
    short = replace(run, samples=run.samples[:12])
    assert words(diagnosis.build(short, replace(judgement, diagnosis=()))).startswith("Not diagnosed: 6 stations")


def test_a_figure_the_run_cannot_give_is_listed_with_the_reason(run: Run, judgement: Judgement) -> None:
    given, missing, by_range = tables(quantities.build(run, judgement))
    shares = [row[1] for row in given.rows if row[0] == "availability"]
    assert isinstance(shares[0], Measured)
    assert shares[0].number.value == pytest.approx(94.0)
    assert shares[0].number.unit == "%"
    assert missing.rows == (("lag of poses behind their stamps", "no capture in motion has a pose"),)
    assert [row[0] for row in by_range.rows] == ["0.60 to 0.80 m", "0.80 to 1.00 m"]


def test_documents_have_an_age_and_a_later_date_is_not_believed(run: Run, tmp_path: Path) -> None:
    traced = with_record(run, tmp_path / "run")
    empty = empty_judgement(traced, "x")
    row = next(row for row in tables(traceability.build(traced, empty))[0].rows if row[0] == "Gantry self-test")
    assert row[1:3] == ("2025-12-30T03:04:05Z", "3 days")
    assert row[4] == "ab" * 32
    assert "never judged" not in words(traceability.build(traced, empty))
    later = replace(run.calibration, notes={"created_utc": "2026-02-01T00:00:00Z"})
    said = words(traceability.build(replace(run, calibration=later), empty))
    assert "after this run began" in said
    assert "The gantry was never judged" in said


def test_the_gantry_is_reported_as_its_record_says(run: Run, tmp_path: Path) -> None:
    assert gantry.build(run, empty_judgement(run, "x")) is None
    built = gantry.build(with_record(run, tmp_path / "run"), empty_judgement(run, "x"))
    of_axes, of_pairs = tables(built)
    # What was not measured has no row.
    assert [row[0] for row in of_axes.rows] == [
        "Excess of travel, 1σ range", "Repeatability R, from both sides (ISO 230-2)"
    ]  # fmt: skip
    assert of_pairs.rows[0][0] == "X – Y"
    assert "dial gauge 77" in words(built)
    broken = with_record(run, tmp_path / "broken", "schema = 1\n")
    assert "cannot be read" in words(gantry.build(broken, empty_judgement(run, "x")))


def test_terms_beside_the_poses_are_shown_with_their_reasons(run: Run, judgement: Judgement) -> None:
    assert judgement.registration is not None
    C = np.diag([5e-5, 0.0, 0.0, 2e-4, 0.0, 0.0]) ** 2
    terms = AxisTerms(np.array([2e-3, 0.0, 0.0]), np.array([1e-3, 0.0, 0.0]), C, np.empty((0, 6)))
    offset = Estimate(0.02, 0.018, 0.022, 10, 30)
    fitted = replace(
        judgement.registration, axis_terms=terms, time_offset_s=offset, term_notes=("time_rate: left out",)
    )
    built = registration.build(run, replace(judgement, registration=fitted))
    rows = {str(row[0]): row[1:] for row in tables(built)[-1].rows}
    shown = {name: [cell.value for cell in cells if isinstance(cell, Number)] for name, cells in rows.items()}
    assert shown["Excess of travel along x"] == pytest.approx([2000.0, 50.0])
    assert shown["Lean of axes xy"] == pytest.approx([1.0, 0.2])
    assert shown["Captures are stamped late by"] == pytest.approx([20.0, 1.0])
    assert "time_rate: left out" in words(built)


def test_the_beacon_is_drawn_where_the_registration_predicts_it(run: Run, judgement: Judgement) -> None:
    assert judgement.registration is not None
    figure = bench_figure(run, judgement.registration)
    assert figure is not None
    drawn = np.array([series.values for series in figure.series]).T
    predicted = judgement.registration.predict(observations_of(run))[1]
    # Sorted alike: one row per place; nanometres of rounding.
    expected = np.unique(np.round(predicted, 9), axis=0)
    np.testing.assert_allclose(drawn[np.lexsort(drawn.T[::-1])], expected, atol=1e-8)


@pytest.fixture(scope="module")
def document(run: Run, judgement: Judgement) -> Document:
    return build_document(run, judgement)


@pytest.mark.opencv
def test_page_pdf_and_json_agree_on_budget_suspects_and_quantities(document: Document) -> None:
    data = check_three_agree(document)
    keys = [section["key"] for section in data["sections"]]
    assert [key for key in keys if key in ("quantities", "budget", "diagnosis")] == [
        "quantities",
        "budget",
        "diagnosis",
    ]
    live = [b["live"] for s in data["sections"] for b in s["blocks"] if b["kind"] == "figure" and b["live"]]
    assert sorted(live) == ["space", "zoom"]


@pytest.mark.opencv
def test_a_page_carries_only_the_scripts_it_needs(document: Document) -> None:
    page = render_html(document)
    assert "uPlot 1.6.32" in page
    assert "The MIT License" in page
    still = render_html(replace(document, sections=document.sections[:1]))
    assert "uPlot" not in still
    assert Page(still).tags["script"] == 1


def test_silence_comes_with_how_large_a_cause_would_have_to_be(run: Run, judgement: Judgement) -> None:
    limits = (SightLimit("scale", "axis x travels too far", "%", 0.12), SightLimit("latency", "late", "ms", INF))
    built = diagnosis.build(run, replace(judgement, diagnosis=(), sight_limits=limits))
    (least,) = tables(built)
    assert isinstance(least.rows[0][1], Number)
    assert least.rows[0][1].value == 0.12
    assert "cannot be seen" in str(least.rows[1][1])


def test_the_chain_of_links_says_what_rests_on_the_sensor(run: Run, judgement: Judgement) -> None:
    links = (Link("camera to gantry", 1e-4, 2e-4, "a board", True), Link("board to beacon", INF * 0, 1e-4, "?", False))
    built = registration.build(run, replace(judgement, links=links, is_independent=True))
    chain = tables(built)[-1]
    assert [row[3] for row in chain.rows] == ["no", "yes"]
    known, unknown = chain.rows[0][1], chain.rows[1][1]
    assert isinstance(known, Number)
    assert known.value == pytest.approx(0.1)
    assert isinstance(unknown, Number)
    assert unknown.shown == "–"
    assert "owes nothing to the sensor" in words(built)
    assert "absorbs any constant offset" in words(registration.build(run, judgement))


def test_captures_along_a_motion_are_no_stations(run: Run, judgement: Judgement) -> None:
    assert stations_taken(run) == 15
    driven = replace(run, manifest=replace(run.manifest, station_count=12))
    assert stations_taken(driven) == 12
    rows = {str(row[0]): row[1] for row in tables(setup.build(driven, judgement))[0].rows}
    assert str(rows["Stations taken"]).startswith("12 of 12 planned")
    along = rows["Of them along the motion"]
    assert isinstance(along, Number)
    assert along.value == 6


def test_the_covariance_is_judged_for_each_range(run: Run, judgement: Judgement) -> None:
    assert judgement.summary is not None
    checks = judgement.summary.consistency_by_range
    assert len(checks) > 1
    (shown,) = tables(distribution.build(run, judgement))
    assert [row[0] for row in shown.rows] == [words for words, _ in checks]
    assert [row[3] for row in shown.rows] == [check.verdict for _, check in checks]
