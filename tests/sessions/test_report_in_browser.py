"""The page in a real browser: its scripts run, complain of nothing, and turn drawings live. Run with ``-m browser``."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.helpers.synthetic_run import synthetic_judgement, synthetic_run
from uvgs_bench.report import build_document, write_document

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = synthetic_run(stations=15, shots=2)
    document = build_document(run, synthetic_judgement(run))
    return write_document(document, tmp_path_factory.mktemp("page"), ("html",))["html"]


def opened(page: Path, width_px: int) -> tuple[str, str]:
    """The page as the browser holds it once its scripts have run, and what they wrote on the console."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("there is no Chromium on this machine")
    command = [browser, "--no-sandbox", "--headless", "--disable-gpu", "--enable-logging=stderr"]
    command += ["--virtual-time-budget=4000", f"--window-size={width_px},1000", "--dump-dom", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=True)
    return done.stdout, "\n".join(line for line in done.stderr.splitlines() if "CONSOLE" in line)


@pytest.mark.parametrize("width_px", [1280, 500])
def test_scripts_run_without_complaint(page: Path, width_px: int) -> None:
    held, console = opened(page, width_px)
    assert console == ""
    assert 'aria-sort="none"' in held
    assert len(re.findall(r'class="may-live is-live"', held)) == 2
    # One canvas in space, one chart a unit of the time series.
    assert held.count("<canvas") == 3
    # Position, lateral, depth, attitude: one of them colours the map.
    pressed = re.findall(r'<button[^>]*aria-pressed="(\w+)"', held)
    assert pressed == ["true", "false", "false", "false"]
    assert held.count('class="u-legend') >= 2
