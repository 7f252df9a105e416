"""Many sources through ``uvgs run``, one process each: what is done is not done again, and a bad one stops no other.

A source is done when it was solved before with the same options, documents, file sizes and times; cameras and simulated
benches are never done. Each runs as a command of its own, here or where a Dask scheduler puts it: no memory, thread or
crash of one reaches another. On a cluster the files must be at the same paths on every machine.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from glob import glob, has_magic
from itertools import chain, count
from pathlib import Path
from typing import Any, TextIO

from uvgs_bench import __version__
from uvgs_bench.devices.cameras.network import without_password
from uvgs_bench.errors import ConfigError, ExitCode, UvgsError
from uvgs_bench.sessions.events import EventSink, StageAdvanced, StageFinished, StageStarted
from uvgs_bench.sessions.interruption import interruptible
from uvgs_bench.sessions.study_runner import THREAD_VARIABLES, open_cluster
from uvgs_bench.store.documents import read_text

RESULTS_FILE = "batch.jsonl"
NAME = "{}"
"""Stands for the name of the source in the path of an output."""

_SCHEME = re.compile(r"[a-z][a-z0-9+]*:(?!//)")
_MOST_WARNINGS = 20
_DONE = (ExitCode.DONE, ExitCode.INCONCLUSIVE)


@dataclass(frozen=True, slots=True)
class BatchPlan:
    """What is to be done with every source.

    Args:
        options: Words of ``uvgs run`` that are the same for all, outputs left out.
        outputs: Option and path of each output, with ``{}`` where the name of the source goes.
        documents: Files the options name; their contents decide whether something must be done again.
    """

    options: tuple[str, ...]
    outputs: tuple[tuple[str, str], ...]
    documents: tuple[str, ...] = ()

    @property
    def folder(self) -> Path:
        """Where the results are listed: the last folder that all sources share in the first output."""
        path = Path(self.outputs[0][1])
        shared = next(parent for parent in path.parents if NAME not in str(parent))
        return Path(shared)


@dataclass(frozen=True, slots=True)
class SourceResult:
    """What became of one source.

    Args:
        source: As in the list, without a password.
        key: What it was solved with, as a hash; empty when it may be other pictures the next time.
        outputs: Files and folders that were asked for.
        written: Files that were written.
        code: Exit code of its run.
        captures: Captures solved.
        poses: Poses found.
        held: Poses repeated.
        misses: Misses by ``stage/reason``.
        error: Why it failed, in one line; empty when it did not.
        warnings: What its run warned of: damage, lights that clip, cameras that did not obey.
        was_done: Whether it was done by an earlier batch.
    """

    source: str
    key: str
    outputs: tuple[str, ...]
    code: int
    written: tuple[str, ...] = ()
    captures: int = 0
    poses: int = 0
    held: int = 0
    misses: dict[str, int] = field(default_factory=dict)
    error: str = ""
    warnings: tuple[str, ...] = ()
    was_done: bool = False

    @property
    def is_done(self) -> bool:
        """Whether it was solved to its end, with poses or without."""
        return self.code in _DONE


def read_sources(path: Path) -> tuple[str, ...]:
    """Read the list of a batch.

    Args:
        path: A text file with one source a line, as ``uvgs run`` takes it; ``*``, ``?`` and ``[]`` in paths are filled
            in; empty lines and those that begin with # are left out. Paths are relative to where the command runs.

    Returns:
        The sources, each once.

    Raises:
        UnreadableDocument: It cannot be read.
        ConfigError: It names no source, or a pattern that nothing matches.
    """
    found: dict[str, None] = {}
    for number, line in enumerate(read_text(path, "a list of sources").splitlines(), 1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        match = _SCHEME.match(text)
        scheme = match[0] if match else ""
        # With a scheme, a question mark begins the options.
        target, mark, query = text[len(scheme) :].partition("?") if scheme else (text, "", "")
        if has_magic(target) and not Path(target).exists() and "://" not in target:
            names = sorted(glob(target, recursive=True))
            if not names:
                raise ConfigError(f"nothing matches '{target}'", f"{path}:{number}")
            found |= dict.fromkeys(f"{scheme}{name}{mark}{query}" for name in names)
        else:
            found[text] = None
    if not found:
        raise ConfigError("names no source", str(path))
    return tuple(found)


def run_batch(
    sources: Sequence[str],
    plan: BatchPlan,
    sink: EventSink,
    *,
    workers: int,
    scheduler: str | None = None,
    force: bool = False,
) -> list[SourceResult]:
    """Solve every source that is not done.

    Args:
        sources: The sources.
        plan: What is done with each.
        sink: Where progress goes.
        workers: Processes at a time on this machine; not used with a scheduler.
        scheduler: Address of a Dask scheduler, or None.
        force: Whether to do again what is done, and to replace files that are none of this batch.

    Returns:
        One result per source in the order of the list.

    Raises:
        ConfigError: The list of results is none.
        UvgsError: It cannot be written, or there is no cluster.
        KeyboardInterrupt: After Ctrl-C; what is done is kept.
    """
    listed = plan.folder / RESULTS_FILE
    before = _Before(listed)
    keys = {source: source_key(source, plan) for source in sources}
    results: dict[str, SourceResult] = {}
    for source, key in keys.items():
        known = before.done.get(key)
        if known is not None and key and not force and all(Path(name).exists() for name in known.written):
            results[source] = known
    missing = [source for source in sources if source not in results]
    taken = {name for result in results.values() for name in result.outputs}
    sink(StageStarted("sources", len(sources)))
    if results:
        sink(StageAdvanced("sources", len(results), f"{len(results)} were done before"))
    if missing:
        with interruptible(), _pool(workers, scheduler) as pool, _opened(listed) as stream:
            waiting: dict[Future[dict[str, Any]], tuple[str, tuple[str, ...]]] = {}
            for source in missing:
                outputs = _outputs(source, plan, taken)
                taken.update(outputs)
                strangers = [name for name in outputs if Path(name).exists() and name not in before.begun]
                may_replace = force or not strangers
                if may_replace:
                    _note(stream, {"begun": list(outputs), "source": without_password(source)})
                words = _words(source, plan, outputs, may_replace)
                waiting[pool.submit(run_source, words, str(Path.cwd()))] = source, outputs
            while waiting:
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    source, outputs = waiting.pop(future)
                    shown = without_password(source)
                    result = SourceResult(shown, keys[source], outputs, **future.result())
                    _note(stream, {"result": asdict(result)})
                    results[source] = result
                    said = result.error or f"{result.poses} of {result.captures} captures with a pose"
                    sink(StageAdvanced("sources", len(results), f"{shown}: {said}"))
    failed = sum(not result.is_done for result in results.values())
    sink(StageFinished("sources", f"{len(sources)} sources, {failed} failed"))
    return [results[source] for source in sources]


def run_source(words: Sequence[str], folder: str) -> dict[str, Any]:
    """Solve one source; runs in a thread here, or in a worker of a cluster.

    Args:
        words: Of ``uvgs``.
        folder: Where to run.

    Returns:
        ``code``, the counts, ``error`` and ``warnings``.
    """
    environment = os.environ | dict.fromkeys(THREAD_VARIABLES, "1")
    # In a session of its own: Ctrl-C at the terminal reaches it once, through the batch.
    process = subprocess.Popen(  # noqa: S603  (this program itself, without a shell)
        [sys.executable, "-m", "uvgs_bench", *words],
        cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        start_new_session=True,
    )  # fmt: skip
    with _running_lock:
        _running.add(process)
        if _is_stopping.is_set():
            process.send_signal(signal.SIGINT)
    out, said = process.communicate()
    with _running_lock:
        _running.discard(process)
    return _facts(process.returncode, out.decode(errors="replace"), said.decode(errors="replace"))


def source_key(source: str, plan: BatchPlan) -> str:
    """What the poses of a source depend on, as a hash: its files by size and time, options, documents, version.

    Args:
        source: The source.
        plan: What is done with it.

    Returns:
        The hash; empty for a camera, or a bench that names further files.
    """
    if source.startswith(("sim:", "sim-board:")):
        return ""
    target = _SCHEME.sub("", source, count=1).partition("?")[0]
    files: list[tuple[str, int, int]] = []
    for text in dict.fromkeys((target, *target.split(","))):
        path = Path(text)
        inside = sorted(path.rglob("*")) if path.is_dir() else [path]
        files += [
            (str(file), found.st_size, found.st_mtime_ns)
            for file in inside
            if text and file.is_file() and (found := file.stat())
        ]
    if not files:
        return ""
    contents = []
    for name in plan.documents:
        path = Path(name)
        contents.append(hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None)
    facts = [__version__, source, files, plan.options, plan.documents, contents, plan.outputs]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:32]


class _Before:
    """What earlier batches left in the list of results."""

    def __init__(self, listed: Path) -> None:
        self.done: dict[str, SourceResult] = {}
        self.begun: set[str] = set()
        if not listed.exists():
            return
        text = read_text(listed, "the results of a batch")
        # The last line is torn when the program was killed while it wrote it.
        for number, line in enumerate(text[: text.rfind("\n") + 1].splitlines(), 1):
            try:
                row = json.loads(line)
                self.begun.update(row.get("begun", ()))
                if "result" in row:
                    entry = row["result"]
                    lists = {name: tuple(entry[name]) for name in ("outputs", "written", "warnings")}
                    result = SourceResult(**(entry | lists | {"was_done": True}))
                    if result.is_done:
                        self.done[result.key] = result
            except (ValueError, TypeError, KeyError, AttributeError):
                raise ConfigError(f"line {number} is no result of a batch", str(listed)) from None
        if len(text) > text.rfind("\n") + 1:
            os.truncate(listed, len(text[: text.rfind("\n") + 1].encode()))


def _outputs(source: str, plan: BatchPlan, taken: set[str]) -> tuple[str, ...]:
    """Paths of the outputs of a source, with a name no other source has."""
    target = Path(_SCHEME.sub("", source, count=1).partition("?")[0].rstrip("/") or "source")
    stem = _word(target.stem)
    parent = _word(target.absolute().parent.name)
    for name in chain((stem, f"{parent}_{stem}"), (f"{parent}_{stem}_{k}" for k in count(2))):
        outputs = tuple(path.replace(NAME, name) for _, path in plan.outputs)
        if not taken & set(outputs):
            return outputs
    raise AssertionError("names never run out")


def _word(text: str) -> str:
    return re.sub(r"[^\w.-]+", "_", text).strip("._") or "source"


def _words(source: str, plan: BatchPlan, outputs: tuple[str, ...], may_replace: bool) -> tuple[str, ...]:
    named = [word for (option, _), path in zip(plan.outputs, outputs, strict=True) for word in (option, path)]
    return "run", source, *plan.options, *named, "--json", "--quiet", *(("--force",) if may_replace else ())


def _facts(code: int, out: str, said: str) -> dict[str, Any]:
    try:
        summary = json.loads(out)
        counts = {name: summary[name] for name in ("captures", "poses", "held", "misses")}
        written = summary["out"]
        counts["written"] = (written,) if isinstance(written, str) else tuple(written)
        failures = summary.get("failures", [])
    except (ValueError, KeyError, TypeError):
        counts, failures = {}, []
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    warnings = dict.fromkeys(line.removeprefix("warning: ")[:400] for line in lines if line.startswith("warning: "))
    if code < 0:
        error = f"its process was ended by {signal.Signals(-code).name}"
    elif code in _DONE:
        error = ""
    else:
        error = (failures or [line for line in lines if line.startswith("error:")] or lines or [f"exit code {code}"])[
            -1
        ]
    told = tuple(warnings)[:_MOST_WARNINGS]
    return {"code": code, **counts, "error": error.removeprefix("error: ")[:400], "warnings": told}


def _note(stream: TextIO, row: dict[str, Any]) -> None:
    try:
        stream.write(json.dumps(row) + "\n")
        stream.flush()
    except OSError as error:
        raise UvgsError(f"{stream.name}: cannot be written: {error.strerror or error}") from None


@contextmanager
def _opened(listed: Path) -> Iterator[TextIO]:
    try:
        listed.parent.mkdir(parents=True, exist_ok=True)
        stream = listed.open("a", encoding="utf-8")
    except OSError as error:
        raise UvgsError(f"{listed}: cannot be written: {error.strerror or error}") from None
    with stream:
        yield stream


# Processes of this batch; one batch runs at a time.
_running: set[subprocess.Popen[bytes]] = set()
_running_lock = threading.Lock()
_is_stopping = threading.Event()


@contextmanager
def _pool(workers: int, scheduler: str | None) -> Iterator[Executor]:
    if scheduler is not None:
        with open_cluster(scheduler) as (pool, _):
            yield pool
        return
    _is_stopping.clear()
    pool = ThreadPoolExecutor(workers, thread_name_prefix="source")
    try:
        yield pool
    except BaseException:
        # Each ends as after one Ctrl-C of its own: what it wrote is kept.
        with _running_lock:
            _is_stopping.set()
            for process in _running:
                process.send_signal(signal.SIGINT)
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
