"""Array types and the read-only rule: values handed between rooms are float64 and cannot be written."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


def read_only(values: ArrayLike | Sequence[float], shape: tuple[int, ...] | None = None) -> FloatArray:
    """Copy values into a read-only, C-contiguous float64 array.

    Args:
        values: Anything numpy can read as floats.
        shape: The shape it must have; -1 for a free length.

    Returns:
        The read-only array.

    Raises:
        ValueError: The shape differs.
    """
    array = np.array(values, dtype=np.float64, order="C")
    if shape is not None and (
        array.ndim != len(shape) or any(want not in (-1, have) for want, have in zip(shape, array.shape, strict=True))
    ):
        raise ValueError(f"expected an array of shape {shape}, got {array.shape}")
    array.flags.writeable = False
    return array
