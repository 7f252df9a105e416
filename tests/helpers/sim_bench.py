"""A small simulated bench on disk: a beacon passes before a 640 x 480 camera whose calibration is the truth."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.devices.sim.passing import PassingBeacon
from uvgs_bench.sensor import PoseEstimate
from uvgs_bench.store.bench import read_passing_beacon
from uvgs_bench.store.calibrations import write_calibration

CALIB = Path(__file__).parents[2] / "calib"


def write_bench(folder: Path, *, beacon: str = "any", more: str = "", **camera: object) -> Path:
    """Write bench, beacons (``any red green``, all of one geometry) and calibration.

    Args:
        folder: Where.
        beacon: Which of the beacons passes.
        more: Further tables of the bench file, and keys of ``[simulated]`` before them.
        camera: Values of ``[simulated.camera]``.

    Returns:
        The bench file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for hue in ("any", "red", "green"):
        text = (CALIB / "beacons" / "tetra_small.toml").read_text()
        text = text.replace('name = "tetra_small"', f'name = "{hue}"').replace('hue = "any"', f'hue = "{hue}"')
        (folder / f"{hue}.toml").write_text(text)
    text = (CALIB / "bench.toml").read_text().partition("\n[simulated]")[0]
    text = re.sub(r'beacon = ".*?"', f'beacon = "{beacon}.toml"', text)
    text = re.sub(r'camera = ".*?"', 'camera = "camera.yaml"', text)
    keys = {
        "width_px": 640,
        "height_px": 480,
        "parameters_px": [500.0, 501.0, 321.0, 238.5, -0.05, 0.02, 0.0, 0.0, 0.0],
        "peak_dn_at_1m": 200.0,
        **camera,
    }
    lines = [f"{key} = {str(value).lower()}" for key, value in keys.items()]
    path = folder / "bench.toml"
    path.write_text(text + "\n[simulated]\n" + more + "\n[simulated.camera]\n" + "\n".join(lines) + "\n")
    write_calibration(folder / "camera.yaml", Calibration(read_passing_beacon(path).true_lens, "simulated"))
    return path


def error_sigmas(estimate: PoseEstimate, scene: PassingBeacon, companion: int | None = None) -> float:
    """Root of the squared Mahalanobis distance over 6 of a pose from the truth at its instant."""
    truth = scene.true_camera_from_beacon(estimate.t_ns)
    if companion is not None:
        truth = truth @ scene.companions[companion][0]
    xi = (estimate.camera_from_beacon @ truth.inverse()).log()
    return float(np.sqrt(xi @ np.linalg.solve(estimate.covariance, xi) / 6.0))
