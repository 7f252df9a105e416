"""Lights in a picture that shows a printed board, too: everything as dark as the print is taken away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uvgs_bench.camera.boards import BoardView
from uvgs_bench.sensor.capture import Capture

# Of the pixels among the corners: about half are white paper, few can be lights.
_WHITE_PERCENTILE = 90.0
# Paper is lit unevenly, and noise adds to it.
_BRIGHTER = 1.2


def without_print(capture: Capture, view: BoardView) -> Capture:
    """A capture whose dark parts are raised to just above the white of a board in it, so that only lights stand out.

    The foot of a light is cut at one level all around it, which leaves its centre where it was.

    Args:
        capture: The capture.
        view: The board found in it.

    Returns:
        The same instant; brighter pixels keep their values.
    """
    import cv2

    image = capture.image
    grey = image if image.ndim == 2 else image.max(axis=2)
    inside = np.zeros(grey.shape, np.uint8)
    cv2.fillConvexPoly(inside, cv2.convexHull(np.rint(view.px).astype(np.int32)), 1)
    level = _BRIGHTER * float(np.percentile(grey[inside > 0], _WHITE_PERCENTILE))
    floor = image.dtype.type(min(level, float(np.iinfo(image.dtype).max)))
    return replace(capture, image=np.maximum(image, floor))
