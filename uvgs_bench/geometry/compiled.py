"""The one decorator that compiles a numeric kernel, typed so that strict checking survives it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from types import FunctionType, ModuleType
from typing import Any, TypeVar, cast

import numba
from numba.core.runtime import rtsys

Kernel = TypeVar("Kernel", bound=Callable[..., object])

# Versions whose loading of cached code was looked into; others load it their own way, only later.
_KNOWN_LOADERS = ("0.68",)


def compiled(function: Kernel) -> Kernel:
    """Compile a kernel with numba: cached on disk, without the interpreter lock, IEEE arithmetic kept.

    Where neither the package nor the user's cache folder can be written it is compiled anew in each process.

    Args:
        function: A function on floats, integers and float64 arrays only.

    Returns:
        The compiled function with the same signature.
    """
    try:
        kernel: Any = numba.njit(cache=True, nogil=True)(function)
    except RuntimeError:
        # Numba finds no place for its cache, as in a container without a home.
        return cast(Kernel, numba.njit(nogil=True)(function))
    _notice_changed_callees(kernel)
    if numba.__version__.rpartition(".")[0] in _KNOWN_LOADERS:
        _load_without_compiler(kernel)
    return cast(Kernel, kernel)


def _load_without_compiler(kernel: Any) -> None:
    """Let a cached kernel be loaded before the compiler is set up.

    Numba fills all its tables (and imports scipy.linalg) before it looks into the cache: 0.3 s of the first pose, and
    40 MB. Machine code needs only the runtime that counts references. When the cache has nothing, numba compiles, and
    sets everything up first as ever.
    """
    cache = kernel._cache

    def load_overload(signature: Any, context: Any) -> Any:
        rtsys.initialize(context)
        _import_array_functions()
        with cache._guard_against_spurious_io_errors():
            return cache._load_overload(signature, context)

    cache.load_overload = load_overload


def _import_array_functions() -> None:
    """Import numba's array functions, which kernels may name, without their way of asking whether scipy is there.

    They ask by importing scipy.linalg: 0.2 s. It is there, being required; what needs it imports it when it does.
    """
    if "numba.np.arraymath" in sys.modules:
        return
    from numba.np import linalg

    asked = linalg.ensure_blas
    linalg.ensure_blas = lambda: None
    try:
        import_module("numba.np.arraymath")
    finally:
        linalg.ensure_blas = asked


def _notice_changed_callees(kernel: Any) -> None:
    """Let a cached kernel expire when a kernel it calls has changed.

    Numba looks only at the kernel's own file, but the machine code of its callees in other files is inlined: after an
    update of one file the old code would go on giving old numbers.
    """
    try:
        file = kernel._cache._cache_file
        stamps = {callee._cache._cache_file._source_stamp for callee in _callees(kernel.py_func)}
        file._source_stamp = (file._source_stamp, *sorted(stamps, key=repr))
    except AttributeError:
        return  # another numba than those tested, built otherwise inside; its own rules hold


def _callees(function: FunctionType) -> Iterator[Any]:
    """The cached kernels a function names, as ``kernel`` or as ``module.kernel``."""
    names = function.__code__.co_names
    for name in names:
        value = function.__globals__.get(name)
        found = [getattr(value, other, None) for other in names] if isinstance(value, ModuleType) else [value]
        for candidate in found:
            if hasattr(getattr(candidate, "_cache", None), "_cache_file"):
                yield candidate
