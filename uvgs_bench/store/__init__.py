"""What is on disk: documents people write and runs the bench records.

Here: strict readers, the run journal, workspaces. In: paths. Out: values of the rooms below. Plug point: none.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from uvgs_bench.store.beacons import read_beacon, write_beacon
    from uvgs_bench.store.bench import read_bench
    from uvgs_bench.store.boards import read_board
    from uvgs_bench.store.calibrations import read_calibration, write_calibration
    from uvgs_bench.store.run import Run, read_run

__all__ = [
    "Run",
    "read_beacon",
    "read_bench",
    "read_board",
    "read_calibration",
    "read_run",
    "write_beacon",
    "write_calibration",
]

_HOMES = {
    "Run": "run",
    "read_beacon": "beacons",
    "read_bench": "bench",
    "read_board": "boards",
    "read_calibration": "calibrations",
    "read_run": "run",
    "write_beacon": "beacons",
    "write_calibration": "calibrations",
}


def __getattr__(name: str) -> object:
    """Load a reader only when asked for: a command reads one kind of file, not all of them."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
