"""Leading somebody who waves a board before a live camera: what is taken, what is missing, when it is enough."""

from __future__ import annotations

import hashlib
from pathlib import Path

from uvgs_bench.camera import Board, BoardView, find_board
from uvgs_bench.camera.boards import BoardMiss, is_worth_a_search
from uvgs_bench.camera.guidance import Guidance, begin, consider, shared_distance_px, take
from uvgs_bench.camera.verdict import WISHED_VIEWS
from uvgs_bench.devices.cameras.source import CameraSource
from uvgs_bench.errors import CaptureError
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sessions.events import (
    CoverageShown,
    EventSink,
    Remark,
    StageAdvanced,
    StageFinished,
    StageStarted,
    ignore_events,
)
from uvgs_bench.sessions.find_boards import FoundBoards
from uvgs_bench.store.documents import write_atomically

MOST_CAPTURES = 5000
"""Captures after which the taking ends in any case."""

PATIENCE = 60
"""Captures with a board in a row that may bring nothing new, once there are views enough: a board's outermost corners
never reach the very corners of a picture."""

_STAGE = "take views"
# A board whose corners moved more than this share of the picture's width since the capture before is not held still: an
# exposure of a tenth of the time between would smear it by a tenth of that.
_STILL_SHARE = 0.004


def guide_views(
    source: CameraSource,
    board: Board,
    model: str,
    *,
    sink: EventSink = ignore_events,
    limit: int | None = None,
    keep: Path | None = None,
) -> FoundBoards:
    """Take views of a board from a live camera until they are enough, or more waving brings nothing.

    Args:
        source: A live camera; it stays open.
        board: The board as declared.
        model: Key of ``LENSES``: what the views so far are fitted with.
        sink: Where progress goes, with a ``CoverageShown`` after each capture.
        limit: Look at no more captures than this; ``MOST_CAPTURES`` when None.
        keep: Folder for the pictures taken, as lossless PNG; none are kept when None.

    Returns:
        The views taken, few or enough; without misses, which in a live picture are the rule.

    Raises:
        CaptureError: The camera stopped delivering, or gave no picture at all.
        ConfigError: A picture to keep cannot be written.
    """
    guidance, digest, seen, idle = begin(), hashlib.sha256(), 0, 0
    before: BoardView | None = None
    last: BoardView | BoardMiss | None = None
    sink(StageStarted(_STAGE))
    while seen < (limit or MOST_CAPTURES) and not guidance.is_enough:
        if idle >= PATIENCE and len(guidance.views) >= WISHED_VIEWS:
            break
        capture = source.grab()
        if capture is None:
            break
        seen += 1
        last = found = _look(capture, board, f"view_{len(guidance.views):02d}")
        if isinstance(found, BoardMiss):
            before, said, is_taken = None, f"{found.reason}: {found.detail}", False
        elif before is None or shared_distance_px(before, found) > _STILL_SHARE * found.width_px:
            before, said, is_taken = found, "hold the board still", False
        else:
            before = found
            answer = consider(guidance, found)
            said, is_taken = answer.reason, answer.is_taken
            if is_taken:
                guidance = take(guidance, found, model)
                digest.update(capture.image.tobytes())
                if keep is not None:
                    _write(keep / f"{found.name}.png", capture)
        idle = 0 if is_taken else idle + isinstance(found, BoardView)
        sink(StageAdvanced(_STAGE, len(guidance.views), said))
        sink(_shown(guidance, seen, said, is_taken))
    if seen == 0:
        raise CaptureError("gives no pictures", source.spec)
    misses = (last,) if isinstance(last, BoardMiss) and not guidance.views else ()
    sink(StageFinished(_STAGE, f"{len(guidance.views)} views of {seen} captures"))
    if not guidance.is_enough:
        sink(Remark("warning", f"ended with {len(guidance.views)} views; missing: {'; '.join(guidance.wishes)}"))
    return FoundBoards(guidance.views, misses, digest.hexdigest())


def _look(capture: Capture, board: Board, name: str) -> BoardView | BoardMiss:
    """Find the board where a glance sees one: a search in vain would make the picture stutter."""
    if not is_worth_a_search(capture.image, board):
        return BoardMiss(name, "board_not_found", f"nothing like a board of {board.columns}x{board.rows} at a glance")
    return find_board(capture.image, board, name)


def _shown(guidance: Guidance, seen: int, said: str, is_taken: bool) -> CoverageShown:
    counts = tuple(tuple(int(count) for count in row) for row in guidance.counts)
    return CoverageShown(len(guidance.views), seen, counts, guidance.wishes, said, is_taken)


def _write(path: Path, capture: Capture) -> None:
    import cv2

    done, payload = cv2.imencode(".png", capture.image)
    if not done:
        raise CaptureError("the picture cannot be written as PNG", str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, payload.tobytes(), force=False)
