"""What a node is tried on: pictures, beacon, calibration and CameraInfo on disk, and the poses they have offline."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tests.helpers import spots
from uvgs_bench.interop.pose_messages import ros_covariance
from uvgs_bench.interop.ros_messages import camera_info_from_lens
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.store.beacons import write_beacon
from uvgs_bench.store.calibrations import write_calibration

COUNT = 3
FILES = ("pictures.npy", "info.json", "out.json")
_FIRST_NS = 100 * 10**9


def write_node_bench(folder: Path) -> list[PoseEstimate]:
    """Write the files; the poses have the stamps the peers give to the pictures."""
    rng = np.random.default_rng(5)
    views = [spots.random_pose(rng, cone_deg=15.0) for _ in range(COUNT)]
    pictures = [spots.draw(spots.lens().project(view.apply(spots.beacon().positions_m)), rng) for view in views]
    np.save(folder / "pictures.npy", np.array(pictures))
    write_beacon(folder / "beacon.toml", spots.beacon())
    write_calibration(folder / "camera.yaml", spots.calibration())
    info = camera_info_from_lens(spots.lens())
    fields: dict[str, object] = {"height": info.height, "width": info.width, "distortion_model": info.distortion_model}
    fields |= {"D": info.d, "K": info.k, "R": info.r, "P": info.p}
    (folder / "info.json").write_text(json.dumps(fields))
    sensor = Uvgs(spots.calibration(), spots.beacon())
    outcomes = [sensor.solve(Capture(picture, _FIRST_NS + k)) for k, picture in enumerate(pictures)]
    return [outcome for outcome in outcomes if isinstance(outcome, PoseEstimate)]


def check_answers(told: dict[str, dict], offline: list[PoseEstimate]) -> None:
    """The node's poses are the offline ones: the same code on the same pixels, and CameraInfo has every digit."""
    assert len(offline) == COUNT
    for k, estimate in enumerate(offline):
        got = told[str(_FIRST_NS + k)]
        assert got["frame"] == "camera"
        assert np.allclose(got["t_m"], estimate.camera_from_beacon.t_m, atol=1e-12)
        assert np.allclose(got["q"], estimate.camera_from_beacon.quaternion_xyzw(), atol=1e-12)
        assert np.allclose(got["covariance"], ros_covariance(estimate).ravel(), rtol=1e-9, atol=1e-18)
