"""The forecast of a beacon against simulated poses, and its advice through the command."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.beacon import Beacon, Led
from uvgs_bench.beacon.accuracy_map import accuracy_map, gains, relabelings
from uvgs_bench.cli.app import main
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.se3 import so3_exp, so3_log
from uvgs_bench.sensor.batch import solve_batch
from uvgs_bench.store.beacons import write_beacon
from uvgs_bench.store.calibrations import write_calibration

LENS = spots.lens()
SIGMA_PX = 0.05
RANGES, TILTS, AZIMUTHS = np.array([0.6, 1.2]), np.radians([0.0, 35.0]), np.radians([0.0, 120.0, 240.0])


def fit(points_m: FloatArray, px: FloatArray) -> FloatArray:
    return solve_batch(LENS, points_m, px, np.ones(len(points_m))).chi2


def test_forecast_deviations_are_those_of_solved_poses():
    beacon = spots.beacon()
    found = accuracy_map(beacon, LENS, fit, SIGMA_PX, RANGES, TILTS, AZIMUTHS)
    rng = np.random.default_rng(4)
    for at in ((0, 0, 0), (0, 1, 1), (1, 1, 2)):
        k, i, j = at
        R = so3_exp(np.array([np.cos(AZIMUTHS[j]), np.sin(AZIMUTHS[j]), 0.0]) * TILTS[i])
        t = LENS.unproject(np.array([[640.0, 480.0]]))[0] * RANGES[k]
        px = LENS.project(beacon.positions_m @ R.T + t)
        count = 1500
        noisy = px + rng.normal(0.0, SIGMA_PX, (count, *px.shape))
        starts = np.repeat(R[None], count, axis=0), np.repeat(t[None], count, axis=0)
        solved = solve_batch(LENS, beacon.positions_m, noisy, np.ones(4), starts)
        shift = float(np.sqrt(np.mean(((solved.t_cb_m - t) ** 2).sum(axis=1))))
        turn = float(np.sqrt(np.mean([(so3_log(np.ascontiguousarray(Q @ R.T)) ** 2).sum() for Q in solved.R_cb])))
        # 1500 draws know a deviation to 2 to 3 %; curvature adds as much where depth is weak.
        assert found.position_sigma_m[at] == pytest.approx(shift, rel=0.1)
        assert found.attitude_sigma_rad[at] == pytest.approx(turn, rel=0.1)


def test_a_symmetric_beacon_has_no_margin_and_a_clear_one_has():
    regular = 0.05 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    symmetric = Beacon("s", tuple(Led(f"l{i}", p) for i, p in enumerate(regular)))
    where = (LENS, fit, SIGMA_PX, RANGES[:1], TILTS, AZIMUTHS)
    # A rotation of the solid exchanges its LEDs: another pose fits to the rounding of the solver.
    assert np.nanmax(accuracy_map(symmetric, *where).margin_px) < 1e-3
    assert np.nanmin(accuracy_map(spots.beacon(), *where).margin_px) > 0.2


def test_what_is_not_seen_is_not_forecast():
    beacon = Beacon("b", tuple(replace(led, diameter_m=0.005) for led in spots.beacon().leds))
    found = accuracy_map(beacon, LENS, fit, SIGMA_PX, np.array([0.05, 0.6]), np.radians([0.0, 80.0]), AZIMUTHS)
    assert np.isnan(found.position_sigma_m[0]).all()  # larger than the picture
    assert np.isnan(found.margin_px[1, 1]).all()  # beyond the half angle of 70 degrees
    assert np.isfinite(found.margin_px[1, 0]).all()
    np.testing.assert_allclose(found.diameter_px, LENS.fx_px * 0.005 / np.array([0.05, 0.6]))


def test_a_higher_apex_improves_the_attitude_from_the_front():
    found = accuracy_map(spots.beacon(), LENS, fit, SIGMA_PX, RANGES[:1], TILTS[:1], AZIMUTHS[:1])
    moves = gains(spots.beacon(), LENS, fit, SIGMA_PX, found, 0, 0.01)
    assert len(moves) == 24
    by_name = {(move.led, move.direction): move.attitude_ratio for move in moves}
    assert by_name["led3", "-z"] < 0.97 < 1.03 < by_name["led3", "+z"]
    assert [move.attitude_ratio for move in moves] == sorted(by_name.values())


def test_relabelings_never_contain_the_right_one():
    assert len(relabelings(4)) == 23
    assert [0, 1, 2, 3] not in relabelings(4)
    assert len(relabelings(7)) == 21


def test_the_command_forecasts_and_draws(tmp_path, capfd):
    write_calibration(tmp_path / "camera.yaml", spots.calibration())
    write_beacon(tmp_path / "beacon.toml", spots.beacon())

    def uvgs(*words: object) -> int:
        with pytest.raises(SystemExit) as caught:
            main(["beacon", *(str(word) for word in words)])
        return int(caught.value.code or 0)

    page, picture = tmp_path / "page", tmp_path / "picture.png"
    uvgs("check", tmp_path / "beacon.toml", "--camera", tmp_path / "camera.yaml", "--report", page, "--json")
    record = json.loads(capfd.readouterr().out)
    assert np.array(record["position_sigma_mm"]).shape == (6, 7, 12)
    assert record["findings"][0].startswith("worst position ±")
    shown = json.loads((page / "report.json").read_text(encoding="utf-8"))
    worst_mm = next(f["number"]["value"] for f in shown["key_figures"] if f["label"] == "Position, worst view")
    assert worst_mm == pytest.approx(np.nanmax(np.array(record["position_sigma_mm"], dtype=float)))
    assert uvgs("show", tmp_path / "beacon.toml", "--picture", picture) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert uvgs("show", tmp_path / "beacon.toml", "--picture", picture) == 2
    assert "exists already" in capfd.readouterr().err
    assert uvgs("check", tmp_path / "beacon.toml", "--report", page) == 2
    assert "--report: needs --camera" in capfd.readouterr().err
