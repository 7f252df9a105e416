"""A study task that costs nothing: it says what its generator gave it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np


def toy_bench(rng: np.random.Generator, number: int, scale: float = 1.0) -> dict[str, Any]:
    """A number drawn from the bench's own generator; the sum of many is the same only on the same threads."""
    return {"drawn": scale * float(rng.normal(size=1000).sum()), "number": number}


def deadly_bench(rng: np.random.Generator, number: int, flag: str) -> dict[str, Any]:
    """Kills its worker at bench 7 as long as the flag is there."""
    if number == 7 and Path(flag).exists():
        os._exit(9)
    return toy_bench(rng, number)
