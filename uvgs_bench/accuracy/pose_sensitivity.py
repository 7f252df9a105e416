"""How poses answer to pixels, to the lens and to the LEDs, for many captures at once."""

from __future__ import annotations

import numpy as np

from uvgs_bench.accuracy.tangent import hats
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray


def pose_pixel_jacobian(
    lens: Lens, leds_m: FloatArray, R: FloatArray, t_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """How LED pixels move with the left tangent of the pose.

    Args:
        lens: The lens.
        leds_m: LED positions in the beacon frame, shape (L, 3), m.
        R: Rotations camera_from_beacon, shape (N, 3, 3).
        t_m: Translations, shape (N, 3), m.

    Returns:
        Derivatives (N, L, 2, 6), px per rad and m, and the pixels (N, L, 2), px.

    Source: equation 4 of the uVGS-2 paper, with rotation first.
    """
    N, L = len(R), len(leds_m)
    p = (np.einsum("nij,lj->nli", R, leds_m) + t_m[:, None]).reshape(-1, 3)
    px, by_point, _ = lens.project_with_jacobians(p)
    J = np.concatenate([-by_point @ hats(p), by_point], axis=2)
    return J.reshape(N, L, 2, 6), px.reshape(N, L, 2)
