"""Compiled growth of one bright component, with labels kept only where something grew."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.capture import ImageArray

# Side of the blocks in which labels are kept, px; 16 also by shift and mask below.
BLOCK_PX = 16
# What a growing component can find.
FREE, FLANK, ENDLESS = 0, 1, 2


@compiled
def label_of(slots: NDArray[np.int32], blocks: NDArray[np.int32], v: int, u: int) -> int:
    """Label of a pixel; blocks that were never touched have none.

    Args:
        slots: Number of the block of each place, from 1; 0 for none.
        blocks: Labels of the pixels of each block.
        v: Row.
        u: Column.

    Returns:
        The label, 0 for none.
    """
    slot = slots[v >> 4, u >> 4]
    return 0 if slot == 0 else int(blocks[slot - 1, ((v & 15) << 4) | (u & 15)])


@compiled
def _take_run(
    v: int,
    first: int,
    past: int,
    label: int,
    may_cross: bool,
    is_endless: NDArray[np.bool_],
    slots: NDArray[np.int32],
    blocks: NDArray[np.int32],
    used: int,
) -> tuple[int, int, int]:
    """Label the free pixels of a run. Returns what was met, how many were free, and how many blocks are used."""
    met = FREE
    taken = 0
    u = first
    while u < past:
        end = min(past, (u | 15) + 1)
        slot = slots[v >> 4, u >> 4]
        if slot == 0:
            blocks[used] = 0
            used += 1
            slot = used
            slots[v >> 4, u >> 4] = slot
        line = blocks[slot - 1, (v & 15) << 4 : ((v & 15) << 4) + 16]
        for i in range(u & 15, (u & 15) + end - u):
            other = line[i]
            if other != 0:
                if other == label:
                    continue
                if not is_endless[other]:
                    met = FLANK
                    continue
                if not may_cross:
                    return ENDLESS, taken, used
            line[i] = label
            taken += 1
        u = end
    return met, taken, used


@compiled
def grow(
    image: ImageArray,
    y: int,
    x: int,
    threshold: float,
    label: int,
    most_px: int,
    may_cross: bool,
    is_endless: NDArray[np.bool_],
    slots: NDArray[np.int32],
    blocks: NDArray[np.int32],
    used: int,
    runs: NDArray[np.int64],
) -> tuple[int, int, int, NDArray[np.int32]]:
    """Label the 8-connected pixels above a threshold, run by run.

    Args:
        image: Brightness, shape (H, W), uint8 or uint16.
        y: Row of the peak.
        x: Column of the peak.
        threshold: Pixels are above, DN.
        label: Its label.
        most_px: It is endless when it has more pixels.
        may_cross: Whether it may take pixels from endless places; otherwise it is endless when it meets one.
        is_endless: By label.
        slots: As for ``label_of``.
        blocks: As for ``label_of``.
        used: How many blocks are in use.
        runs: Output, row, first and last column of each run, shape (most_px, 3).

    Returns:
        What came of it (``FREE`` when it stands alone), how many runs there are, how many blocks are used, the blocks.
    """
    height, width = image.shape
    status = FREE
    filled = 0
    taken = -1
    area = 0
    while taken < filled:
        # The first round looks at the peak alone, the others at the rows above and below a run.
        row = runs[taken, 0] if taken >= 0 else y + 1
        first = max(0, runs[taken, 1] - 1) if taken >= 0 else x
        last = min(width - 1, runs[taken, 2] + 1) if taken >= 0 else x
        for v in (row - 1, row + 1):
            if v < 0 or v >= height or (taken < 0 and v != y):
                continue
            line = image[v]
            u = first
            while u <= last:
                if not line[u] > threshold:
                    u += 1
                    continue
                past = u + 1
                while past < width and line[past] > threshold:
                    past += 1
                if label_of(slots, blocks, v, u) != label:
                    while u > 0 and line[u - 1] > threshold:
                        u -= 1
                    if used + (width >> 4) + 2 > blocks.shape[0]:
                        blocks = np.concatenate((blocks, np.empty_like(blocks), np.empty_like(blocks)))
                    met, new, used = _take_run(v, u, past, label, may_cross, is_endless, slots, blocks, used)
                    if met == ENDLESS:
                        return ENDLESS, filled, used, blocks
                    if met == FLANK:
                        status = FLANK
                    if new > 0:
                        area += new
                        runs[filled, 0] = v
                        runs[filled, 1] = u
                        runs[filled, 2] = past - 1
                        filled += 1
                        if area > most_px or filled == runs.shape[0]:
                            return ENDLESS, filled, used, blocks
                u = past
        taken += 1
    return status, filled, used, blocks


@compiled
def erase(runs: NDArray[np.int64], label: int, slots: NDArray[np.int32], blocks: NDArray[np.int32]) -> None:
    """Take a label off runs.

    Args:
        runs: Row, first and last column of each run, shape (n, 3).
        label: The label.
        slots: As for ``label_of``.
        blocks: As for ``label_of``.
    """
    for i in range(runs.shape[0]):
        v = runs[i, 0]
        for u in range(runs[i, 1], runs[i, 2] + 1):
            if label_of(slots, blocks, v, u) == label:
                blocks[slots[v >> 4, u >> 4] - 1, ((v & 15) << 4) | (u & 15)] = 0
