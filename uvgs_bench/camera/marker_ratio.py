"""Whether markers are as large as declared, next to the squares they stand in."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uvgs_bench.geometry import FloatArray

if TYPE_CHECKING:
    from uvgs_bench.camera.boards import Board

# Fewer shares than this say little.
_MIN_SHARES, _TOLERANCE = 4, 0.03
# Blur rounds the corners of a marker, which stand free on white, and draws each inward by up to 0.75 px.
_ROUNDING_PX = 1.5


def ratio_misfit(board: Board, shares: FloatArray, square_px: float) -> tuple[str, str] | None:
    """Whether markers have the declared share of a square: a second look at sizes that a camera cannot see otherwise.

    Args:
        board: The board as declared.
        shares: Side of a marker over side of its square, or over the pitch of the tags, as seen, shape (N,).
        square_px: Side of a square in the picture, px; inf where markers touch others and blur does not round their
            corners.

    Returns:
        Reason and detail, or None when they agree or too few were seen to tell.
    """
    if len(shares) < _MIN_SHARES:
        return None
    seen, declared = float(np.median(shares)), board.marker_m / board.square_m
    scatter = 1.4826 * float(np.median(np.abs(shares - seen))) / float(np.sqrt(len(shares)))
    if abs(seen / declared - 1.0) < max(_TOLERANCE, 4.0 * scatter / declared, _ROUNDING_PX / (declared * square_px)):
        return None
    return "marker_ratio", (
        f"markers are {seen:.3f} of a square wide, declared {declared:.3f}: measure squares and markers of the print"
    )
