"""Registering by pictures of a board on the simulated carriage, and the terms of a registration in files and words."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from uvgs_bench.accuracy import judge
from uvgs_bench.camera.boards import Board
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.cli.app import build_app
from uvgs_bench.devices.clock import SteppedClock
from uvgs_bench.devices.gantry import open_gantry
from uvgs_bench.devices.sim.bench import start_simulated_bench, true_lens
from uvgs_bench.devices.sim.carried_board import CarriedBoard
from uvgs_bench.geometry.se3 import euler_zyx_from_rotation
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.outcome import Miss, Outcome, PoseEstimate
from uvgs_bench.sessions.bench_setup import read_setup, sweep
from uvgs_bench.sessions.register import board_observations
from uvgs_bench.sessions.sweep import Rig, run_sweep
from uvgs_bench.store.bench import read_bench
from uvgs_bench.store.calibrations import write_calibration
from uvgs_bench.store.run import RunWriter, read_run
from uvgs_bench.units import deg_from_rad, mm_from_m

pytestmark = pytest.mark.opencv

ROOT = Path(__file__).parents[2]
BENCH = ROOT / "calib" / "bench.toml"
BOARD = Board("charuco_9x6", "charuco", 9, 6, 0.03, 0.022, "DICT_5X5_100")
BOARD_FILE = """
schema = 1
name = "charuco_9x6"
kind = "charuco"
columns = 9
rows = 6
square_mm = 30.0
marker_mm = 22.0
dictionary = "DICT_5X5_100"
"""
PROCEDURE = """
schema = 1
name = "{name}"
pattern = "grid"
origin = "centre"
feed_mm_min = 3000.0
captures_per_station = 1
seed = 3
[grid]
lower = {{ X_mm = -70.0, Y_mm = -70.0, Z_mm = -70.0 }}
upper = {{ X_mm = 70.0, Y_mm = 70.0, Z_mm = 70.0 }}
counts = {{ X = {count}, Y = 2, Z = 2 }}
[approach]
kind = "from_below"
"""


class Blind:
    """A sensor that sees no beacon, since a board hangs before it."""

    def solve(self, capture: Capture, prior: PoseEstimate | None = None) -> Outcome:
        return Miss("selection", "too_few_blobs", "a board is there", capture.t_ns, "tetra_small")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of the beacon, a run of the board in its stead, a board file and a link file."""
    folder = tmp_path_factory.mktemp("board")
    simulated = read_bench(BENCH).simulated
    assert simulated is not None
    write_calibration(folder / "camera.yaml", Calibration(true_lens(simulated), "simulated"))
    (folder / "board.toml").write_text(BOARD_FILE)
    for name, count in (("judged", 4), ("by_board", 2)):
        (folder / f"{name}.toml").write_text(PROCEDURE.format(name=name, count=count))
    set_up = read_setup(folder / "judged.toml", BENCH, camera=folder / "camera.yaml")
    judged = sweep(set_up, folder, simulated_speed=400.0).path
    judged.rename(folder / "judged")
    seen = read_setup(folder / "by_board.toml", BENCH, camera=folder / "camera.yaml")
    clock = SteppedClock()
    twin = start_simulated_bench(seen.bench, seen.beacon, clock=clock)
    try:
        camera = CarriedBoard(twin, BOARD)
        manifest = replace(
            read_run(folder / "judged").manifest, id="by_board", procedure_name="by_board",
            plan_hash=seen.plan.plan_hash, station_count=len(seen.plan.stations),
        )  # fmt: skip
        writer = RunWriter.create(folder / "by_board", manifest, seen.files)
        with open_gantry(twin.gantry_spec, seen.bench.envelope, clock=clock, log=lambda *_: None) as gantry:
            run_sweep(seen.plan, Rig(gantry, camera, Blind(), clock), writer)
        link = camera._beacon_from_board.inverse()
    finally:
        twin.close()
    angles = [deg_from_rad(angle) for angle in euler_zyx_from_rotation(link.R)]
    (folder / "link.toml").write_text(
        'schema = 1\nboard = "charuco_9x6"\nbeacon = "tetra_small"\n'
        f"position_mm = {mm_from_m(link.t_m).tolist()}\neuler_zyx_deg = {angles}\n"
        "sigma_position_mm = [0.03, 0.03, 0.03]\nsigma_rotation_deg = [0.01, 0.01, 0.01]\n"
        'source = "the simulated bench itself"\n'
    )
    return folder


def asked(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(build_app(), ["register", *map(str, arguments)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


def by_board(files: Path) -> list[object]:
    given = [files / "judged", "--board", files / "board.toml", "--link", files / "link.toml"]
    return [*given, "--board-run", files / "by_board"]


def test_a_board_makes_the_truth_of_the_sensor_observable(files: Path) -> None:
    code, out, _ = asked(*by_board(files), "--json")
    assert code == 0
    said = json.loads(out)
    assert said["in_sample"] is None
    assert said["held_out"]["stations"] == 16
    assert said["split"] == "registered by a board on 8 places, judged on all 16 stations"
    names = ["camera_from_gantry and carriage_from_board", "gantry_from_carriage", "board_from_beacon"]
    assert [link["name"] for link in said["links"]] == names
    # Lens and beacon are true, so the absolute error is that of noise and chain: below a millimetre at 1 m.
    assert said["held_out"]["position_rms_mm"][0] < 1.0


def test_a_link_that_is_wrong_shows(files: Path) -> None:
    text = (files / "link.toml").read_text()
    x_mm = float(text.split("position_mm = [")[1].split(",")[0])
    (files / "wrong.toml").write_text(text.replace(f"[{x_mm}", f"[{x_mm + 5.0}", 1))
    given = [files / "wrong.toml" if argument == files / "link.toml" else argument for argument in by_board(files)]
    said = json.loads(asked(*given, "--json")[1])
    # The whole of it, to what the right link leaves.
    np.testing.assert_allclose(said["held_out"]["position_rms_mm"][0], 5.0, atol=1.0)


def test_board_poses_are_where_the_board_was(files: Path) -> None:
    obs = board_observations(read_run(files / "by_board"), BOARD)
    assert obs.is_solved.all()
    assert obs.count == 8
    # The tilt of a small board seen nearly from the front, at 1 m, is the worst known of all.
    sigma = np.sqrt(np.diagonal(obs.covariance, axis1=1, axis2=2))
    assert sigma[:, :3].max() < 5e-3
    judged = judge(obs, (), np.random.default_rng(1))
    assert judged.registration is not None


def test_words_name_the_chain(files: Path) -> None:
    code, out, _ = asked(*by_board(files))
    assert code == 0
    assert "link board_from_beacon: " in out
    assert "the simulated bench itself" in " ".join(out.split())


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (["--board", "board.toml"], "--link"),
        (["--link", "link.toml"], "--board"),
        (["--board", "board.toml", "--link", "board.toml"], "unknown key"),
        (["--board", "board.toml", "--link", "link.toml"], "shows the board charuco_9x6"),
    ],
)
def test_half_of_a_chain_is_refused_in_one_line(files: Path, given: list[str], expected: str) -> None:
    options = [files / value if value.endswith(".toml") else value for value in given]
    try:
        code, out, err = asked(files / "judged", *options)
    except Exception as error:
        code, out, err = 2, "", str(error)
    assert code != 0
    assert expected in out + err


def test_terms_are_written_and_read_back(files: Path) -> None:
    from uvgs_bench.store.registrations import read_registered_terms

    target = files / "registration.toml"
    code, out, _ = asked(files / "judged", "--terms", "axis_scale", "--terms", "time_offset", "--out", target)
    assert code == 0
    assert "time offset: not fitted, no capture was taken in motion" in " ".join(out.split())
    assert read_registered_terms(target).values.shape == (8,)
