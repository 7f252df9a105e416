"""What whole processes cost: the time to a first pose, and the memory of a run, each in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.sensor.capture import ImageArray
from uvgs_bench.store.calibrations import write_calibration

_CAPTURES = 20
# Numbers the system keeps of a child include its parent's memory, so the child looks at itself.
_REPORT = """
import atexit, json, sys, time
def report(path=sys.argv.pop(1)):
    try:
        with open("/proc/self/status") as status:
            peak = next(1024 * int(line.split()[1]) for line in status if line.startswith("VmHWM"))
    except OSError:
        peak = 0
    with open(path, "w") as file:
        json.dump([time.process_time(), peak], file)
atexit.register(report)
"""
_FIRST_POSE = """
import numpy
from uvgs_bench.sensor import Capture, PoseEstimate, Uvgs
from uvgs_bench.store import read_beacon, read_calibration
uvgs = Uvgs(read_calibration(sys.argv[1]), read_beacon(sys.argv[2]))
sys.exit(not isinstance(uvgs.solve(Capture(numpy.load(sys.argv[3]), 0)), PoseEstimate))
"""
_COMMAND = """
import runpy
runpy.run_module("uvgs_bench", run_name="__main__", alter_sys=True)
"""


@dataclass(frozen=True, slots=True)
class ProcessCost:
    """What one process took from its start to its end.

    Args:
        wall_s: Time by the wall clock, s.
        cpu_s: Time on the processor, s: what the wall clock shows where nothing else wants the machine.
        peak_bytes: Most memory resident at once; 0 where the system does not tell.
    """

    wall_s: float
    cpu_s: float
    peak_bytes: int


def first_pose_cost(calibration: Calibration, beacon: Path, image: ImageArray) -> ProcessCost | None:
    """From the start of Python to a first pose through the Python door, with compiled kernels in the cache.

    Args:
        calibration: The camera.
        beacon: Beacon file.
        image: A picture with a pose in it.

    Returns:
        The better of two processes, or None when there is no pose.
    """
    with TemporaryDirectory() as folder:
        camera, picture = Path(folder) / "camera.yaml", Path(folder) / "picture.npy"
        write_calibration(camera, calibration)
        np.save(picture, image)
        costs = [_cost(_FIRST_POSE, [str(camera), str(beacon), str(picture)]) for _ in range(2)]
    known = [cost for cost in costs if cost is not None]
    return min(known, key=lambda cost: cost.cpu_s, default=None)


def run_cost(calibration: Calibration, beacon: Path, bench: Path) -> ProcessCost | None:
    """A whole ``uvgs run`` on the simulated camera of a bench file.

    Args:
        calibration: The camera.
        beacon: Beacon file.
        bench: Bench file with a simulated camera.

    Returns:
        Its cost, or None when the run fails.
    """
    with TemporaryDirectory() as folder:
        camera = Path(folder) / "camera.yaml"
        write_calibration(camera, calibration)
        source, out = f"sim:{bench}?count={_CAPTURES}", str(Path(folder) / "poses.csv")
        run = ["run", source, "--camera", str(camera), "--beacon", str(beacon), "--out", out, "-q"]
        return _cost(_COMMAND, [*run, "--track"])


def _cost(code: str, arguments: list[str]) -> ProcessCost | None:
    with TemporaryDirectory() as folder:
        report = Path(folder) / "cost.json"
        begin = time.perf_counter()
        # This interpreter, with code and arguments made here.
        done = subprocess.run(  # noqa: S603
            [sys.executable, "-c", _REPORT + code, str(report), *arguments], capture_output=True, check=False
        )
        wall_s = time.perf_counter() - begin
        if done.returncode != 0:
            return None
        cpu_s, peak_bytes = json.loads(report.read_text())
    return ProcessCost(wall_s, float(cpu_s), int(peak_bytes))
