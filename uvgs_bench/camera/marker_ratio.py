"""Whether markers are as large as declared, next to the squares they stand in."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uvgs_bench.geometry import FloatArray

if TYPE_CHECKING:
    from uvgs_bench.camera.boards import Board

# Fewer shares than this say little. Blur and a threshold move the edges of a marker by some tenths of thirty pixels.
_MIN_SHARES, _TOLERANCE = 4, 0.03


def ratio_misfit(board: Board, shares: FloatArray) -> tuple[str, str] | None:
    """Whether markers have the declared share of a square: a second look at sizes that a camera cannot see otherwise.

    Args:
        board: The board as declared.
        shares: Side of a marker over side of its square, or over the pitch of the tags, as seen, shape (N,).

    Returns:
        Reason and detail, or None when they agree or too few were seen to tell.
    """
    if len(shares) < _MIN_SHARES:
        return None
    seen, declared = float(np.median(shares)), board.marker_m / board.square_m
    scatter = 1.4826 * float(np.median(np.abs(shares - seen))) / float(np.sqrt(len(shares)))
    if abs(seen / declared - 1.0) < max(_TOLERANCE, 4.0 * scatter / declared):
        return None
    return "marker_ratio", (
        f"markers are {seen:.3f} of a square wide, declared {declared:.3f}: measure squares and markers of the print"
    )
