"""A bench whose carriage is where the pins of a simulated board say, behind a pseudo-terminal; a camera sees it."""

from __future__ import annotations

import numpy as np
import serial

from tests.helpers.firmware_board import BoardProgram
from uvgs_bench.devices.cameras.spec import CameraSpec
from uvgs_bench.devices.clock import Clock
from uvgs_bench.devices.sim.bench import SimulatedBench
from uvgs_bench.devices.sim.camera import SimulatedCamera
from uvgs_bench.geometry import Pose
from uvgs_bench.units import m_from_mm


class TerminalBoard(BoardProgram):
    """A board on a pseudo-terminal, at the pace of the wall clock."""

    def __init__(self, command: list[str]) -> None:
        super().__init__([*command, "--pty"])
        self.port = self._answer().strip()

    def set_up(self, settings: list[str]) -> None:
        """Open the port as a sender does, and set one setting after the other."""
        with serial.Serial(self.port, 115200, timeout=20) as port:
            assert b"Grbl 1.1h" in port.read_until(b"help]\r\n")
            for setting in settings:
                port.write(setting.encode("ascii") + b"\n")
                assert port.read_until(b"ok\r\n").endswith(b"ok\r\n"), setting
            # Opening the port again restarts the board, and what is not stored by then is lost.
            flags = "W"
            while "W" in flags:
                port.write(b"$P\n")
                flags = port.read_until(b"ok\r\n").decode("ascii").rpartition("[POS:")[2].split("|")[7]


class PinScene:
    """What the camera sees: the true bench with the carriage at the counted steps.

    Args:
        bench: The true bench.
        board: Where the steps are counted.
        zero_steps: Counted steps at machine zero.
        steps_per_mm: Of every axis.
    """

    def __init__(
        self, bench: SimulatedBench, board: TerminalBoard, zero_steps: tuple[int, ...], steps_per_mm: float
    ) -> None:
        self.truth, self.seed, self.companions = bench.truth, bench.seed, bench.companions
        self.true_lens, self.true_beacon = bench.true_lens, bench.true_beacon
        self._bench, self._board = bench, board
        self._zero, self._steps_per_mm = np.array(zero_steps), steps_per_mm
        self.seen_steps: list[tuple[int, ...]] = []

    def carriage(self) -> Pose:
        counted = np.array(self._board.table().motor_steps) - self._zero
        self.seen_steps.append(tuple(int(steps) for steps in counted))
        return self._bench.carriage_at(m_from_mm(counted / self._steps_per_mm), np.zeros(3), 0)

    def true_camera_from_beacon(self, _t_ns: int) -> Pose:
        return self._bench.camera_from_beacon_at(self.carriage())

    def true_camera_from(self, frame: str, t_ns: int) -> Pose:
        assert frame == "camera"
        return Pose.identity("camera", "camera")


class PinCamera(SimulatedCamera):
    """The camera ``pins:`` before the scene that a test has put up."""

    scene: PinScene

    @classmethod
    def open(cls, spec: CameraSpec, clock: Clock) -> PinCamera:
        return cls(cls.scene, spec.text, clock)
