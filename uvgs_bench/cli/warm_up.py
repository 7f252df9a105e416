"""``python -m uvgs_bench.cli.warm_up``: compile every kernel once, so that no later command pauses to do it."""

from __future__ import annotations

import sys


def warm_up() -> None:
    """Compile and cache the kernels of geometry, lens, sensor and simulated camera by using each once."""
    import numpy as np

    from uvgs_bench.geometry import Pose
    from uvgs_bench.geometry.se3 import se3_left_jacobian_inverse
    from uvgs_bench.sensor import Uvgs
    from uvgs_bench.sessions.demo import open_demo_bench

    se3_left_jacobian_inverse(Pose.identity("camera", "beacon").log() + np.full(6, 0.1))
    with open_demo_bench(seed=0, speed=100.0) as demo:
        uvgs = Uvgs(demo.nominal_calibration, demo.beacon)
        uvgs.warm_up(colour=True)
        with demo.open_camera() as camera:
            capture = camera.grab()
        if capture is not None:
            uvgs.solve(capture)


if __name__ == "__main__":
    sys.stderr.write("compiling numeric kernels once (about a minute on a small machine)...\n")
    warm_up()
