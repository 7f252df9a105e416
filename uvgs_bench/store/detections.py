"""Found boards kept by what was looked at: the same picture and board are not searched twice.

The key is the hash of the pixels, of the board and of the programs that looked; a changed picture, board or detector is
another key. A broken or foreign entry is as good as none. Files are JSON under ``$XDG_CACHE_HOME/uvgs_bench`` (or
``~/.cache/uvgs_bench``); deleting them loses nothing but time.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uvgs_bench import __version__
from uvgs_bench.camera.boards import Board, BoardMiss, BoardView
from uvgs_bench.errors import UvgsError
from uvgs_bench.store.documents import write_atomically


@cache
def _detectors() -> str:
    """Hash of the code that looks for boards: another version of it may find other points in the same picture."""
    import uvgs_bench.camera.boards as boards

    folder = Path(boards.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(folder.glob("board*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def cache_folder() -> Path:
    """Where found boards are kept."""
    said = os.environ.get("XDG_CACHE_HOME", "")
    # A relative path there is invalid by the XDG rules and must be ignored.
    root = Path(said) if said and Path(said).is_absolute() else Path.home() / ".cache"
    return root / "uvgs_bench" / "boards"


def detection_key(image: NDArray[np.generic], board: Board) -> str:
    """Key of a picture and a board.

    Args:
        image: The picture, any shape and type.
        board: The board as declared.

    Returns:
        A hash, 64 hexadecimal digits.
    """
    import cv2

    said = {
        "board": {**asdict(board), "name": ""},
        "shape": list(image.shape),
        "type": str(image.dtype),
        "detectors": _detectors(),
        "versions": [__version__, cv2.__version__],
    }
    digest = hashlib.sha256(json.dumps(said, sort_keys=True).encode())
    digest.update(np.ascontiguousarray(image).tobytes())
    return digest.hexdigest()


def read_detection(key: str, name: str = "") -> BoardView | BoardMiss | None:
    """Look an answer up.

    Args:
        key: From ``detection_key``.
        name: Name of the picture to give the answer.

    Returns:
        What was found then, to the last digit; None when nothing usable is kept.
    """
    try:
        kept = json.loads((cache_folder() / f"{key}.json").read_text(encoding="utf-8"))
        if kept["key"] != key:
            return None
        if "reason" in kept:
            return BoardMiss(name, str(kept["reason"]), str(kept["detail"]))
        px, board_m = np.array(kept["px"], dtype=np.float64), np.array(kept["board_m"], dtype=np.float64)
        if not (np.isfinite(px).all() and np.isfinite(board_m).all() and len(px)):
            return None
        return BoardView(name, px.reshape(-1, 2), board_m.reshape(-1, 3), int(kept["width_px"]), int(kept["height_px"]))
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def write_detection(key: str, found: BoardView | BoardMiss) -> None:
    """Keep an answer; a disk that cannot be written is no error, the next search just takes its time.

    Args:
        key: From ``detection_key``.
        found: The answer.
    """
    kept: dict[str, object] = {"key": key}
    if isinstance(found, BoardMiss):
        kept |= {"reason": found.reason, "detail": found.detail}
    else:
        kept |= {
            "px": found.px.tolist(),
            "board_m": found.board_m.tolist(),
            "width_px": found.width_px,
            "height_px": found.height_px,
        }
    try:
        write_atomically(cache_folder() / f"{key}.json", json.dumps(kept))
    except UvgsError:
        return
