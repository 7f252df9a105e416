"""Studies: the same table however the work was shared out, killed, or taken up again."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

import uvgs_bench.cli.app as cli
from uvgs_bench.errors import ConfigError, UvgsError
from uvgs_bench.sessions.events import Event, StageAdvanced, ignore_events
from uvgs_bench.sessions.study import STUDIES, run_study
from uvgs_bench.sessions.study_runner import RESULTS_FILE, Work, one_bench, run_benches

ROOT = Path(__file__).resolve().parents[2]
TOY = Work("tests.helpers.toy_study:toy_bench", 5, {"scale": 2.0})
COUNT = 12


def by_hand(count: int = COUNT, work: Work = TOY) -> list[dict[str, Any]]:
    return [one_bench(work.task, work.seed, k, work.settings) for k in range(count)]


def done(path: Path, count: int = COUNT, work: Work = TOY, **options: Any) -> list[dict[str, Any]]:
    return run_benches(
        work, count, path, options.pop("sink", ignore_events), workers=options.pop("workers", 1), **options
    )


def test_one_and_two_workers_say_the_same(tmp_path: Path) -> None:
    one = done(tmp_path / "one.jsonl", workers=1)
    two = done(tmp_path / "two.jsonl", workers=2)
    assert one == two == by_hand()
    assert len({row["drawn"] for row in one}) == COUNT


def test_another_seed_says_something_else() -> None:
    other = Work(TOY.task, 6, TOY.settings)
    assert all(a["drawn"] != b["drawn"] for a, b in zip(by_hand(3), by_hand(3, other), strict=True))


def test_a_torn_file_is_taken_up_where_it_ended(tmp_path: Path) -> None:
    path = tmp_path / RESULTS_FILE
    whole = done(path)
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:6]) + lines[6][:9])
    advanced: list[Event] = []
    again = done(path, resume=True, sink=advanced.append)
    assert again == whole
    assert next(event.done for event in advanced if isinstance(event, StageAdvanced)) == 5
    numbers = [json.loads(line)["bench"] for line in path.read_text().splitlines()[1:]]
    assert sorted(numbers) == list(range(COUNT)), "no bench twice, none missing"


def test_more_benches_may_be_asked_for_later(tmp_path: Path) -> None:
    path = tmp_path / RESULTS_FILE
    few = done(path, 4)
    assert done(path, COUNT, resume=True)[:4] == few
    assert done(path, 3, resume=True) == few[:3]


def test_a_dead_worker_loses_nothing_that_was_done(tmp_path: Path) -> None:
    flag, path = tmp_path / "flag", tmp_path / RESULTS_FILE
    flag.touch()
    work = Work("tests.helpers.toy_study:deadly_bench", 5, {"flag": str(flag)})
    with pytest.raises(UvgsError, match=r"a worker process died.*--resume"):
        done(path, work=work)
    kept = path.read_text().splitlines()[1:]
    assert len(kept) < COUNT
    flag.unlink()
    assert [row["drawn"] for row in done(path, work=work, resume=True)] == [
        row["drawn"] for row in by_hand(work=Work("tests.helpers.toy_study:toy_bench", 5, {}))
    ]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "is empty"),
        ("nonsense\n", "line 1 is no result"),
        ('{"schema": 1}\n', "another study, task None"),
        (json.dumps(Work(TOY.task, 6, TOY.settings).header()) + "\n", "another study, seed 6, now 5"),
        (json.dumps(TOY.header()) + '\n{"drawn": 1}\n', "line 2 names no bench"),
    ],
)
def test_strange_results_are_refused_by_name(tmp_path: Path, content: str, said: str) -> None:
    path = tmp_path / RESULTS_FILE
    path.write_text(content)
    with pytest.raises(ConfigError, match=said) as caught:
        done(path, resume=True)
    assert str(path) in str(caught.value)
    assert path.read_text() == content, "a file that is refused stays as it was"


def test_results_are_not_replaced_unasked(tmp_path: Path) -> None:
    path = tmp_path / RESULTS_FILE
    done(path, 1)
    with pytest.raises(ConfigError, match=r"--resume goes on with it, --force replaces it"):
        done(path, 1)
    assert done(path, 2, force=True) == by_hand(2)


def test_a_killed_study_gives_the_table_of_an_unbroken_one(tmp_path: Path) -> None:
    """The command itself, interrupted in the middle by Ctrl-C, then taken up again."""
    folder = tmp_path / "study"
    command = [sys.executable, "-m", "uvgs_bench", "study", "planning", "--benches", "1", "--workers", "1", "--json"]
    command += ["--out", str(folder)]
    first = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    results = folder / RESULTS_FILE
    deadline = time.monotonic() + 120.0
    while not (results.exists() and results.read_bytes().count(b"\n") >= 3) and time.monotonic() < deadline:
        time.sleep(0.02)
    # To the whole group, as a terminal sends it.
    os.killpg(first.pid, signal.SIGINT)
    _, said = first.communicate(timeout=120)
    assert first.returncode == 130, said
    assert "go on with --resume" in said
    kept = results.read_bytes().count(b"\n") - 1
    assert 2 <= kept < STUDIES["planning"].kinds
    again = subprocess.run([*command, "--resume"], cwd=ROOT, capture_output=True, text=True, check=False, timeout=240)
    assert again.returncode == 0, again.stderr
    unbroken = run_study("planning", 1, 0, tmp_path / "other", ignore_events, workers=2)
    shares = json.loads(again.stdout)["shares"]
    assert [(s["name"], s["hits"], s["count"], s["note"]) for s in shares] == [
        (s.name, s.hits, s.count, s.note) for s in unbroken.shares
    ]


@pytest.mark.filterwarnings("default")
def test_a_dask_cluster_says_the_same(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as cluster:
        address = cluster.scheduler_address
        found = done(tmp_path / RESULTS_FILE, scheduler=address)
        # A study's own task as well: a clean bench and one with a planted cause.
        real = Work(STUDIES["diagnosis"].task, 3, {})
        spread = done(tmp_path / "spread.jsonl", 2, real, scheduler=address)
    assert found == by_hand()
    assert spread == done(tmp_path / "here.jsonl", 2, real)
    assert [row["kind"] for row in spread] == ["clean", "led_offset"]


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["coverag"], 2, "unknown study 'coverag', expected one of coverage, diagnosis, planning"),
        (["coverage", "--benches", "0"], 2, "--benches"),
        (["coverage", "--resume", "--force"], 2, "either go on with the results"),
        (["coverage", "--scheduler", "host:8786"], 2, "must be an address like tcp://host:8786"),
        (["coverage", "--scheduler", "tcp://127.0.0.1:1"], 4, "no Dask scheduler answers at tcp://127.0.0.1:1"),
        (["coverage", "--scheduler", "tcp://x:1", "--workers", "2"], 2, "the scheduler knows its workers"),
    ],
)
@pytest.mark.filterwarnings("default")
def test_wrong_input_is_one_line(
    arguments: list[str],
    code: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "COMMANDS", {"study": cli.COMMANDS["study"], "doctor": cli.COMMANDS["doctor"]})
    monkeypatch.setattr("uvgs_bench.sessions.study_runner._ANSWER_S", 1)
    with pytest.raises(SystemExit) as left:
        cli.main(["study", *arguments])
    assert left.value.code == code
    assert said in " ".join(capsys.readouterr().err.split())


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UvgsError, match="cannot be written"):
        done(tmp_path / "file" / RESULTS_FILE)
