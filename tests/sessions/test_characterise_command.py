"""``uvgs gantry characterise``, ``console`` and ``settings`` as typed."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.gantry_judges import JudgedBench
from uvgs_bench.accuracy.axis_tests import played
from uvgs_bench.camera.boards import BoardView
from uvgs_bench.cli import app as cli
from uvgs_bench.devices.gantry import Envelope
from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.errors import ConfigError, EnvelopeError, RegistrationError
from uvgs_bench.sessions.characterise import Options, average_view, plan_visits
from uvgs_bench.store.bench import read_bench
from uvgs_bench.store.gantry_records import read_gantry_record

pytestmark = pytest.mark.opencv

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def home(tmp_path: Path) -> Path:
    shutil.copytree(ROOT / "calib", tmp_path / "calib")
    return tmp_path


@pytest.fixture
def uvgs(home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Runs ``uvgs gantry ...`` in this process; gives exit code, stdout and stderr."""
    monkeypatch.setattr(cli, "COMMANDS", {"gantry": cli.COMMANDS["gantry"]})
    monkeypatch.chdir(home)

    def run(*words: str, typed: str = "") -> tuple[int, str, str]:
        monkeypatch.setattr("sys.stdin", io.StringIO(typed))
        with pytest.raises(SystemExit) as end:
            cli.main(["gantry", *words, "--sim-speed", "400"])
        printed = capsys.readouterr()
        return int(end.value.code or 0), printed.out, printed.err

    return run


def test_console_asks_and_does_not_move(uvgs) -> None:
    code, printed, _ = uvgs("console", "--json", typed="$I\n$27=2.0\n?\n$99=1\n")
    assert code == 0
    conversation = json.loads(printed)["conversation"]
    assert conversation[0]["answers"] == ["[VER:1.1h.20190830:]", "[OPT:V,15,128]", "ok"]
    assert conversation[1]["answers"] == ["ok"]
    assert conversation[2]["answers"][0].startswith("<Alarm|MPos:")
    assert "error:3" in conversation[3]["answers"][0]
    for line in ("$H", "$J=G91X1F100", "G0X1", "$X", "$RST=*", "$SLP", "$C", "!"):
        code, _, remarks = uvgs("console", typed=f"{line}\n")
        assert code == 2, line
        assert "is not sent: it may move something" in remarks


def test_settings_are_shown_changed_and_read_back(uvgs) -> None:
    code, printed, _ = uvgs("settings")
    assert code == 0
    assert "$130   400.000" in printed
    assert "G54    0.000,0.000,0.000" in printed
    code, printed, _ = uvgs("settings", "20=0", "$1=25", "--json")
    assert code == 0
    told = json.loads(printed)
    assert (told["settings"]["20"], told["settings"]["1"]) == ("0", "25")
    assert any("soft limits are off" in text for text in told["warnings"])
    assert uvgs("settings", "foo")[0] == 2
    code, _, remarks = uvgs("settings", "0=1")
    assert code == 5
    assert "step pulse must be at least 3 us" in remarks
    # 13=1 reports inches, with which the driver does not work: said, not lived with.
    code, _, remarks = uvgs("settings", "13=1")
    assert code == 5
    assert "reports in inches" in remarks


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ((), "name the judge"),
        (("--dial", "--board", "calib/boards/charuco_9x6.toml"), "name the judge"),
        (("--dial",), "say which"),
        (("--dial", "--axis", "Q"), "no linear axis 'Q'"),
        (("--dial", "--axis", "X", "--tests", "squareness"), "got 'squareness'"),
        (("--board", "calib/boards/charuco_9x6.toml", "--grid", "4x1"), "numbers of 2 or more like 4x4x4"),
        (("--board", "calib/boards/charuco_9x6.toml", "--margin-mm", "190"), "has no room between margins"),
        (("--board", "calib/boards/charuco_9x6.toml", "--readings", "r"), "add --dial"),
    ],
)
def test_bad_words_are_one_clear_line(uvgs, words: tuple[str, ...], expected: str) -> None:
    code, printed, remarks = uvgs("characterise", *words)
    assert (code, printed) == (2, "")
    assert expected in remarks


def test_a_dial_gauge_judges_one_axis(uvgs, home: Path) -> None:
    """The readings are those of an axis with 0.1 mm of play, typed into a file."""
    words = ("characterise", "--dial", "--axis", "x", "--tests", "positioning,reversal", "--runs", "3")
    code, printed, _ = uvgs(*words, "--dry-run", "--json")
    assert code == 0
    visits = json.loads(printed)["visits"]
    assert len(visits) == 2 * 5 * 3 + 16
    commands = np.array([visit["position"]["X_mm"] for visit in visits]) / 1000.0
    noise = np.random.default_rng(1).normal(0.0, 2e-6, len(visits))
    ways = np.array([0.05 if visit["approach"] == "from above" else -0.05 for visit in visits[:30]]) / 1000.0
    readings = np.concatenate([commands[:30] + ways, played(commands[30:], 1e-4)]) + noise
    (home / "short.txt").write_text("1.0\n")
    code, _, remarks = uvgs(*words, "--readings", "short.txt")
    assert code == 2
    assert "has 1 readings, the plan has 46 visits" in remarks
    (home / "typed.txt").write_text("# mm\n" + "".join(f"{1000 * value:.4f}\n" for value in readings))
    code, printed, _ = uvgs(*words, "--readings", "typed.txt", "--json")
    assert code == 0
    axis = json.loads(printed)["axes"][0]
    # mm; two um of scatter on 16 readings.
    assert axis["backlash_mm"] == pytest.approx(0.1, abs=0.004)
    assert axis["backlash_low_mm"] < 0.1 < axis["backlash_high_mm"]
    assert axis["reversal_mm"] == pytest.approx(-0.1, abs=0.01)
    record = read_gantry_record(home / "calib" / "gantries" / "simulated.toml")
    assert record.judged_by.startswith("dial gauge, read by a person")
    assert not record.pairs
    assert uvgs(*words, "--readings", "typed.txt")[0] == 2  # never overwritten unasked


def test_a_person_may_type_and_may_stop_typing(uvgs) -> None:
    words = ("characterise", "--dial", "--axis", "X", "--tests", "homing", "--runs", "2")
    code, printed, remarks = uvgs(*words, "--json", typed="0.01\nwhat\n0.03\n")
    assert code == 0
    assert "a number in mm, please" in remarks
    # mm: two readings 0.02 mm apart scatter by 0.02 / sqrt 2.
    assert json.loads(printed)["axes"][0]["homing_mm"] == pytest.approx(0.014142, abs=1e-5)
    code, _, remarks = uvgs(*words, "--force", typed="0.01\n")
    assert code == 2
    assert "ended before the visits did" in remarks


def test_what_was_measured_is_shown_even_where_it_cannot_be_written(uvgs, home: Path) -> None:
    (home / "calib" / "gantries").write_text("a file where the folder should be")
    words = ("characterise", "--dial", "--axis", "X", "--tests", "homing", "--runs", "2")
    code, printed, remarks = uvgs(*words, "--json", typed="0.01\n0.03\n")
    assert code != 0
    assert json.loads(printed)["axes"][0]["homing_mm"] == pytest.approx(0.014142, abs=1e-5)
    assert "gantries" in remarks


def test_a_board_judges_and_the_bench_uses_it(uvgs, home: Path) -> None:
    """With pictures: the shipped bench has 100, -60, 80 ppm and 0.2, -0.15, 0.1 mrad."""
    board = ("characterise", "--board", "calib/boards/charuco_9x6.toml")
    code, printed, remarks = uvgs(
        *board, "--tests", "squareness", "--grid", "3x2x2", "--settle-s", "0", "--captures", "2", "--json"
    )
    assert code == 0
    told = json.loads(printed)
    for axis, planted in zip(told["axes"], (100.0, -60.0, 80.0), strict=True):
        assert abs(axis["scale_ppm"] - planted) < 4.0 * axis["scale_sigma_ppm"]
    for pair, planted in zip(told["pairs"], (0.2, -0.15, 0.1), strict=True):
        assert abs(pair["squareness_mrad"] - planted) < 4.0 * pair["squareness_sigma_mrad"]
    assert "its size was taken as exact" in remarks
    path = home / "calib" / "bench.toml"
    path.write_text(path.read_text().replace("[gantry]", '[gantry]\ncalibration = "gantries/simulated.toml"'))
    bench = read_bench(path)
    assert "board charuco_9x6" in bench.judged_by
    assert bench.envelope.axes[0].scale == pytest.approx(1.0 + told["axes"][0]["scale_ppm"] * 1e-6, abs=1e-9)


def test_visits_keep_out_of_what_must_not_be_touched() -> None:
    axes = tuple(Axis(n, "linear", np.eye(3)[i], -0.3, 0.0, 0.05, 0.2) for i, n in enumerate("XYZ"))
    box = np.array([[-0.16, -0.16, -0.16], [-0.14, -0.14, -0.14]])
    with pytest.raises(EnvelopeError, match="still: the path touches a keep-out box"):
        plan_visits(Envelope(axes, (box,)), Options())
    for visit in plan_visits(Envelope(axes), Options()):
        assert np.all(visit.position >= -0.28)
        assert np.all(visit.position <= -0.02)
    with pytest.raises(ConfigError, match="2 targets"):
        Options(targets=1)


def test_corners_of_several_pictures_are_averaged_where_all_show_them() -> None:
    board_m = np.array([[0.01 * i, 0.0, 0.0] for i in range(8)])
    px = np.array([[100.0 + 10.0 * i, 50.0] for i in range(8)])
    views = [BoardView("a", px, board_m, 640, 480), BoardView("b", px[1:] + 0.5, board_m[1:], 640, 480)]
    found = average_view(views)
    assert found is not None
    np.testing.assert_array_equal(found.board_m, board_m[1:])
    np.testing.assert_allclose(found.px, px[1:] + 0.25)
    # Five corners tell no place.
    assert average_view([views[0], BoardView("c", px[:5], board_m[:5], 640, 480)]) is None


def test_a_dead_band_wider_than_the_way_is_not_told() -> None:
    bench = JudgedBench()
    options = Options(tests=("reversal",), axis="X", reversal_span_m=1.2e-4)
    with pytest.raises(RegistrationError, match="repeat it on a longer one"):
        bench.characterise(options, corner_px=0.02)
    bench.close()
