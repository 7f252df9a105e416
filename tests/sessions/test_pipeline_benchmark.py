"""``uvgs benchmark pipeline``: every row is there, each against the peer of the same run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from uvgs_bench.cli.app import main
from uvgs_bench.sessions import benchmark
from uvgs_bench.sessions.process_cost import ProcessCost

pytestmark = pytest.mark.opencv
WHOLES = ["whole picture", "tracked", "colour", "12 lights"]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two processes take seconds; what they measure is proved beside them."""
    monkeypatch.setattr(benchmark, "first_pose_cost", lambda *_: ProcessCost(0.9, 0.8, 170_000_000))
    monkeypatch.setattr(benchmark, "run_cost", lambda *_: None)
    # A test process is not a run.
    monkeypatch.setattr(benchmark.gc, "freeze", lambda: None)


def uvgs(*words: str) -> int:
    with pytest.raises(SystemExit) as caught:
        main(["benchmark", "pipeline", *words])
    return int(caught.value.code or 0)


@pytest.mark.usefixtures("quick")
def test_the_figures_of_a_short_run_belong_together(
    pytestconfig: pytest.Config, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = str(Path(pytestconfig.rootpath) / "calib" / "bench.toml")
    assert uvgs("--bench", bench, "--captures", "2", "--json", "-q") == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["captures"], said["poses"], said["tracked_poses"], said["crowded_poses"]) == (2, 2, 2, 2)
    assert list(said["peer_over_uvgs"]) == WHOLES
    stages = said["stages"]
    for name in WHOLES:
        assert 0.0 < stages[name]["p10_s"] <= stages[name]["median_s"] <= stages[name]["p99_s"]
        assert said["peer_over_uvgs"][name] == pytest.approx(stages["cv2.aruco"]["median_s"] / stages[name]["median_s"])
    assert said["processes"] == {"first_pose": {"wall_s": 0.9, "cpu_s": 0.8, "peak_bytes": 170_000_000}, "run": None}


@pytest.mark.usefixtures("quick")
def test_the_table_names_what_was_measured(pytestconfig: pytest.Config, capsys: pytest.CaptureFixture[str]) -> None:
    bench = str(Path(pytestconfig.rootpath) / "calib" / "bench.toml")
    assert uvgs("--bench", bench, "--captures", "1", "-q") == 0
    page = " ".join(capsys.readouterr().out.split())
    for words in (*WHOLES, "cv2.aruco /", "first pose, in a process of its own: 0.90 s", "a run: failed"):
        assert words in page
