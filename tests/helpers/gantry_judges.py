"""A simulated bench on a stepped clock, judged by corners that are computed instead of found in pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from uvgs_bench.camera.boards import Board, BoardView
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.devices.clock import SteppedClock
from uvgs_bench.devices.gantry import open_gantry
from uvgs_bench.devices.sim.bench import SimulatedBench
from uvgs_bench.devices.sim.carried_board import CarriedBoard
from uvgs_bench.devices.sim.truth import SimulatedTruth, TrueGantry
from uvgs_bench.sessions.characterise import Options, Visit, plan_visits, take_readings
from uvgs_bench.sessions.judge_gantry import Judge, judge_gantry
from uvgs_bench.store.beacons import read_beacon
from uvgs_bench.store.bench import read_bench
from uvgs_bench.store.gantry_records import GantryRecord

ROOT = Path(__file__).parents[2]
BOARD = Board("charuco_9x6", "charuco", 9, 6, 0.03, 0.022, "DICT_5X5_100")
PLANTED = TrueGantry(
    scale_ppm=(2000.0, -2000.0, 2000.0),
    squareness_mrad=(1.0, -1.0, 1.0),
    backlash_mm=(0.1,),
    repeatability_mm=(0.005,),
)


class JudgedBench:
    """The shipped bench with another gantry; time moves by waiting only."""

    def __init__(self, gantry: TrueGantry = PLANTED, seed: int = 1) -> None:
        self.described = read_bench(ROOT / "calib" / "bench.toml")
        truth = replace(self.described.simulated or SimulatedTruth(), gantry=gantry)
        beacon = read_beacon(Path(self.described.beacon_file))
        axes = self.described.nominal_axes
        self.bench = SimulatedBench(truth, beacon, axes, self.described.mount, seed=seed)
        self.clock = self.bench.clock = SteppedClock()  # type: ignore[assignment]

    def characterise(self, options: Options, corner_px: float = 0.1, board_sigma: float | None = 0.0) -> GantryRecord:
        """Plan, read, judge."""
        corners = Corners(self, corner_px / np.sqrt(options.captures))
        visits = plan_visits(self.described.envelope, options)
        with open_gantry(
            self.bench.gantry_spec, self.described.envelope, clock=self.clock, log=lambda *_: None
        ) as gantry:
            readings = take_readings(visits, gantry, corners, self.clock, options)
        judge = Judge("corners", Calibration(self.bench.true_lens, "true"), board_sigma=board_sigma)
        return judge_gantry(readings, self.described.nominal_axes, judge, options, "bench", "2026-01-01T00:00:00Z")

    def close(self) -> None:
        self.bench.close()


class Corners:
    """An instrument that knows where the board is, but for noise."""

    name = "corners"

    def __init__(self, judged: JudgedBench, corner_px: float) -> None:
        self._judged = judged
        self._sigma_px = corner_px
        self._rng = np.random.default_rng((judged.bench.seed, 9))
        self._mounted = CarriedBoard(judged.bench, BOARD)._beacon_from_board

    def read(self, visit: Visit, settled_ns: int) -> BoardView:
        bench = self._judged.bench
        pose = bench.true_camera_from_beacon(settled_ns) @ self._mounted
        px = bench.true_lens.project(BOARD.points_m @ pose.R.T + pose.t_m)
        noise = self._rng.normal(0.0, self._sigma_px, px.shape)
        return BoardView(
            f"{visit.test}", px + noise, BOARD.points_m, bench.true_lens.width_px, bench.true_lens.height_px
        )
