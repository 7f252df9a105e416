"""Projection uncertainty against mrcal's, on the same corners, where Debian's ``mrcal`` is installed."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from uvgs_bench.camera import BoardView
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.fitting import fit
from uvgs_bench.camera.projection_uncertainty import picture_grid, projection_uncertainty, worst_sigma
from uvgs_bench.sessions.calibration_benchmark import drawn_views

PYTHON = Path("/usr/bin/python3")
ASK = """
import json, sys, mrcal, numpy as np
model = mrcal.cameramodel(sys.argv[1])
q = np.array(json.load(open(sys.argv[2])))
v = mrcal.unproject(q, *model.intrinsics())
out = {"intrinsics": model.intrinsics()[1].tolist()}
for name, points, far in (("infinity", v, True), ("near", v / np.linalg.norm(v, axis=1)[:, None] * 0.6, False)):
    out[name] = mrcal.projection_uncertainty(points, model=model, atinfinity=far, what="covariance").tolist()
print(json.dumps(out))
"""


def asked(views: list[BoardView], grid: np.ndarray, folder: Path) -> dict:
    lines = ["# filename x y level"]
    lines += [f"{i:03d}.png {u!r} {v!r} 0" for i, view in enumerate(views) for u, v in view.px.tolist()]
    (folder / "corners.vnl").write_text("\n".join(lines) + "\n")
    (folder / "grid.json").write_text(json.dumps(grid.tolist()))
    command = [
        "mrcal-calibrate-cameras", "--corners-cache", "corners.vnl", "--lensmodel", "LENSMODEL_OPENCV5",
        "--focal", "1000", "--imagersize", "1280", "960", "--object-spacing", "0.03", "--object-width-n", "9",
        "--object-height-n", "6", "--skip-regularization", "--skip-outlier-rejection", "--skip-calobject-warp-solve",
        "*.png",
    ]  # fmt: skip
    subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=200)
    (model,) = folder.glob("*.cameramodel")
    told = subprocess.run(
        [PYTHON, "-c", ASK, model.name, "grid.json"],
        cwd=folder,
        check=True,
        capture_output=True,
        text=True,
        timeout=100,
    )
    return json.loads(told.stdout)


@pytest.mark.slow
def test_projection_uncertainty_is_that_of_mrcal(tmp_path):
    if shutil.which("mrcal-calibrate-cameras") is None or not PYTHON.exists():
        pytest.skip("mrcal is not on this machine (Debian: apt-get install mrcal)")
    views = drawn_views("plumb_bob", 9, 6, 20, np.random.default_rng(7))
    fitted = fit(views, "plumb_bob", reject_outliers=False)
    lens = fitted.bundle.lens
    grid = picture_grid(lens, 5, 5)
    theirs = asked(views, grid, tmp_path)
    sigmas = np.sqrt(np.diag(fitted.doubt.covariance))
    # The same minimum: a hundredth of a deviation.
    assert np.abs((np.array(theirs["intrinsics"]) - lens.parameters) / sigmas).max() < 0.01
    calibration = Calibration(lens, joint_covariance=fitted.doubt.joint)
    numbers = 2 * len(fitted.corners.px)
    # Their noise is the root mean square of the residuals; parameters are not subtracted.
    factor = np.sqrt((numbers - lens.parameters.size - 6 * len(views)) / numbers)
    for name, distance_m in (("infinity", np.inf), ("near", 0.6)):
        ours = factor * worst_sigma(projection_uncertainty(calibration, grid, distance_m))
        ratio = ours / worst_sigma(np.array(theirs[name]))
        print(name, ratio.min(), ratio.max())
        assert np.abs(ratio - 1.0).max() < 0.05
