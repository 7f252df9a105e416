"""``uvgs gantry`` as typed: what it prints, its exit codes, and that Ctrl-C stops the motion first."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from uvgs_bench.cli import app as cli
from uvgs_bench.devices.clock import RealClock
from uvgs_bench.devices.gantry.grbl import GrblGantry
from uvgs_bench.devices.gantry.grbl_link import GrblLink

ROOT = Path(__file__).resolve().parents[2]
BENCH = """
schema = 1
name = "small"
camera = "camera.yaml"
beacon = "beacon.toml"
[gantry]
port = "grbl:sim://"
homing_timeout_s = 60.0
"""
AXIS = """
[[gantry.axes]]
name = "{name}"
direction = {direction}
min_mm = -100.0
max_mm = 0.0
max_feed_mm_min = 3000.0
acceleration_mm_s2 = 200.0
"""


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    path = tmp_path / "bench.toml"
    axes = {"X": [1.0, 0.0, 0.0], "Y": [0.0, 1.0, 0.0], "Z": [0.0, 0.0, 1.0]}
    path.write_text(BENCH + "".join(AXIS.format(name=n, direction=d) for n, d in axes.items()), encoding="utf-8")
    (tmp_path / "beacon.toml").write_bytes((ROOT / "calib" / "beacons" / "tetra_small.toml").read_bytes())
    return path


@pytest.fixture
def uvgs(bench: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Runs ``uvgs gantry ...`` in this process; gives exit code, stdout and stderr."""
    monkeypatch.setattr(cli, "COMMANDS", {"gantry": cli.COMMANDS["gantry"]})

    def run(*words: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            cli.main(["gantry", *words, "--bench", str(bench), "--sim-speed", "200"])
        printed = capsys.readouterr()
        return int(end.value.code or 0), printed.out, printed.err

    return run


def test_status_says_that_the_position_is_unknown(uvgs) -> None:
    code, printed, _ = uvgs("status")
    assert code == 0
    assert "not homed" in printed
    assert "1.1h" in printed


def test_home_and_move_in_json(uvgs) -> None:
    code, printed, remarks = uvgs("move", "X=-10", "z=-20.5", "--home", "--json")
    assert code == 0
    answer = json.loads(printed)
    assert answer["position"] == {"X_mm": -10.0, "Y_mm": -1.0, "Z_mm": -20.5}
    assert answer["is_trusted"] is True
    assert answer["settings"]["130"] == "100.000"
    assert "homing" in remarks


def test_jog_moves_by_an_offset(uvgs) -> None:
    code, printed, _ = uvgs("jog", "Y=-4", "--home", "--speed-mm-min", "600", "--json")
    assert code == 0
    assert json.loads(printed)["position"] == {"X_mm": -1.0, "Y_mm": -5.0, "Z_mm": -1.0}


def test_a_move_is_recorded_with_times(uvgs, tmp_path: Path) -> None:
    track = tmp_path / "track.csv"
    words = ("move", "X=-51", "--home", "--speed-mm-min", "300", "--record", str(track))
    assert uvgs(*words)[0] == 0
    names, *lines = track.read_text(encoding="utf-8").splitlines()
    assert names == "t_ns,doubt_ns,X_mm,Y_mm,Z_mm"
    rows = [[float(word) for word in line.split(",")] for line in lines]
    assert rows[-1][2:] == [-51.0, -1.0, -1.0]
    assert any(-50.0 < row[2] < -2.0 for row in rows)
    for (t_ns, doubt_ns, x_mm, *_), (next_ns, next_doubt_ns, next_x_mm, *_) in itertools.pairwise(rows):
        assert next_ns > t_ns
        # 300 mm/min is 5 mm/s; the instants are known to their doubts, and a report has a thousandth of a millimetre.
        assert abs(next_x_mm - x_mm) <= 5e-9 * (next_ns - t_ns + doubt_ns + next_doubt_ns) + 0.002
    code, _, said = uvgs(*words)
    assert code == 2
    assert "track.csv: exists already; use --force" in said
    assert "homing" not in said


def test_a_broken_move_is_recorded_too(uvgs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    track = tmp_path / "track.csv"

    def interrupted(gantry: GrblGantry, *_rest: object) -> None:
        gantry.state()
        raise KeyboardInterrupt

    monkeypatch.setattr(GrblGantry, "move_to", interrupted)
    code, _, said = uvgs("jog", "X=-5", "--home", "--record", str(track))
    assert code == 130
    assert "the gantry was stopped" in said
    assert len(track.read_text(encoding="utf-8").splitlines()) == 2


@pytest.mark.parametrize(
    ("words", "code", "expected"),
    [
        (("move", "X=-10"), 2, "add --home"),
        (("move", "X=-100.5", "--home"), 2, "axis X at -100.500 mm is outside its envelope -100.000 mm to 0.000 mm"),
        (("jog", "X=2", "--home"), 2, "axis X at 1.000 mm is outside"),
        (("move", "Q=1", "--home"), 2, "expected X=VALUE Y=VALUE Z=VALUE, got 'Q=1'"),
        (("move", "X=ten", "--home"), 2, "must be a number"),
        (("move", "X=nan", "--home"), 2, "must be a number"),
        (("move", "X=-1", "x=-2", "--home"), 2, "given twice"),
        (("status", "--port", "grbl:/dev/ttyNOT_THERE"), 5, "/dev/ttyNOT_THERE: no such port"),
        (("status", "--port", "gbrl:/dev/ttyACM0"), 2, "did you mean grbl:"),
    ],
)
def test_bad_words_are_one_clear_line(uvgs, words: tuple[str, ...], code: int, expected: str) -> None:
    got, printed, remarks = uvgs(*words)
    assert (got, printed) == (code, "")
    assert expected in remarks
    assert "Traceback" not in remarks


def test_a_refused_move_does_not_open_the_port(uvgs, monkeypatch: pytest.MonkeyPatch) -> None:
    """Opening would reset a controller that is perhaps homed and under another program's care."""
    opened: list[str] = []
    monkeypatch.setattr(GrblGantry, "open", lambda *words, **_options: opened.append(str(words)))
    assert uvgs("move", "X=-10")[0] == 2
    assert uvgs("move", "X=10", "--home")[0] == 2
    assert not opened


def test_stop(uvgs) -> None:
    code, printed, _ = uvgs("stop", "--json")
    assert code == 0
    assert json.loads(printed)["controller_answered"] is True


def test_stop_without_an_answer_is_a_hardware_failure(uvgs, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(GrblLink, "await_welcome", lambda _: [])
    code, printed, _ = uvgs("stop")
    assert code == 5
    assert "look at the machine" in printed


def test_interruption_stops_first(uvgs, monkeypatch: pytest.MonkeyPatch) -> None:
    stops: list[str] = []
    stop = GrblGantry.stop

    def interrupt(*_arguments: object) -> None:
        raise KeyboardInterrupt

    def record(gantry: GrblGantry) -> object:
        state = stop(gantry)
        stops.append(state.activity)
        return state

    monkeypatch.setattr(GrblGantry, "_await_arrival", interrupt)
    monkeypatch.setattr(GrblGantry, "stop", record)
    code, _, _ = uvgs("move", "X=-90", "--home")
    assert code == 130
    assert stops == ["Idle"]


def test_a_real_interrupt_signal_gives_130(bench: Path) -> None:
    program = (
        "import sys\n"
        "from uvgs_bench.cli import app\n"
        "app.COMMANDS = {'gantry': app.COMMANDS['gantry']}\n"
        "app.main(sys.argv[1:])\n"
    )
    words = ["gantry", "home", "--bench", str(bench), "--sim-speed", "1"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NO_COLOR": "1"}
    with subprocess.Popen(
        [sys.executable, "-c", program, *words], stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stderr is not None
        first = process.stderr.readline()
        assert "homing" in first
        clock = RealClock()
        clock.sleep(0.3)
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
    assert process.returncode == 130
    assert "Traceback" not in rest
