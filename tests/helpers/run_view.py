"""``uvgs run --view`` as its own process, and a client of its page."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]


class RunningView:
    """The process and its page."""

    def __init__(self, process: subprocess.Popen[bytes], log: Path, address: str) -> None:
        self.process = process
        self.log = log
        self.address = address
        self.base, _, self.key = address.partition("#")

    def order(self, path: str, **body: Any) -> tuple[int, dict[str, Any]]:
        headers = {"Content-Type": "application/json", "X-Uvgs-Key": self.key, "Origin": self.base.rstrip("/")}
        request = urllib.request.Request(self.base + path, json.dumps(body).encode(), headers)
        try:
            with urllib.request.urlopen(request, timeout=30) as answer:
                return answer.status, json.load(answer)
        except urllib.error.HTTPError as error:
            return error.code, json.load(error)
        except OSError as error:
            time.sleep(5.0)
            said = f"{path}: {error}; process {self.process.poll()}: {self.log.read_text()}"
            raise AssertionError(said) from error

    def events(self) -> Iterator[tuple[str, dict[str, Any]]]:
        with urllib.request.urlopen(self.base + "events", timeout=60) as lines:
            name = ""
            for raw in lines:
                line = raw.decode().rstrip("\n")
                if line.startswith("event: "):
                    name = line[7:]
                elif line.startswith("data: "):
                    yield name, json.loads(line[6:])

    def capture(self) -> dict[str, Any]:
        return next(data for name, data in self.events() if name == "capture")

    def end(self) -> int:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        return self.process.wait(60)


@contextmanager
def running_view(folder: Path, source: str, *words: object) -> Iterator[RunningView]:
    """Start it in a folder and wait for the address of its page."""
    log = folder / "stderr.txt"
    command = [sys.executable, "-m", "uvgs_bench", "run", source, "--view", "--view-port", "0", *map(str, words)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with log.open("wb") as stream:
        process = subprocess.Popen(command, stderr=stream, stdout=subprocess.DEVNULL, cwd=folder, env=environment)
    try:
        ends_s = time.monotonic() + 120.0
        while (found := re.search(r"look at (\S+)", log.read_text())) is None:
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < ends_s
            time.sleep(0.05)
        yield RunningView(process, log, found[1])
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
