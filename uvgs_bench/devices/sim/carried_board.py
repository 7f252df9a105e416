"""The simulated camera looking at a calibration board in place of the beacon."""

from __future__ import annotations

from typing import Self

from uvgs_bench.camera.boards import Board
from uvgs_bench.devices.cameras.base import ClosingSource
from uvgs_bench.devices.sim.bench import SimulatedBench
from uvgs_bench.devices.sim.board_views import SimulatedBoardSource
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import rotation_from_euler_zyx
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.units import ns_from_s, rad_from_deg, s_from_ms

# How the board faces the camera, a little askew: yaw, pitch, roll.
_ASKEW_DEG = (4.0, -7.0, 6.0)


class CarriedBoard(ClosingSource):
    """Pictures of a board that is screwed where the beacon sits, its face to the camera and its middle on the beacon.

    Args:
        bench: The live bench.
        board: The board, printed true to its declaration.
    """

    def __init__(self, bench: SimulatedBench, board: Board) -> None:
        super().__init__(f"sim-board:{board.name}", is_live=True, length=None)
        self._bench = bench
        self._views = SimulatedBoardSource(bench.truth, board, 0, seed=bench.seed)
        self._index = 0
        still = bench.camera_from_beacon_at(Pose.identity("gantry", "carriage"))
        R = rotation_from_euler_zyx(*(rad_from_deg(angle) for angle in _ASKEW_DEG))
        camera_from_board = Pose(R, still.t_m - R @ board.points_m.mean(axis=0), "camera", "beacon")
        self._beacon_from_board = still.inverse() @ Pose(camera_from_board.R, camera_from_board.t_m, "camera", "board")

    def grab(self) -> Capture | None:
        """The board as it is now."""
        clock = self._bench.clock
        begin_ns = clock.now_ns()
        exposure_s = s_from_ms(self._bench.truth.camera.exposure_ms)
        middle_ns = begin_ns + ns_from_s(0.5 * exposure_s)
        clock.sleep(exposure_s)
        pose = self._bench.true_camera_from_beacon(middle_ns) @ self._beacon_from_board
        image = self._views.view(pose, self._index)
        self._index += 1
        return Capture(image, middle_ns, f"{self.spec}#{self._index}", self._index, exposure_s)

    def __enter__(self) -> Self:
        """Enter a context that closes the source."""
        return self
