"""``uvgs run`` into bags, to Astrobee and over UDP: what other programs are handed."""

from __future__ import annotations

import json
import re
import socket
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.cli.app import main
from uvgs_bench.geometry import Pose
from uvgs_bench.interop import astrobee
from uvgs_bench.interop.bags import open_bags
from uvgs_bench.interop.trajectories import read_poses
from uvgs_bench.store.beacons import write_beacon
from uvgs_bench.store.calibrations import write_calibration

pytestmark = pytest.mark.opencv


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("outputs")
    write_calibration(folder / "camera.yaml", spots.calibration())
    write_beacon(folder / "beacon.toml", spots.beacon())
    rng = np.random.default_rng(7)
    (folder / "pictures").mkdir()
    for i in range(4):
        pose = spots.random_pose(rng, cone_deg=20.0)
        px = spots.lens().project(pose.apply(spots.beacon().positions_m))
        cv2.imwrite(str(folder / "pictures" / f"p{i}.png"), spots.draw(px[: 3 if i == 2 else 4], rng))
    return folder


def uvgs(*words: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main(["run", *(str(word) for word in words)])
    return int(caught.value.code or 0)


def setup(folder: Path) -> tuple[object, ...]:
    source = f"images:{folder / 'pictures'}"
    return source, "--camera", folder / "camera.yaml", "--beacon", folder / "beacon.toml", "--quiet"


def test_all_outputs_say_the_same_poses(bench, tmp_path, capfd):
    names = ("p.csv", "p.tum", "p.jsonl", "p.bag", "p.mcap")
    outs = [word for name in names for word in ("--out", tmp_path / name)]
    assert (
        uvgs(*setup(bench), *outs, "--astrobee", "v1", "--annotated", "--images", "--compression", "bz2", "--json") == 0
    )
    told = capfd.readouterr()
    summary = json.loads(told.out)
    assert summary["out"] == [str(tmp_path / name) for name in names]
    assert summary["failures"] == []
    assert told.err.count("min_num_matches_per_measurement") == 1
    poses = [record.pose for record in read_poses(tmp_path / "p.csv") if record.pose is not None]
    stamps = [record.t_ns for record in read_poses(tmp_path / "p.csv") if record.pose is not None]
    assert [record.t_ns for record in read_poses(tmp_path / "p.tum")] == stamps
    for name in ("p.bag", "p.mcap"):
        with open_bags([tmp_path / name]) as bags:
            rows: dict[str, list] = {}
            for message in bags.messages():
                rows.setdefault(message.channel.topic, []).append((message.log_ns, message.decode()))
        assert {topic: len(found) for topic, found in rows.items()} == {
            "/uvgs/camera_info": 4, "/uvgs/image_raw": 4, "/diagnostics": 4, "/uvgs/test/pose": 3, "/tf": 3,
            "/uvgs/test/image_annotated/compressed": 4, "/loc/ar/registration": 3, "/loc/ar/features": 3,
        }  # fmt: skip
        for (t_ns, message), pose, stamp in zip(rows["/uvgs/test/pose"], poses, stamps, strict=True):
            p, q = message.pose.pose.position, message.pose.pose.orientation
            assert t_ns == stamp
            # The CSV has all digits; so has the bag.
            assert Pose.from_quaternion([q.x, q.y, q.z, q.w], [p.x, p.y, p.z], "camera", "beacon").is_close(
                pose, 1e-12, 1e-12
            )
        miss = rows["/diagnostics"][2][1].status[0]
        assert (miss.level, miss.message.partition(":")[0]) == (1, "selection/too_few_blobs")
        for (_, message), pose in zip(rows["/loc/ar/features"], poses, strict=True):
            landmarks = astrobee.landmarks_from_message(message)
            assert landmarks.dock_from_camera().is_close(pose.inverse(), 1e-9, 1e-9)
            # Half a pixel of noise and fit; float32 leaves 3e-5 px.
            lens = spots.lens()
            assert astrobee.landmark_errors_px(landmarks, lens.fx_px, lens.fy_px).max() < 0.5
            assert "4 landmarks" in astrobee.why_dropped(landmarks)
        seen = cv2.imdecode(rows["/uvgs/test/image_annotated/compressed"][0][1].data, cv2.IMREAD_COLOR)
        assert seen.shape[1] > 1280


# What evo's reader of TUM files takes: '#' begins a comment, eight numbers with single spaces in a line, stamps that
# grow, unit quaternions with the scalar last.
TUM_LINE = re.compile(r"-?\d+\.\d{9}( -?\d+(\.\d+)?(e-?\d+)?){7}")


def test_tum_keeps_the_law_of_its_readers(bench, tmp_path):
    out = tmp_path / "p.tum"
    assert uvgs(*setup(bench), "--out", out, "--hold-s", 0.3) == 0
    raw = out.read_bytes()
    raw.decode("ascii")
    assert b"\r" not in raw
    assert raw.endswith(b"\n")
    lines = [line for line in raw.decode().splitlines() if not line.startswith("#")]
    assert len(lines) == 3
    assert all(TUM_LINE.fullmatch(line) for line in lines)
    values = np.array([[float(word) for word in line.split(" ")] for line in lines])
    assert values.shape == (3, 8)
    assert (np.diff(values[:, 0]) > 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(values[:, 4:], axis=1), 1.0, atol=1e-12)
    first = read_poses(out)[0].pose
    np.testing.assert_array_equal(values[0, 1:4], first.t_m)
    np.testing.assert_allclose(values[0, 4:], first.quaternion_xyzw(), atol=1e-15)


def test_one_datagram_per_capture_and_a_rate_of_its_own(bench, tmp_path, capfd):
    got: list[dict] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(200.0)
        port = ear.getsockname()[1]

        def listen(count: int) -> threading.Thread:
            got.clear()
            thread = threading.Thread(target=lambda: [got.append(json.loads(ear.recv(65536))) for _ in range(count)])
            thread.start()
            return thread

        thread = listen(4)
        # Nothing else is asked for: no file is written.
        assert uvgs(*setup(bench), "--udp", f"127.0.0.1:{port}") == 0
        thread.join()
        assert [record["status"] for record in got] == ["ok", "ok", "miss", "ok"]
        assert [record["index"] for record in got] == [0, 1, 2, 3]
        assert "no file was asked for" in capfd.readouterr().out
        thread = listen(1)
        out = tmp_path / "p.csv"
        assert uvgs(*setup(bench), "--udp", f"127.0.0.1:{port}", "--rate-hz", 0.01, "--out", out) == 0
        thread.join()
        assert [record["index"] for record in got] == [0]
        assert len(read_poses(out)) == 4


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "--out: is needed"),
        (("--out", "{}/p.csv", "--out", "{}/p.csv"), "is named twice"),
        (("--out", "{}/p.csv", "--astrobee", "v2"), "--astrobee: needs an --out that ends in .bag or .mcap"),
        (("--out", "{}/p.csv", "--annotated"), "--annotated: needs an --out"),
        (("--out", "{}/p.csv", "--rate-hz", 5), "--rate-hz: limits what is told"),
        (("--out", "{}/p.bag", "--compression", "zstd"), "--compression: zstd compresses .mcap files"),
        (("--out", "{}/p.mcap", "--compression", "bz2"), "--compression: bz2 compresses .bag files"),
        (("--out", "{}/p.bag", "--astrobee", "v3"), "v3"),
        (("--udp", "nowhere"), "--udp: expected HOST:PORT"),
        (("--udp", "no.such.host.invalid:5"), "--udp: the host of 'no.such.host.invalid:5' is unknown"),
    ],
)
def test_outputs_that_cannot_be_meant_are_one_line(bench, tmp_path, capfd, words, said):
    assert uvgs(*setup(bench), *(str(word).format(tmp_path) for word in words)) == 2
    told = capfd.readouterr().err
    assert said in " ".join(told.split())
    assert "Traceback" not in told


def test_nothing_is_begun_when_one_output_cannot_be(bench, tmp_path, capfd):
    (tmp_path / "there.bag").write_text("mine")
    for words, said in (
        (("--out", tmp_path / "there.bag"), "there.bag: exists already"),
        (("--out", tmp_path / "b.xyz"), "unknown ending '.xyz', expected one of: .csv, .tum, .jsonl, .bag, .mcap"),
        (("--record", tmp_path / "there.bag"), "exists already"),
    ):
        assert uvgs(*setup(bench), "--out", tmp_path / "a.csv", "--record", tmp_path / "r.mcap", *words) == 2
        assert said in " ".join(capfd.readouterr().err.split())
        assert sorted(path.name for path in tmp_path.iterdir()) == ["there.bag"]
    assert (tmp_path / "there.bag").read_text() == "mine"


def test_endings_are_those_of_the_writers():
    from uvgs_bench.cli import run_outlets
    from uvgs_bench.interop.bag_writer import BAG_ENDINGS
    from uvgs_bench.interop.trajectories import WRITERS

    assert (*WRITERS, *BAG_ENDINGS) == run_outlets._ENDINGS
