"""Linear algebra on one core, for commands whose numbers must not depend on how many cores a machine has."""

from __future__ import annotations

import os
import sys

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
