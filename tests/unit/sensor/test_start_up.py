"""The start of a sensor: what a process loads for its first pose, and that a live run never waits for a kernel."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.sensor import Capture, PoseEstimate, Uvgs
from uvgs_bench.sessions import process_cost
from uvgs_bench.store import write_beacon, write_calibration

ROOT = Path(__file__).resolve().parents[3]
POSE = Pose(so3_exp(np.array([0.2, -0.3, 0.5])), np.array([0.02, -0.03, 0.8]), "camera", "beacon")
HEAVY = ("cv2", "matplotlib", "scipy.linalg", "scipy.optimize", "uvgs_bench.camera.fitting")
CODE = """
import json, sys
import numpy as np
from uvgs_bench.sensor import Capture, Uvgs
from uvgs_bench.store import read_beacon, read_calibration
folder = sys.argv[1]
uvgs = Uvgs(read_calibration(f"{folder}/camera.yaml"), read_beacon(f"{folder}/beacon.toml"))
pictures = np.load(f"{folder}/pictures.npz")
first = uvgs.solve(Capture(pictures["clear"], 0))
heavy = [name for name in json.loads(sys.argv[2]) if name in sys.modules]
uvgs.warm_up()
from numba.core.dispatcher import Dispatcher
late, compile_one = [], Dispatcher.compile
def watched(self, signature):
    late.append(self.py_func.__qualname__)
    return compile_one(self, signature)
Dispatcher.compile = watched
kinds = [type(first).__name__]
for name in ("clear", "hidden", "crowded", "deep", "dark"):
    for prior in (None, first):
        outcome = uvgs.solve(Capture(pictures[name], 10_000_000), prior)
        kinds.append(f"{name}: {type(outcome).__name__} {getattr(outcome, 'tracked_count', '')}")
print(json.dumps([heavy, late, kinds]))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calibration, a beacon, and pictures of it: clear, one LED hidden, among other lights, 16 bit, and dark."""
    path = tmp_path_factory.mktemp("start")
    write_calibration(path / "camera.yaml", spots.calibration())
    write_beacon(path / "beacon.toml", spots.beacon())
    rng = np.random.default_rng(1)
    px = spots.lens().project(POSE.apply(spots.beacon().positions_m))
    others = np.column_stack([rng.uniform(100.0, 1100.0, 8), rng.uniform(100.0, 400.0, 8)])
    clear = spots.draw(px, rng)
    np.savez(
        path / "pictures.npz",
        clear=clear,
        hidden=spots.draw(px[:3], rng),
        crowded=spots.draw(np.vstack([px, others]), rng),
        deep=clear.astype(np.uint16) * 16,
        dark=np.zeros_like(clear),
    )
    # Compiles what is not in the cache yet.
    uvgs = Uvgs(spots.calibration(), spots.beacon())
    uvgs.warm_up()
    assert isinstance(uvgs.solve(Capture(clear, 0)), PoseEstimate)
    return path


@pytest.mark.skipif(not numba.__version__.startswith("0.68."), reason="loading was looked into with numba 0.68 only")
def test_a_first_pose_loads_little_and_a_warm_sensor_nothing_more(folder: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", CODE, str(folder), json.dumps(HEAVY)],
        env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    heavy, late, kinds = json.loads(done.stdout)
    # Each of these costs 0.05 to 0.3 s and 10 to 40 MB, and no pose of a mono picture needs it.
    assert heavy == []
    assert late == []
    # The pictures went the ways they were made for.
    assert kinds[0] == "PoseEstimate"
    assert "clear: PoseEstimate 1" in kinds
    assert kinds.count("hidden: PoseEstimate 0") == 1
    assert "dark: Miss " in kinds


def test_a_process_tells_what_it_cost(folder: Path) -> None:
    image = np.load(folder / "pictures.npz")["clear"]
    cost = process_cost.first_pose_cost(spots.calibration(), folder / "beacon.toml", image)
    assert cost is not None
    assert cost.cpu_s > 0.0
    # Numpy and numba alone take 80 MB; a whole run may take 250 MB.
    assert sys.platform != "linux" or 50e6 < cost.peak_bytes < 250e6
    assert process_cost.first_pose_cost(spots.calibration(), folder / "beacon.toml", np.zeros_like(image)) is None
