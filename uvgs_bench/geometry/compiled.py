"""The one decorator that compiles a numeric kernel, typed so that strict checking survives it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

Kernel = TypeVar("Kernel", bound=Callable[..., object])


def compiled(function: Kernel) -> Kernel:
    """Compile a kernel with numba: cached on disk, without the interpreter lock, IEEE arithmetic kept.

    Where neither the package nor the user's cache folder can be written it is compiled anew in each process.

    Args:
        function: A function on floats, integers and float64 arrays only.

    Returns:
        The compiled function with the same signature.
    """
    try:
        return cast(Kernel, numba.njit(cache=True, nogil=True)(function))
    except RuntimeError:
        # Numba finds no place for its cache, as in a container without a home.
        return cast(Kernel, numba.njit(nogil=True)(function))
