"""Leading the search for a board in every capture of a source, on all cores, each picture once."""

from __future__ import annotations

import hashlib
import os
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice

import numpy as np

from uvgs_bench.camera import Board, BoardView, find_board
from uvgs_bench.camera.boards import BoardMiss, symmetry
from uvgs_bench.camera.image_circle import ImageCircle, find_image_circle
from uvgs_bench.devices.cameras.source import CameraSource
from uvgs_bench.errors import CaptureError, ConfigError
from uvgs_bench.sensor.capture import Capture, ImageArray
from uvgs_bench.sessions.events import EventSink, Remark, StageAdvanced, StageFinished, StageStarted, ignore_events
from uvgs_bench.store.detections import detection_key, read_detection, write_detection

_STAGE = "find board"


@dataclass(frozen=True, slots=True)
class FoundBoards:
    """What a source shows of a board.

    Args:
        views: Pictures with a usable board, in order.
        misses: The others, and why.
        pictures_sha256: Hash of all pictures in order.
        circle: Where the lens draws its picture; None when it fills the sensor, or nobody looked.
    """

    views: tuple[BoardView, ...]
    misses: tuple[BoardMiss, ...]
    pictures_sha256: str
    circle: ImageCircle | None = None


def find_boards(
    source: CameraSource, board: Board, *, sink: EventSink = ignore_events, limit: int | None = None
) -> FoundBoards:
    """Find a board in every capture.

    Args:
        source: Captures of the board; it stays open.
        board: The board as declared.
        sink: Where progress and remarks go.
        limit: At most so many captures; a live camera needs one.

    Returns:
        Views and misses.

    Raises:
        ConfigError: A live camera without a limit.
        CaptureError: The source cannot be read, or gives no pictures.
    """
    if source.is_live and limit is None:
        raise ConfigError("a live camera needs a number of captures to take", source.spec)
    turn = symmetry(board)
    if turn:
        said = "its first corner may be another one in each picture, which no lens depends on"
        sink(Remark("info", f"board '{board.name}' looks the same after a {turn}: {said}"))
    total = source.length if limit is None else min(limit, source.length or limit)
    sink(StageStarted(_STAGE, total))
    views: list[BoardView] = []
    misses: list[BoardMiss] = []
    digest = hashlib.sha256()
    brightest: ImageArray | None = None

    def collect(answer: Future[BoardView | BoardMiss]) -> None:
        found = answer.result()
        if isinstance(found, BoardView):
            views.append(found)
            detail = f"{found.name}: {len(found.px)} points"
        else:
            misses.append(found)
            detail = f"{found.name}: {found.reason}"
            sink(Remark("warning", f"{found.name}: {found.reason}: {found.detail}"))
        sink(StageAdvanced(_STAGE, len(views) + len(misses), detail))

    # OpenCV works outside the interpreter lock. Twice as many pictures in flight keep every core busy.
    workers = os.cpu_count() or 1
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[BoardView | BoardMiss]] = deque()
        for capture in islice(source, limit):
            digest.update(capture.image.tobytes())
            brightest = _brighter(brightest, capture.image)
            waiting.append(pool.submit(_find, capture, board))
            if len(waiting) >= 2 * workers:
                collect(waiting.popleft())
        while waiting:
            collect(waiting.popleft())
    if not views and not misses:
        raise CaptureError("gives no pictures", source.spec)
    sink(StageFinished(_STAGE, f"{len(views)} of {len(views) + len(misses)} pictures usable"))
    circle = None if brightest is None else find_image_circle(brightest)
    return FoundBoards(tuple(views), tuple(misses), digest.hexdigest(), circle)


def _brighter(so_far: ImageArray | None, image: ImageArray) -> ImageArray:
    """The brightest value of each pixel; a picture of another size, which others complain about, is passed over."""
    grey = image if image.ndim == 2 else np.asarray(image.max(axis=2))
    if so_far is None:
        return grey.copy()
    return np.maximum(so_far, grey) if so_far.shape == grey.shape and so_far.dtype == grey.dtype else so_far


def _find(capture: Capture, board: Board) -> BoardView | BoardMiss:
    """The answer of an earlier search of the same pixels, or a new one."""
    key = detection_key(capture.image, board)
    known = read_detection(key, _name(capture))
    if known is not None:
        return known
    found = find_board(capture.image, board, _name(capture))
    write_detection(key, found)
    return found


def _name(capture: Capture) -> str:
    return capture.source or f"capture {capture.index}"
