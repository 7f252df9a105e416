"""Ctrl-C, SIGTERM and SIGHUP during a session: none may be lost, and none may cut short the stopping it asked for.

Python drops an interrupt that arrives while a destructor or a callback of compiled code runs. So each is also
remembered, and a session asks before every move and every capture.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_wanted = threading.Event()


@contextmanager
def interruptible() -> Iterator[None]:
    """Let all three signals raise ``KeyboardInterrupt`` and be remembered; may be nested.

    A program that just dies at SIGTERM leaves the carriage moving. A signal that is ignored, as under nohup, stays so.
    Outside the main thread, where Python allows no handlers, this does nothing.
    """
    if not _is_main_thread() or any(signal.getsignal(n) is _interrupt for n in _NUMBERS):
        yield
        return
    _wanted.clear()
    with _handled_by(_interrupt):
        yield
    _wanted.clear()


@contextmanager
def undisturbed() -> Iterator[None]:
    """Ignore all three signals, so that a second Ctrl-C does not cut short what the first one asked for."""
    if not _is_main_thread():
        yield
        return
    with _handled_by(signal.SIG_IGN):
        yield


def check_interruption() -> None:
    """Raise an interrupt that was lost on its way.

    Raises:
        KeyboardInterrupt: A signal came since the session began.
    """
    if _wanted.is_set():
        _wanted.clear()
        raise KeyboardInterrupt


def _interrupt(_number: int, _frame: FrameType | None) -> None:
    _wanted.set()
    raise KeyboardInterrupt


def _is_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


@contextmanager
def _handled_by(handler: object) -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in _NUMBERS}
    # None: set by a library outside Python, which could not be put back.
    changed = [number for number in _NUMBERS if before[number] not in (signal.SIG_IGN, None)]
    for number in changed:
        signal.signal(number, handler)  # type: ignore[arg-type]
    try:
        yield
    finally:
        for number in changed:
            signal.signal(number, before[number])
