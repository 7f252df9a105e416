"""``uvgs run --record``: solved again, a record gives the same lines, byte by byte, whatever the run was told."""

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
from tests.helpers.sim_bench import write_bench
from uvgs_bench.cli.app import main
from uvgs_bench.devices.cameras.base import ClosingSource
from uvgs_bench.devices.sim.camera import SimulatedCamera
from uvgs_bench.errors import CaptureError
from uvgs_bench.interop.bag_writer import IMAGE_TOPIC
from uvgs_bench.interop.bags import open_bags
from uvgs_bench.sensor import Capture
from uvgs_bench.sessions.replay import find_recording
from uvgs_bench.store.beacons import write_beacon
from uvgs_bench.store.calibrations import write_calibration

pytestmark = pytest.mark.opencv
HIDDEN = "[simulated.occlusion]\nprobability = 0.12\n"


def uvgs(*words: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main(["run", *(str(word) for word in words)])
    return int(caught.value.code or 0)


@pytest.fixture(scope="module")
def hidden(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hidden")
    write_bench(folder, beacon="red", more=HIDDEN, is_colour=True, exposure_ms=12.0)
    return folder


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    write_calibration(folder / "camera.yaml", spots.calibration())
    write_beacon(folder / "beacon.toml", spots.beacon())
    rng = np.random.default_rng(7)
    (folder / "deep").mkdir()
    for i in range(4):
        pose = spots.random_pose(rng, cone_deg=20.0)
        px = spots.lens().project(pose.apply(spots.beacon().positions_m))
        mosaic = spots.draw(px[: 3 if i == 2 else 4], rng, peak_dn=2500.0, background_dn=150.0, dtype=np.uint16,
                            full_scale=4095)  # fmt: skip
        cv2.imwrite(str(folder / "deep" / f"p{i}.png"), mosaic)
    return folder


def one(folder: Path) -> tuple[object, ...]:
    return "--camera", folder / "camera.yaml", "--beacon", folder / "beacon.toml", "--quiet"


def two(folder: Path, count: int) -> tuple[object, ...]:
    return (
        f"sim:{folder / 'bench.toml'}?count={count}&with={folder / 'green.toml'}", "--camera", folder / "camera.yaml",
        "--beacon", folder / "red.toml", "--beacon", folder / "green.toml", "--quiet",
    )  # fmt: skip


@pytest.mark.parametrize(
    "words",
    [
        ("--track", "--limit", 7, "--handover", "position", "--zone-m", "red=1:inf", "--zone-m", "green=0:1"),
        ("--handover", "command", "--active", "green", "--hold-s", 0.15),
        ("--auto-exposure", "--max-exposure-ms", 15.0),
        ("--difference",),
    ],
    ids=lambda words: str(words[0]),
)
def test_a_record_solved_again_gives_the_same_lines(hidden, tmp_path, monkeypatch, words):
    a, b, record = tmp_path / "a.csv", tmp_path / "b.csv", tmp_path / "r.mcap"
    (tmp_path / "names").write_text("red\n\nnonsense\ngreen\n")
    with (tmp_path / "names").open() as stream:
        monkeypatch.setattr("sys.stdin", stream)
        code = uvgs(*two(hidden, 8), *words, "--out", a, "--record", record)
    assert code in (0, 3)
    with (tmp_path / "names").open() as stream:
        monkeypatch.setattr("sys.stdin", stream)
        assert uvgs(record, "--out", b, "--quiet") == code
    assert len(a.read_bytes().splitlines()) >= 2 * (4 if "--difference" in words else 7)
    assert a.read_bytes() == b.read_bytes()
    if "--auto-exposure" in words:
        assert len({line.split(",")[-1] for line in a.read_text().splitlines()[1:]} - {""}) > 0


def test_depth_mosaic_and_names_of_pictures_are_kept(pictures, tmp_path):
    source = f"images:{pictures / 'deep'}?bayer=rggb&bits=12"
    a, b, record = tmp_path / "a.csv", tmp_path / "b.csv", tmp_path / "r.mcap"
    assert uvgs(source, *one(pictures), "--out", a, "--record", record, "--compression", "none") == 0
    recording = find_recording(record)
    captures = list(recording.captures())
    recording.close()
    assert [(c.bayer, c.full_scale_dn, c.source, c.index) for c in captures] == [
        ("rggb", 4095.0, f"p{i}.png", i) for i in range(4)
    ]
    assert captures[0].image.dtype == np.uint16
    assert uvgs(f"bag:{record}", "--out", b, "--quiet") == 0
    assert a.read_bytes() == b.read_bytes()
    assert ",miss," in a.read_text()


def test_options_and_files_that_are_given_hold_instead_of_the_recorded_ones(pictures, tmp_path, capfd):
    source, record = f"images:{pictures / 'deep'}", tmp_path / "r.mcap"
    assert uvgs(source, *one(pictures), "--record", record, "--limit", 3) == 0
    b = tmp_path / "b.csv"
    assert uvgs(record, "--out", b, "--limit", 2, "--quiet", "--json") == 0
    assert len(b.read_text().splitlines()) == 3
    other = tmp_path / "other.toml"
    other.write_text((pictures / "beacon.toml").read_text().replace('"test"', '"another"'))
    assert uvgs(record, "--out", b, "--beacon", other, "--force", "--quiet") == 0
    assert ",another," in b.read_text()
    strict = tmp_path / "strict.toml"
    strict.write_text("schema = 1\nmax_rms_px = 1e-6\n")
    assert uvgs(record, "--out", b, "--config", strict, "--force", "--quiet") == 3
    capfd.readouterr()
    assert uvgs(record, "--out", b, "--auto-exposure", "--force", "--quiet") == 2
    assert "exposure of this source cannot be set" in capfd.readouterr().err


def test_a_record_of_a_record_is_the_same_again(hidden, tmp_path):
    files = [tmp_path / name for name in ("a.csv", "r.mcap", "b.csv", "s.mcap", "c.csv")]
    a, r, b, s, c = files
    words = ("--auto-exposure", "--hold-s", 0.2)
    assert uvgs(*two(hidden, 6), *words, "--out", a, "--record", r) == 0
    assert uvgs(r, "--out", b, "--record", s, "--quiet") == 0
    assert uvgs(s, "--out", c, "--quiet") == 0
    assert a.read_bytes() == b.read_bytes() == c.read_bytes()


def test_ctrl_c_leaves_a_record_of_what_was_answered(hidden, tmp_path, monkeypatch):
    grab = SimulatedCamera.grab

    def third_is_the_last(self):
        capture = grab(self)
        if capture is not None and capture.index == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return capture

    a, b, record = tmp_path / "a.csv", tmp_path / "b.csv", tmp_path / "r.mcap"
    monkeypatch.setattr(SimulatedCamera, "grab", third_is_the_last)
    assert uvgs(*two(hidden, 9), "--out", a, "--record", record) == 130
    monkeypatch.undo()
    uvgs(record, "--out", b, "--quiet")
    assert 2 <= len(a.read_text().splitlines()) < 2 * 9
    assert a.read_bytes() == b.read_bytes()


def test_what_is_no_record_is_said(pictures, tmp_path, capfd):
    bag = tmp_path / "poses.mcap"
    assert uvgs(f"images:{pictures / 'deep'}", *one(pictures), "--out", bag) == 0
    assert find_recording(bag) is None
    assert find_recording(tmp_path / "missing.mcap") is None
    (tmp_path / "foreign.mcap").write_text("foreign")
    assert find_recording(tmp_path / "foreign.mcap") is None
    capfd.readouterr()
    assert uvgs(bag, "--out", tmp_path / "b.csv", "--quiet") in (2, 4)
    assert "Traceback" not in capfd.readouterr().err
    assert uvgs(f"images:{pictures / 'deep'}", *one(pictures), "--record", tmp_path / "r.bag") == 2
    assert "expected .mcap" in capfd.readouterr().err


_LIMITED = """
import resource, signal, sys
from uvgs_bench.cli.app import main
import uvgs_bench.sessions.stream, uvgs_bench.sessions.recording
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000))
main(sys.argv[1:])
"""


def test_a_full_disk_ends_the_record_and_the_poses_go_on(pictures, tmp_path):
    whole, part, record = tmp_path / "whole.csv", tmp_path / "part.csv", tmp_path / "r.mcap"
    source = f"images:{pictures / 'deep'}"
    assert uvgs(source, *one(pictures), "--out", whole) == 0
    words = ["run", source, *one(pictures), "--out", part, "--record", record, "--compression", "none", "--json"]
    # Nothing may be compiled below the limit; the cache of kernels would be torn.
    done = subprocess.run(
        [sys.executable, "-c", _LIMITED, *map(str, words)], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 4, done.stderr
    assert done.stderr.count("cannot be written: File too large") == 1
    assert "the poses go on" in done.stderr
    [failure] = json.loads(done.stdout)["failures"]
    assert "r.mcap" in failure
    assert part.read_bytes() == whole.read_bytes()
    assert record.stat().st_size <= 400_000
    with open_bags([record]) as bags:
        assert bags.counts.get(IMAGE_TOPIC, 0) == 0 or bags.counts[IMAGE_TOPIC] < 4


def test_a_record_that_was_cut_gives_what_is_whole(pictures, tmp_path):
    record, cut = tmp_path / "r.mcap", tmp_path / "cut.mcap"
    assert uvgs(f"images:{pictures / 'deep'}", *one(pictures), "--record", record, "--compression", "none") == 0
    payload = record.read_bytes()
    recording = find_recording(record)
    whole = [(c.t_ns, c.source, c.image.tobytes()) for c in recording.captures()]
    recording.close()
    counts = []
    for share in (0.02, 0.3, 0.6, 0.9, 0.999):
        cut.write_bytes(payload[: int(share * len(payload))])
        recording = find_recording(cut)
        if recording is None:
            counts.append(-1)
            continue
        found = [(c.t_ns, c.source, c.image.tobytes()) for c in recording.captures()]
        assert recording.remarks
        recording.close()
        assert found == whole[: len(found)]
        counts.append(len(found))
    # A chunk is on disk with each picture of some MB.
    assert counts == sorted(counts)
    assert counts[0] < 1
    assert counts[-1] >= 3
    out = tmp_path / "b.csv"
    cut.write_bytes(payload[: int(0.6 * len(payload))])
    assert uvgs(cut, "--out", out, "--quiet") == 0
    assert 2 <= len(out.read_text().splitlines()) < 5


def test_nothing_is_written_over_what_is_read(pictures, tmp_path, capfd):
    record = tmp_path / "r.mcap"
    assert uvgs(f"images:{pictures / 'deep'}", *one(pictures), "--record", record, "--limit", 1) == 0
    before = record.read_bytes()
    (tmp_path / "link.mcap").symlink_to(record)
    for words in (
        (record, "--record", record),
        (record, "--out", tmp_path / "link.mcap"),
        (f"bag:{record}?topic=/x", "--out", record),
        (f"bag:{tmp_path / 'other.bag'},{record}", "--out", record),
    ):
        assert uvgs(*words, "--force", "--quiet") == 2
        assert "is what is read" in capfd.readouterr().err
    assert record.read_bytes() == before


def test_another_version_is_said(pictures, tmp_path, monkeypatch, capfd):
    from uvgs_bench.sessions import provenance

    record = tmp_path / "r.mcap"
    assert uvgs(f"images:{pictures / 'deep'}", *one(pictures), "--record", record, "--limit", 1) == 0
    monkeypatch.setattr(provenance, "program_versions", lambda: {"uvgs_bench": "9.9", "numpy": np.__version__})
    capfd.readouterr()
    assert uvgs(record, "--out", tmp_path / "p.csv", "--quiet") == 0
    said = capfd.readouterr().err
    assert "the last digits of poses may differ" in said
    assert "now 9.9" in said
    assert "numpy" not in said


class Plugged(ClosingSource):
    """A live camera that repeats a picture for a while and is unplugged once."""

    lost = 0

    def __init__(self) -> None:
        super().__init__("plugged:", is_live=True, length=None)
        self._image = np.zeros((960, 1280), dtype=np.uint8)

    @classmethod
    def open(cls, _spec: object, _clock: object) -> Plugged:
        return cls()

    def grab(self) -> Capture | None:
        k = Plugged.taken
        if k == 30 and not Plugged.lost:
            Plugged.lost = 1
            raise CaptureError("unplugged", self.spec)
        if k == 40:
            return None
        # Slow enough for the sensor; on a busy machine some captures are dropped all the same.
        time.sleep(0.03)
        Plugged.taken += 1
        image = self._image if 10 <= k < 26 else np.full_like(self._image, k)
        return Capture(image, time.monotonic_ns(), "plugged", 0)

    taken = 0


def test_what_a_live_camera_said_is_kept(pictures, tmp_path, monkeypatch):
    from uvgs_bench.devices.cameras import registry

    monkeypatch.setitem(registry.CAMERAS, "plugged", f"{__name__}:Plugged")
    Plugged.taken = Plugged.lost = 0
    a, b, record = tmp_path / "a.csv", tmp_path / "b.csv", tmp_path / "r.mcap"
    assert uvgs("plugged:", *one(pictures), "--out", a, "--record", record) == 3
    assert ",after_gap," in a.read_text()
    assert ",frozen," in a.read_text()
    assert uvgs(record, "--out", b, "--quiet") == 3
    assert a.read_bytes() == b.read_bytes()


def test_damage_inside_a_record_is_told(pictures, tmp_path, capfd):
    record = tmp_path / "r.mcap"
    assert uvgs(f"images:{pictures / 'deep'}", *one(pictures), "--record", record, "--compression", "none") == 0
    payload = bytearray(record.read_bytes())
    # In the pixels of the second picture of 2.5 MB.
    payload[4_000_000] ^= 0xFF
    record.write_bytes(payload)
    capfd.readouterr()
    assert uvgs(record, "--out", tmp_path / "b.csv", "--quiet") == 0
    assert "a chunk fails its check" in capfd.readouterr().err
    lines = (tmp_path / "b.csv").read_text().splitlines()
    assert [line.split(",")[1] for line in lines[1:]] == ["p0.png", "p2.png", "p3.png"]
