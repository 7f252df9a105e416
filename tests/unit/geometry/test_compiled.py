"""Compiled kernels: kept between processes, and never older than what they call."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
HEAD = "from uvgs_bench.geometry.compiled import compiled\n"


def write(folder: Path, factor: float) -> None:
    (folder / "low.py").write_text(f"{HEAD}@compiled\ndef f(x):\n    return x * {factor}\n")


def run(folder: Path, **variables: str) -> list[float]:
    code = "import top; print(top.h(1.0), sum(top.h.stats.cache_hits.values()))"
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{folder}"} | variables
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    return [float(word) for word in done.stdout.split()]


def test_a_changed_callee_in_another_file_expires_its_callers(tmp_path: Path) -> None:
    write(tmp_path, 2.0)
    (tmp_path / "high.py").write_text(f"{HEAD}from low import f\n@compiled\ndef g(x):\n    return f(x) + 1.0\n")
    (tmp_path / "top.py").write_text(f"{HEAD}import high\n@compiled\ndef h(x):\n    return high.g(x) + 1.0\n")
    assert run(tmp_path) == [4.0, 0.0]
    assert run(tmp_path) == [4.0, 1.0]
    write(tmp_path, 30.0)
    assert run(tmp_path) == [32.0, 0.0]


def test_a_process_that_loaded_a_kernel_can_still_compile_one(tmp_path: Path) -> None:
    write(tmp_path, 2.0)
    # The second is never cached and wants everything the compiler has, matrices by BLAS among it.
    (tmp_path / "top.py").write_text(
        "import numba, numpy as np\nfrom low import f as h\n"
        "@numba.njit\ndef late(a):\n    return (a @ a).sum() + np.median(a)\n"
        "h(1.0)\nassert late(np.full((2, 2), 3.0)) == 75.0\n"
    )
    assert run(tmp_path) == [2.0, 0.0]
    assert run(tmp_path) == [2.0, 1.0]


def test_a_kernel_runs_where_nothing_can_be_cached(tmp_path: Path) -> None:
    write(tmp_path, 2.0)
    (tmp_path / "top.py").write_text("from low import f as h\n")
    # Source that is no file, as in an archive, has no place beside it; the cache folder cannot be made below a file.
    code = (
        "import sys\n"
        "import numba.core.caching as caching\n"
        "caching.FunctionCache._impl_class._locator_classes = []\n"
        "import top\n"
        "print(top.h(1.0), sum(top.h.stats.cache_hits.values()))\n"
    )
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["2.0", "0"], done.stderr
