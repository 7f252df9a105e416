"""Bags of poses, read back by readers that are not ours."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import spots
from uvgs_bench.errors import ConfigError, FormatError, UvgsError
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import so3_log
from uvgs_bench.interop import astrobee
from uvgs_bench.interop.bag_container import MessageKind
from uvgs_bench.interop.bag_writer import BagContents, BagPoses, NewBag
from uvgs_bench.interop.mcap_container import McapContainer
from uvgs_bench.interop.pose_messages import ros_covariance, ros_names
from uvgs_bench.interop.ros1_container import Ros1Container
from uvgs_bench.interop.trajectories import LineNote
from uvgs_bench.sensor import Capture, Miss, PoseEstimate
from uvgs_bench.sensor.handover import Held

START_NS = 1_700_000_000_000_000_123
FILES = [("p.bag", "none"), ("p.bag", "bz2"), ("p.mcap", "none"), ("p.mcap", "zstd")]
KIND = MessageKind("std_msgs/msg/String", "string data\n", "992ce8a1687cec8c8bd883ec73ca41d1")


def random_estimate(rng: np.random.Generator, t_ns: int = START_NS) -> PoseEstimate:
    root = rng.normal(size=(6, 6)) * [1e-3, 2e-3, 3e-3, 1e-4, 2e-4, 5e-4]
    pose = Pose.exp(rng.normal(size=6) * [1, 1, 1, 0.3, 0.3, 0.3] + [0, 0, 0, 0, 0, 2.0], "camera", "beacon")
    px = spots.lens().project(np.array([[0.1, 0, 1], [0, 0.1, 1], [-0.1, 0, 1], [0, -0.1, 1.0]]))
    return PoseEstimate(pose, root @ root.T, t_ns, "test", px, np.zeros((4, 2)), 0.05, 7.5, 4)


def answers() -> list[tuple[Capture, PoseEstimate | Miss | Held]]:
    rng = np.random.default_rng(5)
    image = np.zeros((4, 6), dtype=np.uint8)
    out: list[tuple[Capture, PoseEstimate | Miss | Held]] = []
    for i in range(6):
        # 0.7 s apart: several chunks.
        t_ns = START_NS + i * 700_000_000
        outcome: PoseEstimate | Miss | Held = random_estimate(rng, t_ns)
        if i >= 3:
            outcome = Miss("selection", "too_few_blobs", "3 of 4", t_ns, "test", 3)
        if i == 4:
            outcome = Held(out[2][1], 2 * 700_000_000, outcome)
        out.append((Capture(image, t_ns, f"p{i}.png", i, 0.004), outcome))
    return out


def write(path: Path, compression: str = "none", **more) -> Path:
    contents = BagContents(spots.lens(), {"test": spots.beacon()}, **more)
    writer = BagPoses(NewBag(path, compression=compression, version=contents.version), contents)
    for capture, outcome in answers():
        writer.write(capture, outcome, LineNote(("saturated",)))
    writer.close()
    writer.close()
    return path


def read(path: Path) -> dict[str, list[tuple[int, object]]]:
    from rosbags.highlevel import AnyReader

    found: dict[str, list[tuple[int, object]]] = {}
    with AnyReader([path]) as reader:
        for connection, t_ns, raw in reader.messages():
            found.setdefault(connection.topic, []).append((t_ns, reader.deserialize(raw, connection.msgtype)))
    return found


@pytest.mark.parametrize(("name", "compression"), FILES)
def test_every_capture_is_in_the_bag_and_misses_say_why(tmp_path, name, compression):
    found = read(write(tmp_path / name, compression))
    assert {topic: len(rows) for topic, rows in found.items()} == {
        "/uvgs/camera_info": 6, "/diagnostics": 6, "/uvgs/test/pose": 3, "/tf": 3,
    }  # fmt: skip
    for (t_ns, message), (capture, outcome) in zip(found["/uvgs/test/pose"], answers()[:3], strict=True):
        stamp = message.header.stamp
        assert t_ns == stamp.sec * 10**9 + stamp.nanosec == capture.t_ns
        assert message.header.frame_id == "camera"
        p, q = message.pose.pose.position, message.pose.pose.orientation
        pose = Pose.from_quaternion([q.x, q.y, q.z, q.w], [p.x, p.y, p.z], "camera", "beacon")
        assert pose.is_close(outcome.camera_from_beacon, 1e-12, 1e-12)
        np.testing.assert_array_equal(message.pose.covariance.reshape(6, 6), ros_covariance(outcome))
    [transform] = found["/tf"][0][1].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("camera", "test")
    moved = transform.transform.translation
    np.testing.assert_array_equal([moved.x, moved.y, moved.z], answers()[0][1].camera_from_beacon.t_m)
    statuses = [message.status[0] for _, message in found["/diagnostics"]]
    assert [status.level for status in statuses] == [0, 0, 0, 1, 1, 1]
    assert statuses[3].message == "selection/too_few_blobs: 3 of 4"
    assert statuses[4].message.startswith("held for 1.400 s")
    values = [{pair.key: pair.value for pair in status.values} for status in statuses]
    assert [row["status"] for row in values] == ["ok"] * 3 + ["miss", "held", "miss"]
    assert (values[5]["stage"], values[5]["reason"], values[5]["source"]) == ("selection", "too_few_blobs", "p5.png")
    assert values[0]["flags"] == "saturated"
    info = found["/uvgs/camera_info"][0][1]
    np.testing.assert_array_equal((info.K if name.endswith("bag") else info.k)[[0, 4]], spots.lens().parameters[:2])
    assert info.distortion_model == "plumb_bob"


def test_the_covariance_is_that_of_position_and_fixed_axes():
    # Twists drawn by the sensor's law, turned into what ROS means.
    rng = np.random.default_rng(11)
    estimate = random_estimate(rng)
    T = estimate.camera_from_beacon
    twists = rng.multivariate_normal(np.zeros(6), 1e-4 * estimate.covariance, size=4000)
    rows = []
    for xi in twists:
        moved = T.perturbed(xi)
        rows.append(np.concatenate([moved.t_m - T.t_m, so3_log(moved.R @ T.R.T)]))
    found = np.cov(np.array(rows).T)
    wanted = 1e-4 * ros_covariance(estimate)
    scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    # 4000 draws: the deviation of a covariance entry is sqrt(2/4000) = 2.2 %; five of them.
    np.testing.assert_allclose(found / scale, wanted / scale, atol=0.11)
    # An error of attitude alone, seen from the camera's centre, moves a far beacon sideways.
    J = np.zeros((6, 6))
    for k in range(6):
        xi = np.zeros(6)
        xi[k] = 1e-6
        moved = T.perturbed(xi)
        J[:, k] = np.concatenate([moved.t_m - T.t_m, so3_log(moved.R @ T.R.T)]) / 1e-6
    np.testing.assert_allclose(J @ estimate.covariance @ J.T, ros_covariance(estimate), atol=1e-9)


@pytest.mark.parametrize("version", ["v1", "v2"])
@pytest.mark.parametrize("name", ["p.bag", "p.mcap"])
def test_astrobees_messages_come_registration_first(tmp_path, name, version):
    from rosbags.highlevel import AnyReader

    path = write(tmp_path / name, version=version)
    with AnyReader([path]) as reader:
        digests = {c.topic: c.digest for c in reader.connections}
        order = [c.topic for c, _, _ in reader.messages() if c.topic.startswith("/loc")]
        found = [
            astrobee.landmarks_from_message(reader.deserialize(raw, c.msgtype))
            for c, _, raw in reader.messages()
            if c.topic == astrobee.LANDMARKS_TOPIC
        ]
    assert order == [astrobee.REGISTRATION_TOPIC, astrobee.LANDMARKS_TOPIC] * 3
    if name == "p.bag":
        assert digests[astrobee.LANDMARKS_TOPIC] == astrobee.ROS1_MD5[astrobee.LANDMARKS, version]
    assert [row.t_ns for row in found] == [capture.t_ns for capture, _ in answers()[:3]]
    assert all(row.frame_id == "dock/body" and len(row.points_m) == 4 for row in found)
    assert (found[0].runtime_s is None) == (version == "v1")


@pytest.mark.opencv
def test_pictures_of_what_was_seen(tmp_path):
    def paint(capture, outcome):
        return np.full((8, 8, 3), 200 if isinstance(outcome, PoseEstimate) else 20, dtype=np.uint8)

    found = read(write(tmp_path / "p.mcap", annotate={"test": paint}))
    rows = found["/uvgs/test/image_annotated/compressed"]
    assert len(rows) == 6
    import cv2

    values = [int(cv2.imdecode(message.data, cv2.IMREAD_COLOR)[0, 0, 0]) for _, message in rows]
    assert values == [200] * 3 + [20] * 3


@pytest.mark.parametrize("compression", [pytest.param("none", marks=pytest.mark.slow), "bz2"])
def test_debian_and_the_genuine_rosbag_read_ros_1(tmp_path, compression):
    path = write(tmp_path / "p.bag", compression)
    tool = shutil.which("rosbag")
    if tool is None:
        pytest.skip("Debian's rosbag is not installed")
    info = subprocess.run([tool, "info", path], capture_output=True, text=True, timeout=60, check=False)
    assert info.returncode == 0, info.stderr
    assert "messages:    18" in info.stdout.replace("messages:     18", "messages:    18")
    assert f"compression:  {compression}".replace(" ", "") in info.stdout.replace(" ", "")
    check = subprocess.run([tool, "check", path], capture_output=True, text=True, timeout=60, check=False)
    assert check.returncode == 0
    assert "rules missing" not in check.stdout
    code = "import sys, rosbag\nfor t, m, at in rosbag.Bag(sys.argv[1]).read_messages():\n    print(t, at.to_nsec())"
    read_back = subprocess.run(
        ["/usr/bin/python3", "-c", code, path], capture_output=True, text=True, timeout=60, check=False
    )
    assert read_back.stdout.count("/diagnostics") == 6, read_back.stderr
    assert f"/uvgs/test/pose {START_NS}" in read_back.stdout


@pytest.mark.parametrize("compression", ["none", "bz2"])
def test_rosbag_standalone_reads_ros_1(tmp_path, compression):
    rosbag = pytest.importorskip("rosbag", reason="rosbag-standalone is not installed")
    with rosbag.Bag(str(write(tmp_path / "p.bag", compression))) as bag:
        rows = [(topic, message, t.to_nsec()) for topic, message, t in bag.read_messages()]
    poses = [(message, t_ns) for topic, message, t_ns in rows if topic == "/uvgs/test/pose"]
    assert [t_ns for _, t_ns in poses] == [capture.t_ns for capture, _ in answers()[:3]]
    assert poses[0][0].pose.pose.position.x == answers()[0][1].camera_from_beacon.t_m[0]


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_mcaps_own_reader_reads_ros_2(tmp_path, compression):
    reader_module = pytest.importorskip("mcap.reader", reason="mcap is not installed")
    decoder = pytest.importorskip("mcap_ros2.decoder", reason="mcap-ros2-support is not installed")
    with write(tmp_path / "p.mcap", compression).open("rb") as stream:
        reader = reader_module.make_reader(stream, validate_crcs=True, decoder_factories=[decoder.DecoderFactory()])
        summary = reader.get_summary()
        rows = [(channel.topic, row.log_time, message) for _, channel, row, message in reader.iter_decoded_messages()]
        [metadata] = list(reader.iter_metadata())
    assert summary.statistics.message_count == len(rows) == 18
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count == 3
    poses = [(t_ns, message) for topic, t_ns, message in rows if topic == "/uvgs/test/pose"]
    assert poses[0][0] == START_NS
    assert poses[0][1].pose.pose.position.x == answers()[0][1].camera_from_beacon.t_m[0]
    assert "version: 9" in metadata.metadata["serialized_metadata"]
    # A reader that does not know the index, but the records from start to end, sees the same.
    stream_reader = pytest.importorskip("mcap.stream_reader")
    with (tmp_path / "p.mcap").open("rb") as stream:
        names = [type(row).__name__ for row in stream_reader.StreamReader(stream, validate_crcs=True).records]
    assert names.count("Message") == 18


def test_endings_compressions_and_files_are_checked(tmp_path):
    for name, compression, word in (
        ("p.bag", "zstd", "by bz2"), ("p.mcap", "bz2", "by zstd"), ("p.xyz", "none", "ending"),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=word):
            write(tmp_path / name, compression)
        assert not (tmp_path / name).exists()
    (tmp_path / "p.bag").write_text("mine")
    with pytest.raises(ConfigError, match="--force"):
        write(tmp_path / "p.bag")
    assert (tmp_path / "p.bag").read_text() == "mine"


@pytest.mark.parametrize("kind", [Ros1Container, McapContainer])
def test_instants_without_a_place_are_refused(tmp_path, kind):
    bag = kind(tmp_path / "p")
    channel = bag.add("/a", KIND)
    for t_ns in (-1, kind.latest_ns + 1):
        with pytest.raises(FormatError, match="instant"):
            bag.write(channel, t_ns, b"")
    bag.write(channel, kind.latest_ns, b"\0" * 8)
    bag.close()


@pytest.mark.parametrize("name", ["p.bag", "p.mcap"])
def test_an_empty_bag_is_a_bag(tmp_path, name):
    from rosbags.highlevel import AnyReader

    (Ros1Container if name == "p.bag" else McapContainer)(tmp_path / name).close()
    with AnyReader([tmp_path / name]) as reader:
        assert reader.connections == []


_LIMITED = """
import resource, signal, sys
from pathlib import Path
from uvgs_bench.errors import UvgsError
from uvgs_bench.interop.bag_writer import NewBag
# After the imports: what they keep for the next time is no part of this.
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
bag = NewBag(Path(sys.argv[1]))
try:
    for i in range(40):
        bag.write("/text", 10**9 * (i + 1), bag.make.text("x" * 20_000))
    bag.close()
except UvgsError as error:
    print(error)
try:
    bag.write("/text", 10**12, bag.make.text("late"))
except UvgsError as error:
    print(error)
bag.close()
"""


@pytest.mark.parametrize("name", ["p.bag", "p.mcap"])
def test_a_disk_that_fills_up_leaves_a_bag_with_what_fitted(tmp_path, name):
    import sys

    words = [sys.executable, "-c", _LIMITED, str(tmp_path / name), "300000"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    first, second = done.stdout.splitlines()
    assert "cannot be written: File too large" in first, done.stderr
    assert "closed before" in second
    assert (tmp_path / name).stat().st_size <= 300_000
    found = read(tmp_path / name)["/text"]
    # 40 messages of 20 kB were wanted, 300 kB is room for 14, two lie in a chunk.
    assert 10 <= len(found) <= 14
    assert [t_ns for t_ns, _ in found] == [10**9 * (i + 1) for i in range(len(found))]


@pytest.mark.parametrize(("name", "compression"), [("p.bag", "bz2"), ("p.mcap", "zstd")])
def test_chunks_written_in_a_hurry_are_not_compressed_and_read_like_the_others(tmp_path, name, compression):
    bag = NewBag(tmp_path / name, compression=compression)
    for i in range(6):
        bag.hurry(i % 2 == 1)
        bag.write("/text", i * 10**9, bag.make.text("x" * 1_200_000 + str(i)))
    bag.close()
    # Three of six messages of 1.2 MB that compress to almost nothing.
    assert 3_600_000 < (tmp_path / name).stat().st_size < 3_700_000
    assert [message.data[-1] for _, message in read(tmp_path / name)["/text"]] == list("012345")


def test_a_full_disk_is_said_at_once():
    for kind in (Ros1Container, McapContainer):
        with pytest.raises(UvgsError, match="/dev/full: cannot be written: No space left"):
            kind(Path("/dev/full"), force=True)
    assert Path("/dev/full").is_char_device()


def test_names_for_topics_and_frames():
    assert ros_names(["tetra", "two words", "two_words", "5mm", "camera"]) == {
        "tetra": "tetra", "two words": "two_words", "two_words": "two_words_2", "5mm": "b_5mm", "camera": "camera_2",
    }  # fmt: skip
