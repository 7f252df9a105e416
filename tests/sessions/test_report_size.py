"""Reports of many stations: small enough to send, the same bytes twice, whatever the number of cores."""

from __future__ import annotations

import gc
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.synthetic_run import LIMIT_VERDICTS, synthetic_judgement, synthetic_run, write_run
from uvgs_bench import cli
from uvgs_bench.cli.one_core import no_garbage_sought
from uvgs_bench.report import build_document

pytestmark = pytest.mark.opencv

MB = 1_000_000
ONE_CORE = ("demo", "gantry_sweep", "register", "report", "compare", "follow", "fuse", "plan", "study", "beacon_pair")
MOST = {"html": 8 * MB, "pdf": 10 * MB}
"""What was promised for 1000 stations."""


def test_a_station_more_costs_little() -> None:
    sizes = []
    for stations in (20, 220):
        run = synthetic_run(stations=stations)
        document = build_document(run, synthetic_judgement(run))
        sizes.append(sum(len(figure.svg) for figure in document.figures()))
    # A thousand stations may take 8 MB in all; drawings stop growing at 800 marks, so here they grow steepest.
    assert (sizes[1] - sizes[0]) / 200 < 5_000


@pytest.mark.slow
def test_a_thousand_stations_are_small_and_the_same_twice(tmp_path: Path) -> None:
    limits = tuple(verdict.limit for verdict in LIMIT_VERDICTS)
    run = write_run(synthetic_run(stations=1000, limits=limits), tmp_path / "20260102T030405Z_synthetic")
    variables = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    written = []
    for folder in (tmp_path / "first", tmp_path / "second"):
        command = [sys.executable, "-m", "uvgs_bench", "report", str(run), "--out", str(folder)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=variables, check=False)
        assert done.returncode in (0, 1, 3), done.stderr
        written.append({path.suffix[1:]: path.read_bytes() for path in folder.iterdir()})
    assert written[0] == written[1]
    for kind, most in MOST.items():
        assert len(written[0][kind]) < most, kind


def test_the_command_keeps_its_sums_on_one_core() -> None:
    script = (
        "import os, sys\n"
        "from uvgs_bench.cli.app import build_app\n"
        "build_app()\n"
        "assert 'numpy' not in sys.modules\n"
        "from uvgs_bench.cli.one_core import compute_on_one_core\n"
        "os.environ['MKL_NUM_THREADS'] = '3'\n"
        "compute_on_one_core()\n"
        "print(os.environ['OPENBLAS_NUM_THREADS'], os.environ['MKL_NUM_THREADS'])\n"
    )
    variables = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=variables, check=True)
    # What a user chose stays.
    assert done.stdout.split() == ["1", "3"]


def test_every_command_that_judges_computes_on_one_core() -> None:
    commands = Path(cli.__file__).parent
    for name in ONE_CORE:
        text = (commands / f"{name}.py").read_text(encoding="utf-8")
        # First of all, since it is too late once an import has loaded numpy.
        assert re.search(r'\n    """[^"]+"""\n    compute_on_one_core\(\)\n', text), name


def test_collecting_garbage_goes_on_after_a_report_that_failed() -> None:
    assert gc.isenabled()
    with no_garbage_sought():
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(ZeroDivisionError), no_garbage_sought():
        _ = 1 // 0
    assert gc.isenabled()
