"""The pages of a measured and of a forecast beacon: the same figures three times, whatever names people give."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from tests.helpers.rendered import check_three_agree
from tests.helpers.synthetic_run import HOSTILE
from uvgs_bench.beacon.accuracy_map import AccuracyMap, Gain
from uvgs_bench.beacon.checks import BeaconWarning
from uvgs_bench.beacon.geometry import Beacon, Led
from uvgs_bench.beacon.measure_types import BeaconMeasurement, Distance, LedResiduals
from uvgs_bench.errors import ConfigError
from uvgs_bench.report.beacon_drawing import views_of
from uvgs_bench.report.beacon_evidence import ForecastEvidence, MeasurementEvidence
from uvgs_bench.report.beacon_page import build_forecast_document, build_measurement_document, write_beacon_picture
from uvgs_bench.report.document import Table
from uvgs_bench.report.html import render_html

PLACES = 1e-3 * np.array([[0.0, -50.0, 0.0], [50.0, 30.0, 0.0], [-50.0, 30.0, 5.0], [0.0, 0.0, -40.0]])
NAMES = ("top", HOSTILE, "left", "apex")


def beacon(covariance: bool = False) -> Beacon:
    axis = np.array([0.0, 0.0, -1.0])
    leds = tuple(Led(name, p, axis, 1.2, 0.005) for name, p in zip(NAMES, PLACES, strict=True))
    return Beacon(HOSTILE, leds, covariance_m2=np.diag(np.full(12, 4e-10)) if covariance else None)


def measurement(warnings: tuple[str, ...] = ()) -> BeaconMeasurement:
    rng = np.random.default_rng(4)
    distances = []
    for i, j in combinations(range(4), 2):
        meant = float(np.linalg.norm(PLACES[i] - PLACES[j]))
        hand = (meant + 4e-5, 5e-5) if (i, j) == (0, 1) else (None, None)
        distances.append(Distance(NAMES[i], NAMES[j], meant + 1e-4 * (i + 1), 1e-5 * (j + 1), meant, *hand))
    leds = []
    for k, name in enumerate(NAMES):
        # The last one has no axis: its view angles are unknown.
        angle = rng.uniform(0.0, 0.8, 0 if k == 3 else 24)
        widest = float(angle.max()) if len(angle) else float("nan")
        along = 0.1 * rng.standard_normal(len(angle))
        leds.append(LedResiduals(name, 24, k, 0.11, widest, 2e-5, 1e-5, 1e-4 * (k + 1), angle, along))
    return BeaconMeasurement(
        beacon(covariance=True), tuple(distances), tuple(leds), "free", "1 caliper distances", "best fit", 24, 0.102,
        43.0, 1.2e6, float("inf"), (("p3.png", "apex", 1.25), (HOSTILE, "left", 2.5)), warnings,
    )  # fmt: skip


def measured(warnings: tuple[str, ...] = ()) -> MeasurementEvidence:
    misses, notes = {"too_few_blobs": 2}, {"source": "images:pictures", "nominal": HOSTILE}
    return MeasurementEvidence(measurement(warnings), beacon(), "2026-01-02T03:04:05Z", 26, 24, misses, notes)


def forecast(is_safe: bool = True, warnings: tuple[BeaconWarning, ...] = ()) -> ForecastEvidence:
    rng = np.random.default_rng(5)
    shape = (3, 4, 6)
    values = [10.0 ** rng.uniform(-3.0, 0.0, shape) for _ in range(4)]
    for value in values:
        value[0] = np.nan  # nearer than the picture is wide
        value[2, 3] = np.nan
    values[0][1, 2, 3] = 0.0125
    ranges, tilts, azimuths = np.array([0.1, 1.0, 3.0]), np.linspace(0.0, 0.8, 4), np.linspace(0.0, 5.0, 6)
    diameter = 600.0 * 0.005 / ranges
    found = AccuracyMap(ranges, tilts, azimuths, *values, diameter)
    gains = (Gain("apex", "-z", 0.88, 0.95, 1.5), Gain(HOSTILE, "+x", 1.01, 0.99, 0.5))
    lines = ("worst position ± 12.50 mm", "LEDs merge in 2 % of the views")
    return ForecastEvidence(beacon(), found, gains, 0.1, 0.01, lines, is_safe, warnings, {"camera": "c"})


def test_a_measured_beacon_is_the_same_in_page_pdf_and_json():
    evidence = measured()
    document = build_measurement_document(evidence)
    data = check_three_agree(document)
    assert [s["key"] for s in data["sections"]] == ["distances", "leds", "angles", "pictures", "definitions"]
    assert data["verdict"]["shown"] == "measured"
    shown = {figure["label"]: figure["number"]["value"] for figure in data["key_figures"]}
    assert shown["Its deviation, 1 sigma"] == pytest.approx(0.04)
    assert shown["Farthest off nominal"] == pytest.approx(0.4)
    # Three LEDs state an axis and have a drawing each.
    assert sum(figure.key.startswith("angle-") for figure in document.figures()) == 3
    assert render_html(build_measurement_document(measured())) == render_html(document)


def test_sightings_set_aside_come_worst_first_and_warnings_colour_the_verdict():
    document = build_measurement_document(measured(("the squares may be declared wrong",)))
    assert document.verdict == "inconclusive"
    assert document.banners[0].text == "the squares may be declared wrong"
    pictures = next(s for s in document.sections if s.key == "pictures")
    listed = [block for block in pictures.blocks if isinstance(block, Table)][1]
    assert [row[1] for row in listed.rows] == ["left", "apex"]


def test_without_axes_the_angles_are_said_to_be_unknown():
    bare = measurement()
    leds = tuple(replace(led, angle_rad=np.empty(0), along_axis_px=np.empty(0)) for led in bare.leds)
    evidence = replace(measured(), measurement=replace(bare, leds=leds))
    document = build_measurement_document(evidence)
    assert "states its axis" in render_html(document)


def test_a_forecast_is_the_same_in_page_pdf_and_json():
    document = build_forecast_document(forecast())
    data = check_three_agree(document)
    assert data["verdict"]["shown"] == "sound"
    assert data["created_utc"] == ""
    margin = next(f for f in document.figures() if f.key == "forecast-margin")
    found = forecast().found
    np.testing.assert_array_equal(margin.series[1].values, np.nanmin(found.margin_px[1], axis=1))
    assert np.isnan(margin.series[0].values).all()


@pytest.mark.parametrize(
    ("is_safe", "weak", "state"), [(True, False, "pass"), (False, False, "inconclusive"), (True, True, "fail")]
)
def test_the_verdict_of_a_forecast_follows_its_findings(monkeypatch, is_safe, weak, state):
    monkeypatch.setattr("uvgs_bench.report.beacon_page.FORECAST_SECTIONS", {})
    warnings = (BeaconWarning("coplanar", 1e-3, 1e-2, "the LEDs lie in a plane"),) if weak else ()
    document = build_forecast_document(forecast(is_safe, warnings))
    assert document.verdict == state
    assert ("lie in a plane" in document.headline) == weak


def test_a_picture_of_a_beacon_is_refused_with_a_foreign_ending(tmp_path):
    write_beacon_picture(tmp_path / "b.svg", beacon())
    assert "<svg" in (tmp_path / "b.svg").read_text()
    with pytest.raises(ConfigError, match=r"expected a \.png"):
        write_beacon_picture(tmp_path / "b.jpg", beacon())


def test_a_frame_whose_leds_shine_along_plus_z_is_drawn_from_behind_and_said_so():
    ahead = beacon()
    turned = Beacon(
        "turned",
        tuple(replace(led, position_m=led.position_m * [1, -1, -1], axis=-led.axis) for led in ahead.leds),  # type: ignore[operator]
    )
    assert "as the camera sees it" in views_of(ahead)[0][2]
    assert "from behind" in views_of(turned)[0][2]
    bare = Beacon("bare", tuple(replace(led, axis=None, half_angle_rad=None) for led in ahead.leds))
    assert views_of(bare)[0][2] == "along its z axis"
