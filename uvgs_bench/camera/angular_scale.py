"""How large a pixel is as an angle, anywhere in the picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray


def angle_per_pixel(lens: Lens, px: ArrayLike) -> FloatArray:
    """Angle between the rays of neighbouring pixels, the geometric mean of the two directions.

    Args:
        lens: The lens.
        px: Pixels, shape (N, 2), px.

    Returns:
        Shape (N,), rad per px; NaN where the lens has no ray.
    """
    centre = np.asarray(px, dtype=np.float64).reshape(-1, 2)
    right, down = (
        lens.unproject(centre + 0.5 * step) - lens.unproject(centre - 0.5 * step)
        for step in (np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    )
    # The area of the solid angle a pixel covers, as the side of a square.
    result: FloatArray = np.sqrt(np.linalg.norm(np.cross(right, down), axis=1))
    return result
