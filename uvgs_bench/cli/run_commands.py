"""Names on standard input while ``uvgs run --handover command`` works, without ever waiting for one."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable


def standard_input_names() -> Callable[[], str | None]:
    """A function that takes the next line of standard input.

    Returns:
        Each call answers with one line, or None when no whole line has come, the line is empty, or the input has ended.
    """
    try:
        number = sys.stdin.fileno()
    except (OSError, ValueError, AttributeError):
        return lambda: None
    waiting = b""
    is_open = True

    def take() -> str | None:
        nonlocal waiting, is_open
        # What the system holds is asked for directly: a buffered reader would hide lines that came together.
        while is_open and b"\n" not in waiting and select.select([number], [], [], 0.0)[0]:
            part = os.read(number, 4096)
            is_open = bool(part)
            waiting += part or b"\n"
        line, end, rest = waiting.partition(b"\n")
        if not end:
            return None
        waiting = rest
        return line.decode(errors="replace").strip() or None

    return take
