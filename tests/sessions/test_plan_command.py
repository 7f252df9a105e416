"""``uvgs plan``: a procedure that gantry-sweep accepts, an honest refusal, and one line for wrong input."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import uvgs_bench.cli.app as cli
from tests.helpers.planted_bench import planted_observations
from tests.helpers.synthetic_run import synthetic_run, write_run
from uvgs_bench.accuracy import fit_registration
from uvgs_bench.accuracy.blind_bench import BlindBench, observe, standard_stations
from uvgs_bench.camera import Calibration, Lens
from uvgs_bench.devices.bench import Bench
from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import Pose
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.sessions import plan_advice
from uvgs_bench.sessions.planning import plan
from uvgs_bench.sessions.procedure import read_procedure
from uvgs_bench.store.beacons import read_beacon
from uvgs_bench.store.bench import read_bench
from uvgs_bench.store.calibrations import write_calibration
from uvgs_bench.store.registrations import read_registered_poses, write_registration
from uvgs_bench.store.run import Run, Sample

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The shipped bench with the camera it truly has; short ladders, since the search itself is what is tested."""
    text = (ROOT / "calib" / "bench.toml").read_text(encoding="utf-8")
    path = tmp_path / "calib" / "bench.toml"
    path.parent.mkdir()
    path.write_text(text.replace("beacons/tetra_small.toml", str(ROOT / "calib/beacons/tetra_small.toml")))
    camera = SimulatedTruth().camera
    lens = Lens(camera.model, camera.width_px, camera.height_px, np.array(camera.parameters_px))
    (path.parent / "cameras").mkdir()
    write_calibration(path.parent / "cameras/simulated.yaml", Calibration(lens, "simulated"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "COMMANDS", {"plan": cli.COMMANDS["plan"], "doctor": cli.COMMANDS["doctor"]})
    monkeypatch.setattr(plan_advice, "_PLACES", (18, 36))
    monkeypatch.setattr(plan_advice, "_LOOKED_AT", 400)
    monkeypatch.setattr(plan_advice, "_TRIALS", 2)
    monkeypatch.setattr(plan_advice, "_CONFIRMATIONS", 3)
    return path


def left_with(arguments: list[str]) -> int:
    with pytest.raises(SystemExit) as left:
        cli.main(["plan", *arguments])
    return int(str(left.value.code))


def test_a_proposed_procedure_is_accepted_by_the_bench(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "planned.toml"
    assert left_with(["--half-width", "0.4", "--out", str(out), "--json", "--quiet"]) == 0
    said = json.loads(capsys.readouterr().out)
    found = plan(read_procedure(out), read_bench(bench).envelope)
    assert (found.waypoint_count, len(found.stations), found.capture_count) == (
        said["places"],
        said["stations"],
        said["captures"],
    )
    assert found.register_waypoint_count == said["register_places"] == said["places"] // 3
    assert found.duration_s == pytest.approx(said["duration_s"], rel=1e-12)
    assert said["expected_half_width_worst_tenth"] <= 0.4
    assert said["expected_availability"] > 0.9
    again = tmp_path / "again.toml"
    assert left_with(["--half-width", "0.4", "--out", str(again), "--json", "--quiet"]) == 0
    assert again.read_text() == out.read_text(), "the same seed proposes the same"


def test_a_narrower_interval_takes_longer(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    durations = []
    for width in ("0.6", "0.17"):
        assert left_with(["--half-width", width, "--json", "--quiet"]) == 0
        durations.append(json.loads(capsys.readouterr().out)["duration_s"])
    assert durations[0] < durations[1]


def test_what_cannot_be_had_is_refused(bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "none.toml"
    assert left_with(["--half-width", "0.001", "--out", str(out), "--quiet"]) == 3
    said = " ".join(capsys.readouterr().err.split())
    assert "cannot be had with up to 36 places: the best of these procedures gives" in said
    assert not out.exists()


def test_a_camera_that_looks_away_is_refused(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench.write_text(bench.read_text().replace("[196.0, -151.0, 1066.0]", "[196.0, -151.0, -1066.0]"))
    assert left_with(["--half-width", "0.4", "--quiet"]) == 3
    assert "the camera sees all LEDs in 0.0 % of what the gantry reaches" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--half-width", "0"], 2, "--half-width: must be finite and positive"),
        (["--half-width", "nan"], 2, "--half-width: must be finite and positive"),
        (["--half-width", "0.1", "--quantity", "position"], 2, "--quantity: must be one of position_rms_mm"),
        (["--half-width", "0.1", "--noise-px", "-1"], 2, "--noise-px: must be finite and positive"),
        (["--half-width", "0.1", "--registration", "none.toml"], 4, "none.toml"),
        ([], 2, "--half-width"),
    ],
)
def test_wrong_input_is_one_line(
    bench: Path, arguments: list[str], code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert left_with(arguments) == code
    assert said in " ".join(capsys.readouterr().err.split())


def test_a_real_bench_needs_its_registration(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench.write_text(bench.read_text().replace('"grbl:sim://"', '"grbl:/dev/ttyACM0"').replace('"sim:"', '"uvc:0"'))
    assert left_with(["--half-width", "0.1"]) == 2
    assert "--registration: where the camera stands is not known" in " ".join(capsys.readouterr().err.split())


def test_poses_of_a_registration_come_back(tmp_path: Path) -> None:
    found = fit_registration(planted_observations("3T", 12, 1, np.random.default_rng(1)))
    path = tmp_path / "registration.toml"
    write_registration(path, found, "a run")
    left, right = read_registered_poses(path, found.mount)
    # Written to the last bit as mm and quaternions: two roundings.
    assert left.is_close(found.left, 1e-14, 1e-14)
    assert right.is_close(found.right, 1e-14, 1e-14)
    with pytest.raises(ConfigError, match="mount: is 'beacon_on_carriage', this bench has 'camera_on_carriage'"):
        read_registered_poses(path, "camera_on_carriage")
    path.write_text(path.read_text().replace("quaternion_xyzw", "quaternion"))
    with pytest.raises(ConfigError, match=r"left\.quaternion_xyzw: this key is required"):
        read_registered_poses(path, found.mount)


def test_a_first_run_teaches_noise_and_registration(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(3)
    setup = read_bench(bench)
    assert setup.simulated is not None
    camera = SimulatedTruth().camera
    lens = Lens(camera.model, camera.width_px, camera.height_px, np.array(camera.parameters_px))
    run = write_run(blind_run(setup, lens, rng, (0.12, 0.05)), tmp_path / "first")
    assert left_with(["--half-width", "2", "--from", str(run), "--json", "--quiet"]) == 0
    said = json.loads(capsys.readouterr().out)
    # 40 captures about 20 places know the first to a tenth, 20 places the second to a quarter.
    np.testing.assert_allclose(said["centroid_sigma_px"], 0.12, rtol=0.3)
    np.testing.assert_allclose(said["place_sigma_px"], 0.05, rtol=0.75)
    assert said["noise_source"].startswith("learned from 20 stations of ")
    # What is given is taken.
    assert left_with(["--half-width", "2", "--from", str(run), "--noise-px", "0.07", "--json", "--quiet"]) == 0
    assert json.loads(capsys.readouterr().out)["centroid_sigma_px"] == 0.07


def test_a_run_of_the_other_mount_teaches_nothing(bench: Path, tmp_path: Path) -> None:
    other = synthetic_run()
    other = replace(other, manifest=replace(other.manifest, mount="camera_on_carriage"))
    path = write_run(other, tmp_path / "other")
    assert left_with(["--half-width", "2", "--from", str(path), "--quiet"]) == 4


def blind_run(setup: Bench, lens: Lens, rng: np.random.Generator, sigmas_px: tuple[float, float]) -> Run:
    """A run as a bench with known noise gives it, three captures at each of twenty places."""
    beacon = read_beacon(Path(setup.beacon_file))
    assert setup.simulated is not None
    poses = (
        setup.simulated.camera_from_gantry.pose("camera", "gantry"),
        setup.simulated.carriage_from_beacon.pose("carriage", "beacon"),
    )
    axes = setup.envelope.axes
    middle = np.array([0.5 * (axis.lower + axis.upper) for axis in axes])
    stations = standard_stations(rng, places=20, revisits=0, moving=0, shots=3, half_m=(0.08, 0.08, 0.08))
    moved = replace(stations, position_m=stations.position_m + middle)
    truth = BlindBench(
        lens, beacon.positions_m, poses[0], poses[1], centroid_sigma_px=sigmas_px[0], place_sigma_px=sigmas_px[1]
    )
    obs = observe(truth, moved, rng)
    assert obs.is_solved.all()
    samples = []
    for i in range(obs.count):
        pose = PoseEstimate(
            Pose(obs.R_cb[i], obs.t_cb_m[i], "camera", "beacon"), obs.covariance[i], int(obs.t_ns[i]), beacon.name,
            obs.led_px[i], np.zeros((4, 2)), 0.1, np.inf, 4,
        )  # fmt: skip
        station = int(obs.station[i])
        samples.append(
            Sample(
                i, station, int(obs.place[i]), 0, i % 3, obs.role[i], int(obs.t_ns[i]), obs.axis_position[i],
                obs.axis_position[i], pose,
            )
        )  # fmt: skip
    run = synthetic_run()
    manifest = replace(run.manifest, axes=axes, mount=setup.mount, station_count=20, gantry_sigma_m=1e-5)
    return replace(run, manifest=manifest, samples=tuple(samples), beacon=beacon, calibration=Calibration(lens, "x"))
