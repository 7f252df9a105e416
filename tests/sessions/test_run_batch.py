"""``uvgs run --batch``: every source once, a bad one stops no other, and what is done stays done."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.cli.app import main
from uvgs_bench.errors import ConfigError
from uvgs_bench.sessions import batch
from uvgs_bench.sessions.batch import RESULTS_FILE, BatchPlan, read_sources, run_batch, source_key
from uvgs_bench.sessions.events import ignore_events
from uvgs_bench.store.beacons import write_beacon
from uvgs_bench.store.calibrations import write_calibration

pytestmark = pytest.mark.opencv


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("batch")
    write_calibration(folder / "camera.yaml", spots.calibration())
    write_beacon(folder / "beacon.toml", spots.beacon())
    rng = np.random.default_rng(7)
    for name, count in (("one", 2), ("two", 3)):
        (folder / "data" / name).mkdir(parents=True)
        for i in range(count):
            pose = spots.random_pose(rng, cone_deg=20.0)
            px = spots.lens().project(pose.apply(spots.beacon().positions_m))
            cv2.imwrite(str(folder / "data" / name / f"p{i}.png"), spots.draw(px, rng))
    return folder


def uvgs(*words: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main(["run", *(str(word) for word in words)])
    return int(caught.value.code or 0)


def setup(folder: Path) -> tuple[object, ...]:
    return "--camera", folder / "camera.yaml", "--beacon", folder / "beacon.toml", "--quiet"


def test_a_list_from_start_to_end_and_again(bench, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(bench)
    (tmp_path / "list.txt").write_text("# mine\nimages:data/t*\n\nimages:missing\n")
    words = ("--batch", tmp_path / "list.txt", *setup(bench), "--out", f"{tmp_path}/p/{{}}.csv", "--workers", 2)
    assert uvgs(*words, "--json") == 4
    told = json.loads(capfd.readouterr().out)
    rows = {row["source"]: row for row in told["sources"]}
    assert list(rows) == ["images:data/two", "images:missing"]
    assert [row["code"] for row in rows.values()] == [0, 4]
    assert [(row["captures"], row["poses"]) for row in rows.values()] == [(3, 3), (0, 0)]
    assert "no such folder" in rows["images:missing"]["error"]
    assert (told["done"], told["were_done"], told["failed"], told["poses"]) == (1, 0, 1, 3)
    # A source by itself gives the same lines.
    assert uvgs("images:data/two", *setup(bench), "--out", tmp_path / "two.csv") == 0
    assert (tmp_path / "two.csv").read_bytes() == (tmp_path / "p" / "two.csv").read_bytes()
    before = (tmp_path / "p" / "two.csv").stat().st_mtime_ns
    capfd.readouterr()
    assert uvgs(*words) == 4
    table = capfd.readouterr().out
    assert "1 of 2 sources done, 3 of 3 captures with a pose" in table
    assert table.count("done before") == 1
    assert (tmp_path / "p" / "two.csv").stat().st_mtime_ns == before


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_dask_cluster_does_the_same(bench, tmp_path, monkeypatch, capfd):
    distributed = pytest.importorskip("distributed")
    monkeypatch.chdir(bench)
    (tmp_path / "list.txt").write_text("images:data/one\nimages:data/two\n")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as cluster:
        words = ("--batch", tmp_path / "list.txt", *setup(bench), "--out", tmp_path / "p")
        assert uvgs(*words, "--scheduler", cluster.scheduler_address, "--json") == 0
    assert json.loads(capfd.readouterr().out)["poses"] == 5
    assert uvgs("images:data/two", *setup(bench), "--out", tmp_path / "two.csv") == 0
    assert (tmp_path / "two.csv").read_bytes() == (tmp_path / "p" / "two.csv").read_bytes()


def test_ctrl_c_ends_the_sources_that_run_and_keeps_the_list(bench, tmp_path):
    # Live, it never ends by itself.
    (tmp_path / "list.txt").write_text("images:data/one\nendless:1\n")
    code = (
        "import sys\n"
        "from uvgs_bench.cli import app\n"
        "from uvgs_bench.sessions import batch\n"
        "real = batch.subprocess.Popen\n"
        "def popen(words, **more):\n"
        "    if 'endless:1' in words:\n"
        "        words = [sys.executable, '-c', 'import time; time.sleep(60)']\n"
        "    return real(words, **more)\n"
        "batch.subprocess.Popen = popen\n"
        "app.main(sys.argv[1:])\n"
    )
    words = ["run", "--batch", tmp_path / "list.txt", *setup(bench), "--out", tmp_path / "p", "--workers", "2"]
    running = subprocess.Popen(
        [sys.executable, "-c", code, *map(str, words)], cwd=bench, stderr=subprocess.PIPE, text=True
    )
    listed = tmp_path / "p" / RESULTS_FILE
    for _ in range(2000):
        if listed.exists() and '"result"' in listed.read_text():
            break
        time.sleep(0.1)
    os.kill(running.pid, signal.SIGINT)
    # Far less than the minute the endless one would take.
    _, said = running.communicate(timeout=30)
    assert running.returncode == 130
    assert "Traceback" not in said.split("KeyboardInterrupt")[-1]
    rows = [json.loads(line) for line in listed.read_text().splitlines()]
    assert [row["result"]["source"] for row in rows if "result" in row] == ["images:data/one"]


@pytest.fixture
def fake(monkeypatch):
    """Runs that only write their files; what fails is said by the source's name."""
    ran: list[tuple[str, ...]] = []

    def run(words, folder):
        ran.append(tuple(words))
        code = 5 if "lost" in words[1] else 4 if "bad" in words[1] else 0
        outs = [words[i + 1] for i, word in enumerate(words) if word == "--out"]
        for out in outs:
            path = Path(folder) / out
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.exists() and "--force" not in words:
                return {"code": 2, "error": "exists already"}
            path.write_text(words[1])
        if code:
            return {"code": code, "error": "went wrong"}
        return {"code": 0, "captures": 1, "poses": 1, "held": 0, "misses": {}, "written": tuple(outs)}

    monkeypatch.setattr(batch, "run_source", run)
    return ran


def go(sources, plan=None, **more):
    plan = plan or BatchPlan((), (("--out", "p/{}.csv"),))
    return run_batch(sources, plan, ignore_events, workers=2, **more)


def test_sources_of_one_name_get_files_of_their_own(fake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in "abz":
        Path(name).mkdir()
        (Path(name) / "run.bag").write_text(name)
    results = go(["bag:a/run.bag", "bag:b/run.bag", "b/run.mcap", "rtsp://host/cam one"])
    assert [result.outputs[0] for result in results[:3]] == ["p/run.csv", "p/b_run.csv", "p/b_run_2.csv"]
    assert len({result.outputs for result in results}) == 4
    # A longer list leaves the names of what is done.
    more = go(["bag:z/run.bag", "bag:a/run.bag", "bag:b/run.bag"])
    assert [result.outputs[0] for result in more] == ["p/z_run.csv", "p/run.csv", "p/b_run.csv"]
    assert [result.was_done for result in more] == [False, True, True]


def test_what_changed_is_done_again_and_nothing_else(fake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a.bag").write_bytes(b"1")
    Path("b.bag").write_bytes(b"2")
    Path("camera.yaml").write_text("x")
    plan = BatchPlan(("--camera", "camera.yaml"), (("--out", "p/{}.csv"),), ("camera.yaml",))
    go(["a.bag", "b.bag"], plan)
    assert len(fake) == 2
    go(["a.bag", "b.bag"], plan)
    assert len(fake) == 2
    Path("a.bag").write_bytes(b"11")
    go(["a.bag", "b.bag"], plan)
    assert [words[1] for words in fake[2:]] == ["a.bag"]
    Path("p/b.csv").unlink()
    go(["a.bag", "b.bag"], plan)
    assert [words[1] for words in fake[3:]] == ["b.bag"]
    key = source_key("a.bag", plan)
    Path("camera.yaml").write_text("y")
    assert source_key("a.bag", plan) != key
    assert source_key("a.bag", BatchPlan(("--track",), plan.outputs)) != source_key("a.bag", plan)
    go(["a.bag", "b.bag"], plan)
    assert len(fake) == 6
    go(["a.bag"], plan, force=True)
    assert len(fake) == 7


def test_what_may_be_other_pictures_the_next_time_is_never_done(fake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("bench.toml").write_text("")
    sources = ["uvc:0", "sim:bench.toml?count=3", "rtsp://me:secret@host/cam"]
    assert [source_key(source, BatchPlan((), (("--out", "p/{}.csv"),))) for source in sources] == [""] * 3
    for _ in range(2):
        assert [result.was_done for result in go(sources)] == [False] * 3
    assert len(fake) == 6
    assert "rtsp://me:secret@host/cam" in fake[2]
    assert "secret" not in (Path("p") / RESULTS_FILE).read_text()


def test_failures_are_tried_again_and_their_files_replaced_but_no_others(fake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("bad.bag", "mine.bag", "good.bag"):
        Path(name).write_text(name)
    Path("p").mkdir()
    Path("p/mine.csv").write_text("mine")
    results = go(["bad.bag", "mine.bag", "good.bag"])
    assert [result.code for result in results] == [4, 2, 0]
    assert Path("p/mine.csv").read_text() == "mine"
    again = go(["bad.bag", "mine.bag", "good.bag"])
    assert [(result.code, result.was_done) for result in again] == [(4, False), (2, False), (0, True)]


def test_a_torn_last_line_is_dropped_and_other_files_are_refused(fake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a.bag").write_text("a")
    Path("b.bag").write_text("b")
    go(["a.bag", "b.bag"])
    listed = Path("p") / RESULTS_FILE
    listed.write_text(listed.read_text()[:-20])
    results = go(["a.bag", "b.bag"])
    assert sorted(result.was_done for result in results) == [False, True]
    assert all(json.loads(line) for line in listed.read_text().splitlines())
    listed.write_text("something else\n")
    with pytest.raises(ConfigError, match="line 1 is no result of a batch"):
        go(["a.bag"])


def test_lists(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a.bag", "b.bag", "c[1].bag", "d.mcap"):
        Path(name).write_text("")
    text = "*.bag\nd.mcap\nd.mcap\nc[1].bag\nimages:.?glob=left*.png\n  # no\nuvc:0\nrtsp://h/*\nbag:?.bag\n"
    Path("list").write_text(text)
    assert read_sources(Path("list")) == (
        "a.bag", "b.bag", "c[1].bag", "d.mcap", "images:.?glob=left*.png", "uvc:0", "rtsp://h/*", "bag:?.bag",
    )  # fmt: skip
    Path("list").write_text("a.bag\n*.db3\n")
    with pytest.raises(ConfigError, match=r"list:2: nothing matches '\*\.db3'"):
        read_sources(Path("list"))
    Path("list").write_text("\n# none\n")
    with pytest.raises(ConfigError, match="names no source"):
        read_sources(Path("list"))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("images:x",), "the sources are in the list"),
        (("--udp", "h:1"), "--udp: is for one source at a time"),
        (("--record", "r.mcap"), "--record: needs {} for the name"),
        (("--out", "p.csv"), "expected a folder, or a path with {}"),
        (("--handover", "command"), "--handover: command reads standard input"),
        (("--workers", 2, "--scheduler", "tcp://h:1"), "the scheduler knows its workers"),
        (("--scheduler", "h:1"), "must be an address like tcp://host:8786"),
    ],
)
def test_what_cannot_be_meant_for_many_is_one_line(bench, tmp_path, monkeypatch, capfd, words, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "list.txt").write_text("images:missing\n")
    out = () if "--out" in words else ("--out", "p")
    assert uvgs("--batch", "list.txt", *setup(bench), *out, *words) == 2
    assert said in " ".join(capfd.readouterr().err.split())
    assert not (tmp_path / "p" / RESULTS_FILE).exists()


def test_options_of_a_batch_need_one(bench, tmp_path, capfd):
    for words, said in (
        (("images:x", *setup(bench), "--out", "p.csv", "--workers", 2), "--workers: is for --batch"),
        ((*setup(bench), "--out", "p.csv"), "SOURCE: is needed"),
        (("--batch", tmp_path / "none.txt", *setup(bench), "--out", "p"), "no such file"),
        (("--batch", tmp_path / "none.txt", *setup(bench)), "--out: is needed"),
    ):
        assert uvgs(*words) in (2, 4)
        assert said in " ".join(capfd.readouterr().err.split())


def test_what_a_run_warns_of_is_not_hidden_by_the_batch():
    said = "warning: bag: 3 chunks are damaged\nwarning: bag: 3 chunks are damaged\ninfo: x\nwarning: cores clip\n"
    summary = {"captures": 3, "poses": 2, "held": 0, "misses": {}, "out": "p.csv", "failures": []}
    facts = batch._facts(0, json.dumps(summary), said)
    assert facts["warnings"] == ("bag: 3 chunks are damaged", "cores clip")
    assert (facts["error"], facts["written"]) == ("", ("p.csv",))
    assert batch._facts(4, "", "warning: w\nerror: no such file\n")["error"] == "no such file"
    assert batch._facts(4, json.dumps(summary | {"failures": ["r.mcap: full"]}), "")["error"] == "r.mcap: full"
    assert batch._facts(-9, "", "")["error"] == "its process was ended by SIGKILL"
    assert batch._facts(70, "", "Traceback\nKeyError: 1\n")["error"] == "KeyError: 1"


def test_the_exit_code_of_the_whole():
    from uvgs_bench.cli.batch import _code
    from uvgs_bench.sessions.batch import SourceResult

    def code(*each: tuple[int, int]) -> int:
        return int(_code([SourceResult("s", "", (), code, poses=poses) for code, poses in each]))

    assert code((0, 5), (0, 1)) == 0
    assert code((0, 5), (3, 0)) == 3
    assert code((0, 5), (5, 0)) == code((5, 0), (5, 0), (3, 0)) == 5
    assert code((5, 0), (4, 0)) == code((-9, 0)) == code((70, 0)) == 4
