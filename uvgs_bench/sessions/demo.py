"""The whole job once, on the simulated bench: calibrate, home, sweep, solve, register, judge."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uvgs_bench.accuracy import Judgement
from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.devices.bench import Bench
from uvgs_bench.devices.cameras.registry import open_camera
from uvgs_bench.devices.cameras.source import CameraSource
from uvgs_bench.devices.sim.bench import SimulatedBench, gantry_from_carriage_true, start_simulated_bench, true_axes
from uvgs_bench.devices.sim.board_views import SimulatedBoardSource
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry.se3 import rotation_angle
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.sessions.bench_setup import read_setup, sweep
from uvgs_bench.sessions.calibrate import calibrate_from_source
from uvgs_bench.sessions.events import EventSink, ignore_events
from uvgs_bench.store.beacons import read_beacon
from uvgs_bench.store.bench import read_bench
from uvgs_bench.store.boards import read_board
from uvgs_bench.store.calibrations import write_calibration
from uvgs_bench.store.documents import read_toml, write_atomically
from uvgs_bench.store.judging import judge_run
from uvgs_bench.store.run import Run, read_run
from uvgs_bench.store.toml_text import toml_text
from uvgs_bench.store.workspace import examples_folder

BENCH = Path("calib/bench.toml")
BOARD = Path("calib/boards/charuco_9x6.toml")
PROCEDURE = Path("procedures/demo_grid.toml")
VIEW_COUNT = 24


@dataclass(frozen=True, slots=True)
class AgainstTruth:
    """The sensor against what the simulated bench knows, without any registration.

    The truth leaves out the carriage's stopping error and backlash, about 0.02 mm on the shipped bench.

    Args:
        position_rms_m: Root mean square distance of measured and true position, m.
        position_bias_m: Length of the mean position error, m.
        attitude_rms_rad: Root mean square angle between measured and true attitude, rad.
        focal_error_px: Calibrated minus true focal length, x, px.
        count: Number of poses compared.
    """

    position_rms_m: float
    position_bias_m: float
    attitude_rms_rad: float
    focal_error_px: float
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class DemoResult:
    """What the demonstration leaves.

    Args:
        run: The run as read back from disk.
        judgement: Its judgement.
        calibration_file: The calibration it made.
        truth: The sensor against the simulated truth, or None when no capture gave a pose.
    """

    run: Run
    judgement: Judgement
    calibration_file: Path
    truth: AgainstTruth | None


@dataclass(frozen=True, slots=True, eq=False)
class DemoBench:
    """The shipped simulated bench, running.

    Args:
        twin: The simulated bench.
        beacon: Its beacon as the file says.
        nominal_calibration: The true lens without any doubt; for warming up only.
    """

    twin: SimulatedBench
    beacon: Beacon
    nominal_calibration: Calibration

    def open_camera(self) -> CameraSource:
        """The simulated camera; the caller closes it."""
        return open_camera(self.twin.camera_spec, clock=self.twin.clock)


@contextmanager
def open_demo_bench(seed: int, speed: float) -> Iterator[DemoBench]:
    """Start the shipped simulated bench.

    Args:
        seed: Seed of everything random.
        speed: How much faster than real time it runs, > 0.

    Yields:
        The bench; it is closed at the end.
    """
    bench = read_bench(examples_folder() / BENCH)
    beacon = read_beacon(bench.beacon_file)
    twin = start_simulated_bench(bench, beacon, speed=speed, seed=seed)
    try:
        yield DemoBench(twin, beacon, Calibration(twin.true_lens, "simulated"))
    finally:
        twin.close()


def demonstrate(
    folder: Path,
    *,
    seed: int = 1,
    station_count: int | None = None,
    force: bool = False,
    simulated_speed: float = 50.0,
    sink: EventSink = ignore_events,
) -> DemoResult:
    """Do the whole job on the shipped simulated bench.

    Args:
        folder: Receives the calibration and the run folder; created when missing.
        seed: Seed of everything random; the same seed sees the same pixels.
        station_count: Number of stations, spread at random through the volume; None takes the shipped grid.
        force: Whether a folder that is not empty may be used; earlier runs in it stay.
        simulated_speed: How much faster than real time the bench runs.
        sink: Receives progress.

    Returns:
        The run, its judgement, and how it compares with the simulated truth.

    Raises:
        ConfigError: The folder is not empty, or the examples are broken.
        UvgsError: A stage failed.
    """
    if folder.is_dir() and any(folder.iterdir()) and not force:
        raise ConfigError("is not empty; use --force to add to it", str(folder))
    examples = examples_folder()
    bench = read_bench(examples / BENCH)
    if bench.simulated is None:
        raise ConfigError("the demonstration needs [simulated]", bench.path)
    board = read_board(examples / BOARD)
    calibration_file = folder / "calibration.yaml"
    with SimulatedBoardSource(bench.simulated, board, VIEW_COUNT, seed=seed) as views:
        result = calibrate_from_source(views, board, bench.simulated.camera.model, camera_name="simulated", sink=sink)
    write_calibration(calibration_file, result.calibration, force=force)
    procedure = examples / PROCEDURE
    if station_count is not None:
        procedure = folder / "procedure.toml"
        write_atomically(procedure, _scattered(read_toml(examples / PROCEDURE), station_count))
    set_up = read_setup(procedure, examples / BENCH, camera=calibration_file, seed=seed)
    swept = sweep(set_up, folder, simulated_speed=simulated_speed, sink=sink)
    run = read_run(swept.path)
    return DemoResult(run, judge_run(run), calibration_file, compare_with_truth(run, bench))


def _scattered(tables: dict[str, object], count: int) -> str:
    """The shipped procedure with its grid replaced by random places in the same box."""
    grid = tables.pop("grid")
    assert isinstance(grid, dict)
    changed = tables | {
        "name": "demo_random",
        "pattern": "random",
        "order": "as_written",
        "random": {"lower": grid["lower"], "upper": grid["upper"], "count": count},
    }
    return toml_text(changed)


def compare_with_truth(run: Run, bench: Bench) -> AgainstTruth | None:
    """Hold the poses of a simulated run against the truth of its bench.

    Args:
        run: A run on the simulated bench.
        bench: Its bench, with ``[simulated]``.

    Returns:
        The comparison, or None when there are no poses or no truth.
    """
    truth = bench.simulated
    if truth is None:
        return None
    is_carried = bench.mount == "beacon_on_carriage"
    outer = truth.camera_from_gantry.pose("camera", "gantry" if is_carried else "carriage")
    inner = truth.carriage_from_beacon.pose("carriage" if is_carried else "gantry", "beacon")
    axes = true_axes(truth, bench.envelope.axes)
    shifts, angles = [], []
    for sample in run.samples:
        if not isinstance(sample.outcome, PoseEstimate):
            continue
        moving = gantry_from_carriage_true(axes, sample.position)
        true = outer @ (moving if is_carried else moving.inverse()) @ inner
        found = sample.outcome.camera_from_beacon
        shifts.append(found.t_m - true.t_m)
        angles.append(rotation_angle(found.R @ true.R.T))
    if not shifts:
        return None
    shift_m = np.array(shifts)
    return AgainstTruth(
        position_rms_m=float(np.sqrt(np.mean(np.sum(shift_m**2, axis=1)))),
        position_bias_m=float(np.linalg.norm(shift_m.mean(axis=0))),
        attitude_rms_rad=float(np.sqrt(np.mean(np.square(angles)))),
        focal_error_px=run.calibration.lens.fx_px - float(truth.camera.parameters_px[0]),
        count=len(shifts),
    )
