"""What is known of a gantry, on disk and applied to the axes of a bench."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from uvgs_bench.devices.bench import UNJUDGED
from uvgs_bench.devices.gantry import Axis, gantry_from_carriage
from uvgs_bench.errors import ConfigError
from uvgs_bench.store.bench import read_bench
from uvgs_bench.store.gantry_records import (
    AxisRecord,
    GantryRecord,
    PairRecord,
    axis_term_covariance,
    measured_axes,
    read_gantry_record,
    write_gantry_record,
)

ROOT = Path(__file__).parents[3]
UNIT = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}
RECORD = GantryRecord(
    "bench",
    "2026-01-01T00:00:00.000Z",
    "camera with board b, 2026-01-01",
    tuple(AxisRecord(n, UNIT[n], scale_ppm=s, scale_sigma_ppm=5.0) for n, s in [("X", 1000), ("Y", -500), ("Z", 0)]),
    (
        PairRecord(("X", "Y"), 1.0, 0.1),
        PairRecord(("X", "Z"), 0.0, 0.1),
        PairRecord(("Y", "Z"), -2.0, 0.1),
    ),
    tuple(tuple(float(i == j) for j in range(6)) for i in range(6)),
    ("a remark",),
)  # fmt: skip
AXES = tuple(Axis(n, "linear", np.array(d), -0.3, 0.0, 0.05, 0.2) for n, d in UNIT.items())


def test_what_is_written_reads_back(tmp_path: Path) -> None:
    write_gantry_record(tmp_path / "g.toml", RECORD)
    assert read_gantry_record(tmp_path / "g.toml") == RECORD
    with pytest.raises(ConfigError, match="exists"):
        write_gantry_record(tmp_path / "g.toml", RECORD)


def test_scale_and_squareness_move_the_carriage() -> None:
    axes = measured_axes(RECORD, AXES, "g.toml")
    # m: X is too long by 1000 ppm; Y leans 1 mrad towards X and is too short by 500 ppm.
    np.testing.assert_allclose(gantry_from_carriage(axes, [-0.2, 0, 0]).t_m, [-0.2002, 0, 0], atol=1e-12)
    np.testing.assert_allclose(gantry_from_carriage(axes, [0, -0.2, 0]).t_m, [-0.0002, -0.1999, 0], atol=2e-7)
    np.testing.assert_allclose(gantry_from_carriage(axes, [0, 0, -0.2]).t_m, [0, 0.0004, -0.2], atol=5e-7)
    assert [axis.lower for axis in axes] == [axis.lower for axis in AXES]


def test_a_record_of_other_axes_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"g\.toml: axes: is of the axes X Y Z, the bench has X Y"):
        measured_axes(RECORD, AXES[:2], "g.toml")
    turned = (AXES[0], AXES[2], AXES[1])
    with pytest.raises(ConfigError, match="the bench has X Z Y"):
        measured_axes(RECORD, turned, "g.toml")
    leaned = (Axis("X", "linear", np.array([1.0, 0.1, 0.0]), -0.3, 0.0, 0.05, 0.2), *AXES[1:])
    with pytest.raises(ConfigError, match="axis X was declared with another direction"):
        measured_axes(RECORD, leaned, "g.toml")
    half = GantryRecord("b", "", "", RECORD.axes, RECORD.pairs[:2])
    with pytest.raises(ConfigError, match="squareness of every pair, or none"):
        measured_axes(half, AXES, "g.toml")


def test_without_scale_and_squareness_the_axes_stay() -> None:
    bare = GantryRecord("b", "", "", tuple(AxisRecord(n, d, backlash_mm=0.1) for n, d in UNIT.items()))
    assert measured_axes(bare, AXES, "g.toml") == AXES


def test_a_bench_file_names_it(tmp_path: Path) -> None:
    text = (ROOT / "calib" / "bench.toml").read_text(encoding="utf-8")
    (tmp_path / "bench.toml").write_text(text, encoding="utf-8")
    bench = read_bench(tmp_path / "bench.toml")
    assert (bench.judged_by, bench.gantry_file) == (UNJUDGED, None)
    assert bench.nominal_axes == bench.envelope.axes
    (tmp_path / "bench.toml").write_text(text.replace("[gantry]", '[gantry]\ncalibration = "g.toml"'), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"g\.toml"):
        read_bench(tmp_path / "bench.toml")
    write_gantry_record(tmp_path / "g.toml", RECORD)
    bench = read_bench(tmp_path / "bench.toml")
    assert bench.judged_by == RECORD.judged_by
    assert bench.envelope.axes[0].scale == pytest.approx(1.001)
    assert bench.nominal_axes[0].scale == 1.0


def covariance_of(directions: list[tuple[float, float, float]], covariance: np.ndarray) -> np.ndarray | None:
    axes = tuple(AxisRecord(name, d) for name, d in zip("XYZ", directions, strict=False))
    rows = tuple(tuple(float(v) for v in row) for row in covariance)
    return axis_term_covariance(GantryRecord("bench", "", "", axes, covariance=rows))


def test_doubts_of_axes_become_doubts_of_terms() -> None:
    each = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-8
    usual = covariance_of([UNIT[n] for n in "XYZ"], each)
    assert usual is not None
    # Of the second order in the step of the derivative.
    np.testing.assert_allclose(usual, each, atol=1e-13)
    # X points along gantry y and Y along gantry -x: scales change places, a lean of either towards the other is one.
    swapped = covariance_of([UNIT["Y"], (-1.0, 0.0, 0.0), UNIT["Z"]], each)
    assert swapped is not None
    np.testing.assert_allclose(np.diag(swapped), np.array([2.0, 1.0, 3.0, 4.0, 6.0, 5.0]) * 1e-8, atol=1e-13)
    two = covariance_of([UNIT["X"], UNIT["Z"]], np.diag([1.0, 2.0, 3.0]) * 1e-8)
    assert two is not None
    np.testing.assert_allclose(np.diag(two), np.array([1.0, 0.0, 2.0, 0.0, 3.0, 0.0]) * 1e-8, atol=1e-13)
    assert covariance_of([UNIT[n] for n in "XYZ"], np.zeros((0, 0))) is None
