"""Many simulated benches on many processors: each bench has a seed of its own, each result is on disk when it is known.

A result depends on the study's seed and the bench's number alone, so neither the order, nor the number of workers, nor
where they stand, nor how often the work was taken up again changes it.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
from collections.abc import Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from uvgs_bench import __version__
from uvgs_bench.errors import ConfigError, UnreadableDocument, UvgsError
from uvgs_bench.sessions.events import EventSink, Remark, StageAdvanced, StageFinished, StageStarted
from uvgs_bench.sessions.interruption import interruptible

RESULTS_FILE = "results.jsonl"
SCHEMA = 1
# So many benches wait for each worker: it never idles, and little is lost when the work is interrupted.
_WAITING = 3
_ANSWER_S = 10
# One thread a worker: more would fight for the same cores, and a sum would depend on how it was shared out.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")

Row = dict[str, Any]
"""What one bench says: plain values that JSON can hold."""


@dataclass(frozen=True, slots=True)
class Work:
    """What is to be done for every bench.

    Args:
        task: ``module:function``; the function gets a generator, the bench's number and the settings by name, and
            returns a ``Row``. Workers import it, so it must be importable where they run.
        seed: Seed of the whole study.
        settings: Further arguments, plain values that JSON can hold.
    """

    task: str
    seed: int
    settings: Mapping[str, Any]

    def header(self) -> Row:
        """What results must say about their origin to be taken up again."""
        return {
            "schema": SCHEMA,
            "task": self.task,
            "seed": self.seed,
            "settings": json.loads(json.dumps(dict(self.settings))),
            "version": __version__,
        }


def run_benches(
    work: Work,
    count: int,
    results: Path,
    sink: EventSink,
    *,
    workers: int,
    scheduler: str | None = None,
    resume: bool = False,
    force: bool = False,
) -> list[Row]:
    """Do the work for benches 0 to ``count - 1``.

    Args:
        work: What to do.
        count: Number of benches.
        results: The file that gets one line per bench as soon as it is done.
        sink: Where progress goes.
        workers: Processes on this machine; not used with a scheduler.
        scheduler: Address of a Dask scheduler, or None for this machine.
        resume: Whether to go on with an existing file; its benches are not done again.
        force: Whether an existing file may be replaced.

    Returns:
        One row per bench in the order of their numbers.

    Raises:
        ConfigError: The file exists, or is of another study, or cannot be meant.
        UvgsError: No cluster, or a worker died; what is done is kept.
        KeyboardInterrupt: After Ctrl-C; what is done is kept.
    """
    done = _begun(work, results, resume=resume, force=force)
    missing = [k for k in range(count) if k not in done]
    sink(StageStarted("benches", count))
    kept = count - len(missing)
    if kept:
        sink(StageAdvanced("benches", kept, f"{kept} were done before"))
    if missing:
        # Workers first: a scheduler that does not answer leaves no file behind.
        with interruptible(), _workers(workers, scheduler) as (pool, slots), _opened(results, work, resume) as stream:
            try:
                for number, row in _results(pool, slots, work, missing):
                    stream.write(json.dumps({"bench": number, **row}) + "\n")
                    stream.flush()
                    done[number] = row
                    kept += 1
                    sink(StageAdvanced("benches", kept))
            except KeyboardInterrupt:
                sink(Remark("warning", f"{kept} of {count} benches are kept in {results}: go on with --resume"))
                raise
            except BrokenExecutor:
                raise UvgsError(
                    f"a worker process died, perhaps for want of memory; {kept} of {count} benches are kept in "
                    f"{results}: go on with --resume, or with fewer --workers"
                ) from None
    sink(StageFinished("benches", f"{count} benches"))
    return [done[k] for k in range(count)]


def one_bench(task: str, seed: int, number: int, settings: Mapping[str, Any]) -> Row:
    """Do the work for one bench; runs in a worker.

    Args:
        task: As in ``Work``.
        seed: As in ``Work``.
        number: The bench's number.
        settings: As in ``Work``.

    Returns:
        Its row.
    """
    module, name = task.split(":")
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
    row: Row = getattr(importlib.import_module(module), name)(rng, number, **settings)
    return row


def _results(pool: Executor, slots: int, work: Work, missing: list[int]) -> Iterator[tuple[int, Row]]:
    settings = dict(work.settings)
    numbers = iter(missing)
    waiting: dict[Future[Row], int] = {}

    def ask() -> None:
        number = next(numbers, None)
        if number is not None:
            waiting[pool.submit(one_bench, work.task, work.seed, number, settings)] = number

    for _ in range(_WAITING * slots):
        ask()
    while waiting:
        for future in wait(waiting, return_when=FIRST_COMPLETED).done:
            yield waiting.pop(future), future.result()
            ask()


def _begun(work: Work, results: Path, *, resume: bool, force: bool) -> dict[int, Row]:
    """What a file holds already."""
    if results.exists() and resume:
        return _read(work, results)
    if results.exists() and not force:
        raise ConfigError("exists already; --resume goes on with it, --force replaces it", str(results))
    return {}


def _read(work: Work, results: Path) -> dict[int, Row]:
    try:
        raw = results.read_bytes()
    except OSError as error:
        raise UnreadableDocument(f"cannot be read: {error.strerror or error}", str(results)) from None
    whole = raw[: raw.rfind(b"\n") + 1]
    lines = []
    for at, text in enumerate(whole.splitlines(), 1):
        try:
            line = json.loads(text)
        except ValueError:
            line = None
        if not isinstance(line, dict):
            raise ConfigError(f"line {at} is no result of a study", str(results))
        lines.append(line)
    if not lines:
        raise ConfigError("is empty, expected the first line of a study; --force starts anew", str(results))
    for key, expected in work.header().items():
        if lines[0].get(key) != expected:
            raise ConfigError(
                f"these results are of another study, {key} {lines[0].get(key)!r}, now {expected!r}", str(results), key
            )
    done: dict[int, Row] = {}
    for at, line in enumerate(lines[1:], 2):
        number = line.pop("bench", None)
        if not isinstance(number, int):
            raise ConfigError(f"line {at} names no bench", str(results))
        done[number] = line
    if len(whole) < len(raw):
        # The program was killed while it wrote this line.
        os.truncate(results, len(whole))
    return done


@contextmanager
def _opened(results: Path, work: Work, resume: bool) -> Iterator[TextIO]:
    goes_on = resume and results.exists()
    try:
        results.parent.mkdir(parents=True, exist_ok=True)
        stream = results.open("a" if goes_on else "w", encoding="utf-8")
    except OSError as error:
        raise UvgsError(f"{results}: cannot be written: {error.strerror or error}") from None
    with stream:
        if not goes_on:
            stream.write(json.dumps(work.header()) + "\n")
            stream.flush()
        yield stream


@contextmanager
def _workers(workers: int, scheduler: str | None) -> Iterator[tuple[Executor, int]]:
    if scheduler is not None:
        with open_cluster(scheduler) as found:
            yield found
        return
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    # A pool of one too: the same libraries in the same state, whatever the number of workers. Spawned, since a fork
    # would copy the locks of other threads.
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_deaf_to_interrupts)
    try:
        yield pool, workers
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _deaf_to_interrupts() -> None:
    """Ctrl-C reaches a whole group of processes; only the one that writes results decides what it means."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def open_cluster(address: str) -> Iterator[tuple[Executor, int]]:
    """The workers of a Dask scheduler.

    Args:
        address: Like ``tcp://host:8786``.

    Yields:
        An executor, and how many tasks run at a time.

    Raises:
        ConfigError: The extra is not installed, or it is no address.
        UvgsError: Nothing answers, or a worker has other versions than this machine.
    """
    try:
        from distributed import Client
    except ImportError:
        raise ConfigError("needs the extra 'cluster': pip install 'uvgs-bench[cluster]'", key="--scheduler") from None
    if "://" not in address:
        raise ConfigError(f"must be an address like tcp://host:8786, got '{address}'", key="--scheduler")
    try:
        client = Client(address, timeout=_ANSWER_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UvgsError(f"no Dask scheduler answers at {address}: {error}") from None
    with client:
        slots = sum(client.nthreads().values())
        if slots == 0:
            raise UvgsError(f"the scheduler at {address} has no workers")
        _check_versions(client, address)
        pool = client.get_executor(pure=False)
        try:
            yield pool, slots
        finally:
            pool.shutdown(wait=False)


def _check_versions(client: Any, address: str) -> None:
    here = worker_versions()
    try:
        found = client.run(worker_versions)
    except ImportError as error:
        raise UvgsError(f"the workers of {address} cannot do this work: {error}") from None
    for worker, versions in found.items():
        if versions != here:
            raise UvgsError(f"worker {worker} has {versions}, this machine has {here}: results would not be the same")


def worker_versions() -> dict[str, str]:
    """What must be alike for the same results: this program, and what computes for it."""
    import scipy

    return {"uvgs_bench": __version__, "numpy": np.__version__, "scipy": scipy.__version__}
