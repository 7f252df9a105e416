"""The true bench: what is wrong with its gantry is what was planted, at any speed, and the camera sees it so."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.devices.bench import Bench
from uvgs_bench.devices.cameras import open_camera
from uvgs_bench.devices.gantry.axes import Axis, gantry_from_carriage
from uvgs_bench.devices.sim.bench import SimulatedBench, live_benches, simulated_bench, start_simulated_bench
from uvgs_bench.devices.sim.truth import Occlusion, SimulatedTruth, TrueCamera, TrueGantry, TruePose
from uvgs_bench.errors import CaptureError, ConfigError
from uvgs_bench.geometry.se3 import rotation_angle
from uvgs_bench.store.beacons import read_beacon
from uvgs_bench.store.bench import read_bench
from uvgs_bench.units import ns_from_s

EXAMPLE = Path(__file__).parents[3] / "calib" / "bench.toml"
PERFECT = TrueGantry(scale_ppm=(0.0,), squareness_mrad=(0.0, 0.0, 0.0), backlash_mm=(0.0,), repeatability_mm=(0.0,))


@pytest.fixture(scope="module")
def file() -> Bench:
    return read_bench(EXAMPLE)


@pytest.fixture(scope="module")
def beacon(file: Bench) -> Beacon:
    return read_beacon(Path(file.beacon_file))


@pytest.fixture
def make(file: Bench, beacon: Beacon) -> Iterator:
    benches = []

    def start(gantry: TrueGantry = PERFECT, mount: str = "beacon_on_carriage", **kwargs: float) -> SimulatedBench:
        benches.append(SimulatedBench(SimulatedTruth(gantry=gantry), beacon, file.envelope.axes, mount, **kwargs))
        return benches[-1]

    yield start
    for bench in benches:
        bench.close()


def carriage_m(bench: SimulatedBench, *position_mm: float, direction: tuple[float, ...] = (0, 0, 0), stops: int = 0):
    return bench.carriage_at(np.array(position_mm) / 1000.0, np.array(direction, dtype=float), stops).t_m


def test_a_perfect_gantry_is_the_nominal_one(make, file: Bench) -> None:
    q = np.array([-0.1, -0.2, -0.3])
    pose = make().carriage_at(q, np.ones(3), 5)
    assert pose.is_close(gantry_from_carriage(file.envelope.axes, q), 1e-15, 1e-15)


def test_scale_is_in_parts_per_million_of_travel(make) -> None:
    bench = make(replace(PERFECT, scale_ppm=(100.0, -50.0)))
    # 0.3 m times 100 ppm; the last entry holds for Z too.
    assert carriage_m(bench, -300, -300, -300) == pytest.approx([-0.30003, -0.299985, -0.299985], abs=1e-12)


def test_squareness_is_the_missing_part_of_a_right_angle(make) -> None:
    bench = make(replace(PERFECT, squareness_mrad=(1.0, 2.0, -3.0)))
    x, y, z = (carriage_m(bench, *(100.0 * np.eye(3)[i])) for i in range(3))
    # Angles between the axes; products of two errors (6e-6) are left out.
    assert np.arccos(x @ y / 0.01) == pytest.approx(np.pi / 2 - 0.001, abs=1e-5)
    assert np.arccos(x @ z / 0.01) == pytest.approx(np.pi / 2 - 0.002, abs=1e-5)
    assert np.arccos(y @ z / 0.01) == pytest.approx(np.pi / 2 + 0.003, abs=1e-5)
    assert [np.linalg.norm(v) for v in (x, y, z)] == pytest.approx([0.1] * 3)


def test_backlash_is_the_difference_between_both_approaches(make) -> None:
    bench = make(replace(PERFECT, backlash_mm=(0.04, 0.0, 0.1)))
    up = carriage_m(bench, -100, -100, -100, direction=(1, 1, 1))
    down = carriage_m(bench, -100, -100, -100, direction=(-1, -1, -1))
    # The carriage lags behind: coming upwards it is lower.
    assert down - up == pytest.approx([40e-6, 0.0, 100e-6], abs=1e-12)


def test_repeatability_is_drawn_once_per_stop_with_its_spread(make) -> None:
    bench = make(replace(PERFECT, repeatability_mm=(0.01, 0.02, 0.0)))
    stops = np.array([carriage_m(bench, -100, -100, -100, stops=n) for n in range(2000)])
    assert np.array_equal(stops[7], carriage_m(bench, -100, -100, -100, stops=7))
    # 2000 draws know a spread to 1/sqrt(4000) = 1.6 %, and a mean to 0.45 um of 20; three times that.
    assert stops.std(axis=0) == pytest.approx([10e-6, 20e-6, 0.0], rel=0.048)
    assert stops.mean(axis=0) == pytest.approx([-0.1] * 3, abs=1.4e-6)


def test_rotary_axes_scale_their_angle_and_have_no_play(beacon: Beacon) -> None:
    turn = Axis("A", "rotary", np.array([0.0, 0.0, 1.0]), -3.0, 3.0, 1.0, 1.0)
    bench = SimulatedBench(
        SimulatedTruth(gantry=TrueGantry(scale_ppm=(1000.0,))), beacon, (turn,), "beacon_on_carriage"
    )
    pose = bench.carriage_at(np.array([0.5]), np.array([1.0]), 3)
    bench.close()
    assert rotation_angle(pose.R) == pytest.approx(0.5005, abs=1e-12)
    assert np.abs(pose.t_m).max() == 0.0


def run(bench: SimulatedBench, line: str, t_s: float) -> None:
    for byte in line.encode():
        bench.device.receive(byte, ns_from_s(t_s))


def moved(bench: SimulatedBench) -> SimulatedBench:
    """Home, then go 100 mm below zero on every axis, all in bench time, whatever the clock says."""
    bench.device.power_cycle(0)
    run(bench, "$H\n", 2.0)
    run(bench, "G53 G1 X-100 Y-100 Z-100 F3000\n", 200.0)
    return bench


def test_backlash_is_a_dead_band(make) -> None:
    """Reversing steps shorter than the play move nothing until they have taken it up together."""
    bench = make(replace(PERFECT, backlash_mm=(0.1,)))
    moved(bench)
    t_s, seen = 300.0, []
    for step_mm in (-0.2, 0.04, 0.04, 0.04, 0.04, -0.03, -0.03, -0.03, -0.03):
        run(bench, f"$J=G91X{step_mm}F600\n", t_s)
        t_s += 5.0
        seen.append(bench.true_gantry_from_carriage(ns_from_s(t_s)).t_m[0] * 1000.0)
    # mm; steps of 1/400 mm. Coming downwards the carriage stands half the play above its motor.
    assert seen == pytest.approx(
        [-100.15, -100.15, -100.15, -100.13, -100.09, -100.09, -100.09, -100.09, -100.11], abs=0.003
    )
    # The past is as it was, also when it is asked for later.
    assert bench.true_gantry_from_carriage(ns_from_s(310.0)).t_m[0] * 1000.0 == pytest.approx(seen[1], abs=1e-9)


def test_the_carriage_follows_the_controller_at_any_speed(make) -> None:
    slow, fast = (moved(make(TrueGantry(), speed=speed)) for speed in (1.0, 500.0))
    for t_s in (200.5, 201.0, 210.0):
        poses = [bench.true_camera_from_beacon(ns_from_s(t_s)) for bench in (slow, fast)]
        assert poses[0].is_close(poses[1], 1e-15, 1e-15)
    assert slow.true_axis_position(ns_from_s(210.0)) == pytest.approx([-0.1] * 3, abs=1e-9)
    # Scale 30 um, squareness 20 um, play 10 um, stops 10 um: some hundredths of a millimetre, never nothing.
    off_m = slow.true_gantry_from_carriage(ns_from_s(210.0)).t_m + 0.1
    assert 1e-6 < np.abs(off_m).max() < 1e-4


def test_lateral_and_depth_both_move(make) -> None:
    bench = moved(make())
    before, after = (bench.true_camera_from_beacon(ns_from_s(t_s)) for t_s in (199.0, 210.0))
    assert (np.abs(after.t_m - before.t_m) > 0.05).all()


def test_camera_on_carriage_moves_the_other_way(make) -> None:
    riding, standing = make(mount="camera_on_carriage"), make()
    for bench in (riding, standing):
        moved(bench)
    truth = riding.truth
    times = [ns_from_s(t_s) for t_s in (199.0, 210.0)]
    step_m = np.subtract(*[riding.true_gantry_from_carriage(t).t_m for t in reversed(times)])
    seen_m = np.subtract(*[riding.true_camera_from_beacon(t).t_m for t in reversed(times)])
    R_cs = truth.camera_from_gantry.pose("camera", "carriage").R
    assert seen_m == pytest.approx(-R_cs @ step_m, abs=1e-12)
    assert standing.true_camera_from_beacon(times[0]).source == riding.true_camera_from_beacon(times[0]).source


def test_the_beacon_is_in_view_over_the_whole_envelope(file: Bench, beacon: Beacon) -> None:
    bench = start_simulated_bench(file, beacon)
    for corner in itertools.product(*((axis.lower, axis.upper) for axis in file.envelope.axes)):
        carriage = bench.carriage_at(np.array(corner), np.zeros(3), 0)
        camera_from_beacon = bench.camera_from_beacon_at(carriage)
        px = bench.true_lens.project(camera_from_beacon.apply(beacon.positions_m))
        assert bench.true_lens.contains(px, margin_px=60.0).all(), corner
        for led in beacon.leds:
            to_camera = -camera_from_beacon.apply(led.position_m)
            cosine = camera_from_beacon.R @ led.axis @ to_camera / np.linalg.norm(to_camera)
            assert cosine > np.cos(np.radians(40.0))
        assert 0.6 < camera_from_beacon.t_m[2] < 1.3
    bench.close()


def with_truth(file: Bench, truth: SimulatedTruth) -> Bench:
    return replace(file, simulated=truth)


def test_led_offsets_are_planted(file: Bench, beacon: Beacon) -> None:
    name = beacon.led_names[1]
    bench = start_simulated_bench(with_truth(file, SimulatedTruth(led_offset_mm={name: (0.5, 0.0, -1.0)})), beacon)
    off_m = bench.true_beacon.positions_m - beacon.positions_m
    bench.close()
    assert off_m[1] == pytest.approx([0.0005, 0.0, -0.001], abs=1e-12)
    assert np.abs(np.delete(off_m, 1, axis=0)).max() == 0.0


@pytest.mark.parametrize(
    ("truth", "message"),
    [
        (SimulatedTruth(led_offset_mm={"nose": (1.0, 0.0, 0.0)}), "no LED 'nose', it has "),
        (SimulatedTruth(occlusion=Occlusion(leds=("nose",))), r"simulated\.occlusion\.leds: .* no LED 'nose'"),
        (SimulatedTruth(camera=TrueCamera(model="pinhole")), r"simulated\.camera: unknown lens model 'pinhole'"),
        (SimulatedTruth(camera=TrueCamera(parameters_px=(1.0, 2.0))), "has 9 parameters"),
    ],
)
def test_a_truth_that_does_not_fit_is_refused(file: Bench, beacon: Beacon, truth: SimulatedTruth, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        start_simulated_bench(with_truth(file, truth), beacon)


def test_euler_angles_are_yaw_pitch_roll() -> None:
    pose = TruePose((1.0, 2.0, 3.0), (90.0, 0.0, 90.0)).pose("camera", "gantry")
    assert pose.t_m == pytest.approx([0.001, 0.002, 0.003])
    # Rz(90) Rx(90): x goes to y, y goes to z after the roll and stays there, z goes to -y and then to x.
    assert np.abs(pose.R - [[0, 0, 1], [1, 0, 0], [0, 1, 0]]).max() < 1e-15


def test_benches_are_found_by_name_until_they_close(make) -> None:
    bench = make()
    assert simulated_bench(bench.name) is bench
    assert bench.name in live_benches()
    assert (bench.gantry_spec, bench.camera_spec) == (f"grbl:sim://{bench.name}", f"sim:{bench.name}")
    bench.close()
    bench.close()
    with pytest.raises(CaptureError, match="no simulated bench"):
        open_camera(bench.camera_spec)


def test_the_live_camera_sees_the_leds_where_they_truly_are(make) -> None:
    bench = make(speed=200.0)
    with open_camera(bench.camera_spec) as camera:
        before_ns = bench.clock.now_ns()
        first, second = camera.grab(), camera.grab()
        with pytest.raises(ConfigError, match="none is expected here"):
            open_camera(f"{bench.camera_spec}?count=3")
    assert camera.is_live
    assert camera.length is None
    assert before_ns < first.t_ns < second.t_ns
    px = bench.true_lens.project(bench.true_camera_from_beacon(first.t_ns).apply(bench.true_beacon.positions_m))
    for u, v in np.round(px).astype(int):
        assert first.image[v, u] > 100
    with pytest.raises(CaptureError, match="closed"):
        camera.grab()
