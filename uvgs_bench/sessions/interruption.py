"""Ctrl-C, SIGTERM, SIGHUP and Ctrl-Z during a session: none may be lost.

The first three end it: once for a controlled stop, once more, while it stops, for a hard one. Ctrl-Z pauses it at the
next station. Python drops an interrupt that arrives while a destructor or a callback of compiled code runs. So each is
also remembered, and a session asks before every move and every capture.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_wanted = threading.Event()
_pause_wanted = threading.Event()
_may_cut_short = threading.Event()


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
    """Ignore all three signals: a run that is being closed is closed whole."""
    if not _is_main_thread():
        yield
        return
    with _handled_by(_hush):
        yield


@contextmanager
def impatient() -> Iterator[None]:
    """Within ``undisturbed``: one more signal raises ``KeyboardInterrupt`` and cuts a controlled stop short."""
    _may_cut_short.set()
    try:
        yield
    finally:
        _may_cut_short.clear()


@contextmanager
def pausable() -> Iterator[None]:
    """Let Ctrl-Z (SIGTSTP) be remembered until ``wants_pause`` is asked; it would freeze the middle of a move."""
    if not _is_main_thread() or signal.getsignal(signal.SIGTSTP) is not signal.SIG_DFL:
        yield
        return
    _pause_wanted.clear()
    signal.signal(signal.SIGTSTP, lambda _number, _frame: _pause_wanted.set())
    try:
        yield
    finally:
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)


def wants_pause() -> bool:
    """Whether Ctrl-Z came since it was asked last."""
    is_wanted = _pause_wanted.is_set()
    _pause_wanted.clear()
    return is_wanted


def pause() -> None:
    """Stop this process until it is told to go on: ``fg``, or ``kill -CONT``."""
    os.kill(os.getpid(), signal.SIGSTOP)


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


def _hush(_number: int, _frame: FrameType | None) -> None:
    if _may_cut_short.is_set():
        _may_cut_short.clear()
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
