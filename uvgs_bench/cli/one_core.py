"""Linear algebra on one core, for commands whose numbers must not depend on how many cores a machine has."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def compute_on_one_core() -> None:
    """Keep the linear algebra of this process on one core, unless its user chose otherwise.

    Sums shared out over cores round differently, so that a report would not have the same bytes elsewhere; and for
    matrices as small as ours waking other cores costs more than they give. Too late once numpy is there: then nothing
    is changed.
    """
    if "numpy" not in sys.modules:
        for name in _VARIABLES:
            os.environ.setdefault(name, "1")


@contextmanager
def no_garbage_sought() -> Iterator[None]:
    """Look for no cycles of dead objects meanwhile: for a command that makes much, keeps most of it, and ends.

    A report of 1000 stations spends a twentieth of its time on them otherwise.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()
