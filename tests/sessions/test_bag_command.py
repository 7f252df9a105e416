"""``uvgs bag``: what it says of healthy and sick bags, and that converting and extracting lose nothing."""

from __future__ import annotations

import json
import resource
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import spots
from tests.helpers.bag_files import Note, camera_info_note, image_note, png_note, write_bag
from uvgs_bench.camera import Lens
from uvgs_bench.cli.app import main
from uvgs_bench.interop import astrobee
from uvgs_bench.interop.bags import open_bags
from uvgs_bench.store.beacons import write_beacon
from uvgs_bench.store.calibrations import write_calibration

pytestmark = pytest.mark.opencv
BAGS = Path(__file__).parents[3] / "shared" / "data" / "bags"
S = 10**9
START_NS = 1_700_000_000 * S
LENS = Lens("plumb_bob", 40, 30, np.array([50.0, 50.0, 20.0, 15.0, 0.0, 0.0, 0.0, 0.0, 0.0]))


def uvgs(*words: object) -> int:
    with pytest.raises(SystemExit) as caught:
        main([str(word) for word in words])
    return int(caught.value.code or 0)


def picture(i: int = 0) -> np.ndarray:
    image = np.random.default_rng(i).integers(5, 40, (30, 40), dtype=np.uint8)
    image[10:12, 10:12] = 200
    return image


def stamps(count: int = 20, rate_hz: float = 10.0) -> list[int]:
    return [START_NS + round(i * S / rate_hz) for i in range(count)]


def healthy(count: int = 20) -> list[Note]:
    return [
        note for t_ns in stamps(count) for note in (camera_info_note(LENS, t_ns), image_note(picture(t_ns % 7), t_ns))
    ]


def checked(capfd, path: Path, *words: object) -> tuple[int, dict]:
    capfd.readouterr()
    code = uvgs("bag", "check", path, "--json", "--quiet", *words)
    return code, json.loads(capfd.readouterr().out)


# --- info --------------------------------------------------------------------------------------------------------


def test_info_for_programs_and_people(tmp_path, capfd):
    path = write_bag(tmp_path, "mcap-zstd", [*healthy(), png_note(picture(), stamps()[-1])])
    assert uvgs("bag", "info", path, "--json") == 0
    found = json.loads(capfd.readouterr().out)
    assert found["files"][0]["compression"] == "zstd"
    assert found["files"][0]["messages"] == 41
    assert found["duration_s"] == pytest.approx(1.9)
    topics = {topic["topic"]: topic for topic in found["topics"]}
    raw = topics["/cam/image_raw"]
    assert (raw["messages"], raw["detail"], raw["camera_info"]) == (20, "mono8 40x30 px", "/cam/camera_info")
    assert raw["mean_rate_hz"] == pytest.approx(10.0)
    assert topics["/cam/image_raw/compressed"]["detail"] == "mono8; png compressed  40x30 px"
    assert topics["/cam/camera_info"]["detail"] == "plumb_bob 40x30 px"
    assert uvgs("bag", "info", path) == 0
    said = capfd.readouterr().out
    assert "20 x sensor_msgs/msg/Image, 10.00 Hz on average; mono8 40x30 px, lens in /cam/camera_info" in said
    assert "from 2023-11-14 22:13:20.000 UTC to 2023-11-14 22:13:21.900 UTC, 1.900 s" in said


@pytest.mark.parametrize(
    ("content", "said"), [(None, "no such file"), (b"", "is empty"), (b"junk junk", "is no ROS bag: it begins with")]
)
def test_what_is_no_bag_is_one_line_and_code_4(tmp_path, capfd, content, said):
    path = tmp_path / "x.bag"
    if content is not None:
        path.write_bytes(content)
    for command in (
        ("info",),
        ("check",),
        ("convert", "--out", tmp_path / "y.bag"),
        ("extract", "--out", tmp_path / "e"),
    ):
        assert uvgs("bag", command[0], path, *command[1:]) == 4
        lines = capfd.readouterr().err.strip().splitlines()
        assert len(lines) == 1
        assert said in lines[0]
    assert not (tmp_path / "y.bag").exists()


# --- check -------------------------------------------------------------------------------------------------------


def test_a_healthy_bag_is_healthy(tmp_path, capfd):
    for kind in ("ros1", "db3"):
        code, found = checked(capfd, write_bag(tmp_path, kind, healthy()))
        assert (code, found["verdict"], found["findings"]) == (0, "healthy", [])
        run = found["stamps"]["/cam/image_raw"]
        assert (run["dropped"], run["backwards"], run["jumps"]) == (0, 0, 0)
        assert run["rate_hz"] == pytest.approx(10.0)
    assert uvgs("bag", "check", write_bag(tmp_path, "ros1", healthy())) == 0
    assert "HEALTHY: 40 messages, 0 problems, 0 warnings" in capfd.readouterr().out


def pictures_at(times: list[int], log: list[int] | None = None) -> list[Note]:
    return [image_note(picture(), t, log_ns=None if log is None else log[i]) for i, t in enumerate(times)]


def dropped() -> list[Note]:
    return pictures_at([t for i, t in enumerate(stamps()) if i not in (5, 6, 12)])


def backwards() -> list[Note]:
    times = stamps()
    return pictures_at([*times[:10], times[9] - 50_000_000, *times[11:]], times)


def jumping() -> list[Note]:
    times = stamps()
    return pictures_at([t + (7 * S if i >= 10 else 0) for i, t in enumerate(times)], times)


def late() -> list[Note]:
    return pictures_at(stamps(), [t + 1_240_000_000 for t in stamps()])


def unset() -> list[Note]:
    return pictures_at([0] * 20, stamps())


def repeated() -> list[Note]:
    times = stamps()
    return pictures_at([*times[:5], times[4], *times[6:]], times)


def two_sizes() -> list[Note]:
    return [*healthy(), image_note(picture()[:20], stamps()[-1] + 100_000_000)]


def two_encodings() -> list[Note]:
    return [*healthy(), image_note(picture().astype(np.uint16) * 257, stamps()[-1] + 100_000_000)]


def torn() -> list[Note]:
    note = png_note(picture(), START_NS)
    note.fields["data"] = note.fields["data"][:-20]
    return [note]


def of_light(level: int) -> list[Note]:
    return [image_note(np.full((30, 40), level, dtype=np.uint8), t) for t in stamps()]


def other_lens() -> list[Note]:
    lens = Lens("plumb_bob", 80, 60, LENS.parameters)
    return [camera_info_note(lens, START_NS), image_note(picture(), START_NS)]


def changing_lens() -> list[Note]:
    moved = Lens("plumb_bob", 40, 30, LENS.parameters * [1.01, *[1.0] * 8])
    return [camera_info_note(LENS, START_NS), camera_info_note(moved, START_NS + S)]


def no_lens() -> list[Note]:
    return [camera_info_note(LENS, START_NS, k=np.zeros(9))]


@pytest.mark.parametrize(
    ("notes", "level", "said"),
    [
        (dropped, "warning", "3 messages dropped by its rate of 10 Hz (15.0 %); longest gap 0.300 s at message 5"),
        (backwards, "problem", "header stamps run backwards 1 times, by 0.050 s at message 10"),
        (jumping, "problem", "the header clock jumps 1 times against the bag's, by +7.000 s at message 10"),
        (late, "warning", "recorded 1.240 s later than its header stamps (median)"),
        (unset, "problem", "20 of 20 header stamps were never set"),
        (repeated, "warning", "1 messages carry the stamp of the one before"),
        (two_sizes, "problem", "several sizes: 20 of 40x30, 1 of 40x20"),
        (two_encodings, "warning", "several encodings: 20 of mono8, 1 of mono16"),
        (torn, "problem", "1 of 1 pictures looked at cannot be read: /cam/image_raw/compressed#0: is truncated"),
        (lambda: of_light(3), "problem", "20 of 20 pictures looked at are black (100 %)"),
        (lambda: of_light(255), "problem", "20 of 20 pictures looked at are overexposed (100 %)"),
        (other_lens, "problem", "pictures of 40x30 px, but its CameraInfo is for 80x60 px"),
        (changing_lens, "problem", "the lens changes at message 1"),
        (no_lens, "problem", "K is zero: this camera was never calibrated"),
    ],
)
def test_what_is_wrong_is_a_line(tmp_path, capfd, notes, level, said):
    code, found = checked(capfd, write_bag(tmp_path, "mcap", notes()))
    assert any(finding["level"] == level and said in finding["text"] for finding in found["findings"])
    # Nothing else is wrong with it.
    assert len(found["findings"]) == 1, found["findings"]
    assert code == (1 if level == "problem" else 0)


def test_pictures_are_compared_with_a_calibration(tmp_path, capfd):
    write_calibration(tmp_path / "camera.yaml", spots.calibration())
    path = write_bag(tmp_path, "ros1", healthy())
    code, found = checked(capfd, path, "--camera", tmp_path / "camera.yaml")
    assert code == 1
    assert "but the calibration given is for 1280x960 px" in found["findings"][0]["text"]


def test_without_a_stamp_nothing_can_be_judged(tmp_path, capfd):
    note = Note("/word", "std_msgs/msg/String", START_NS, {"data": "hello"})
    path = write_bag(tmp_path, "mcap", [note])
    code, found = checked(capfd, path)
    assert (code, found["verdict"], found["messages"]) == (3, "inconclusive", 1)
    assert uvgs("bag", "check", path) == 3
    assert "INCONCLUSIVE: no message carries a stamp" in capfd.readouterr().out


def test_damage_is_a_problem(tmp_path, capfd):
    path = write_bag(tmp_path, "ros1", healthy())
    path.write_bytes(path.read_bytes()[:-2000])
    code, found = checked(capfd, path)
    assert code == 1
    assert "read record by record" in found["findings"][0]["text"]
    assert found["stamps"]["/cam/image_raw"]["messages"] >= 15


def landmark_note(count: int, t_ns: int, frame: str = "dock/body", turn: float = 1.0) -> Note:
    def pose(store):
        types = store.types
        point = types["geometry_msgs/msg/Point"](0.0, 0.0, -1.0)
        return types["geometry_msgs/msg/Pose"](point, types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, turn))

    def landmarks(store):
        # Seen from one metre: u = f x / z with f = 50.
        return [store.types[astrobee.LANDMARK](0.1 * i, 0.1, 0.0, 5.0 * i, 5.0) for i in range(count)]

    fields = {"camera_id": 0, "pose": pose, "landmarks": landmarks}
    return Note(astrobee.LANDMARKS_TOPIC, astrobee.LANDMARKS, t_ns, fields, frame=frame)


def registration(t_ns: int) -> Note:
    return Note(astrobee.REGISTRATION_TOPIC, astrobee.REGISTRATION, t_ns, {"camera_id": 0})


def astrobee_bag(folder: Path, notes: list[Note]) -> Path:
    return write_bag(folder, "ros1", notes, types=lambda store: astrobee.add_message_types(store, "v1"))


def test_astrobee_landmarks_are_judged_as_its_localizer_does(tmp_path, capfd):
    write_calibration(tmp_path / "camera.yaml", spots.calibration())
    good = [note for t in stamps() for note in (registration(t), landmark_note(6, t))]
    code, found = checked(capfd, astrobee_bag(tmp_path, good))
    assert (code, found["findings"], found["landmarks"]) == (0, [], {astrobee.LANDMARKS_TOPIC: {}})
    four = [note for t in stamps() for note in (registration(t), landmark_note(4, t))]
    code, found = checked(capfd, astrobee_bag(tmp_path, four))
    assert code == 1
    assert "drops 20 of 20 messages: 4 landmarks, but the localizer ignores" in found["findings"][0]["text"]
    code, found = checked(capfd, astrobee_bag(tmp_path, four), "--min-landmarks", 4)
    assert (code, found["findings"]) == (0, [])
    # With the lens of the camera landmarks are put where the pose says: here they were made for f = 50 px, not 1100.
    code, found = checked(capfd, astrobee_bag(tmp_path, good), "--camera", tmp_path / "camera.yaml")
    assert code == 1
    assert "more than 30 px from where their own pose puts them" in found["findings"][0]["text"]
    odd = [landmark_note(6, START_NS, frame="world", turn=0.0)]
    _, found = checked(capfd, astrobee_bag(tmp_path, odd))
    texts = " ".join(finding["text"] for finding in found["findings"])
    assert "its pose is no pose" in texts
    assert "without a registration" in texts
    assert "in frame 'world', Astrobee's own have 'dock/body'" in texts


# --- convert -----------------------------------------------------------------------------------------------------

TARGETS = [
    ("a.bag", ("--compression", "bz2")),
    ("a.bag", ()),
    ("a.mcap", ()),
    ("a.bag", ("--compression", "lz4")),
    ("a.mcap", ("--compression", "zstd")),
    ("a.db3", ()),
    ("folder", ("--compression", "messages")),
    ("folder", ("--compression", "file", "--storage", "sqlite3")),
]


def contents(path: Path) -> list[tuple[object, ...]]:
    """Every message as numbers, whichever ROS it is of."""
    found = []
    with open_bags([path]) as bags:
        assert bags.remarks == ()
        for message in bags.messages():
            fields = message.decode()
            stamp = fields.header.stamp
            if message.channel.topic.endswith("camera_info"):
                body: object = tuple(getattr(fields, "k", getattr(fields, "K", ())))
            else:
                body = (fields.encoding, fields.step, bytes(fields.data))
            key = (message.log_ns, message.channel.topic, message.channel.msgtype)
            found.append((*key, stamp.sec, stamp.nanosec, fields.header.frame_id, body))
    return found


@pytest.mark.parametrize("kind", ["ros1", "db3"])
def test_converting_loses_nothing(tmp_path, capfd, kind):
    source = write_bag(tmp_path / "source", kind, healthy(3))
    expected = contents(source)
    # Every target once from one of the two.
    for i, (name, words) in enumerate(TARGETS[kind == "db3" :: 2]):
        target = tmp_path / str(i) / name
        assert uvgs("bag", "convert", source, "--out", target, "--json", "--quiet", *words) == 0
        said = json.loads(capfd.readouterr().out)
        assert (said["messages"], said["topics"]) == (6, {"/cam/camera_info": 3, "/cam/image_raw": 3})
        assert said["remarks"] == []
        assert contents(target) == expected
        assert [path.name for path in target.parent.iterdir()] == [name]


def test_converting_one_topic_of_several_bags(tmp_path, capfd):
    notes = healthy(8)
    first, second = write_bag(tmp_path / "1", "ros1", notes[8:]), write_bag(tmp_path / "2", "mcap", notes[:8])
    out = tmp_path / "one.mcap"
    assert uvgs("bag", "convert", first, second, "--out", out, "--topic", "/cam/image_raw", "--quiet") == 0
    assert [entry[0] for entry in contents(out)] == stamps(8)


def test_converting_never_overwrites_unasked(tmp_path, capfd):
    source = write_bag(tmp_path, "ros1", healthy(2))
    out = tmp_path / "b.mcap"
    out.write_text("mine")
    assert uvgs("bag", "convert", source, "--out", out) == 2
    assert "exists already; use --force" in capfd.readouterr().err
    assert out.read_text() == "mine"
    assert uvgs("bag", "convert", source, "--out", out, "--force", "--quiet") == 0
    assert len(contents(out)) == 4
    for words, said in (
        ((source, "--out", source, "--force"), "is the bag that is read"),
        ((source, "--out", tmp_path / "c.zip"), "expected an ending .bag, .mcap or .db3"),
        ((source, "--out", tmp_path / "c.db3", "--compression", "zstd"), "sqlite3 has no compression 'zstd'"),
        ((source, "--out", tmp_path / "c", "--storage", "sqlite3", "--compression", "zstd"), "say messages or file"),
        ((source, "--out", tmp_path / "c.bag", "--topic", "/no"), "no topic /no, expected of: /cam/camera_info"),
    ):
        assert uvgs("bag", "convert", *words) == 2
        assert said in capfd.readouterr().err
    assert not list(tmp_path.glob("c*"))


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3", "folder"])
def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path, capfd, name):
    path = write_bag(tmp_path / "source", "ros1", [image_note(np.zeros((600, 800), np.uint8), t) for t in stamps(9)])
    target = tmp_path / "new" / name
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    # No file may grow beyond this, which to a writer is a full disk.
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_500_000, hard))
    try:
        code = uvgs("bag", "convert", path, "--out", target, "--quiet")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    said = capfd.readouterr().err.strip().splitlines()
    assert code == 4
    assert len(said) == 1
    assert "cannot be written" in said[0]
    assert not list(target.parent.iterdir())


def test_own_types_keep_their_own_definition(tmp_path, capfd):
    source = astrobee_bag(tmp_path, [registration(START_NS), landmark_note(5, START_NS)])
    out, back = tmp_path / "a.mcap", tmp_path / "back.bag"
    assert uvgs("bag", "convert", source, "--out", out, "--quiet") == 0
    assert uvgs("bag", "convert", out, "--out", back, "--quiet") == 0
    for path in (out, back):
        with open_bags([path]) as bags:
            landmarks = next(bags.messages([astrobee.LANDMARKS_TOPIC])).decode()
        assert [mark.u for mark in landmarks.landmarks] == [0.0, 5.0, 10.0, 15.0, 20.0]
    with open_bags([source]) as first, open_bags([back]) as last:
        raw = [[message.raw for message in bags.messages()] for bags in (first, last)]
    assert raw[0] == raw[1]


def test_readers_that_are_not_ours_read_what_is_converted(tmp_path):
    rosbag, mcap = pytest.importorskip("rosbag"), pytest.importorskip("mcap_ros2.reader")
    source = write_bag(tmp_path, "db3", healthy(3))
    pixels = [bytes(entry[-1][-1]) for entry in contents(source) if entry[1] == "/cam/image_raw"]
    for compression in ("none", "bz2", "lz4"):
        out = tmp_path / f"{compression}.bag"
        assert uvgs("bag", "convert", source, "--out", out, "--quiet", "--compression", compression) == 0
        with rosbag.Bag(str(out)) as bag:
            assert [bytes(message.data) for _, message, _ in bag.read_messages("/cam/image_raw")] == pixels
    for compression in ("none", "zstd"):
        out = tmp_path / f"{compression}.mcap"
        assert uvgs("bag", "convert", source, "--out", out, "--quiet", "--compression", compression) == 0
        found = mcap.read_ros2_messages(str(out), topics=["/cam/image_raw"])
        assert [bytes(message.ros_msg.data) for message in found] == pixels


def test_debians_own_tools_read_what_is_converted(tmp_path):
    if not Path("/usr/bin/rosbag").is_file():
        pytest.skip("rosbag of Debian is not installed")
    source = write_bag(tmp_path, "mcap", healthy(4))
    out = tmp_path / "b.bag"
    assert uvgs("bag", "convert", source, "--out", out, "--quiet", "--compression", "bz2") == 0
    for words, said in ((("info", "--yaml"), "type: sensor_msgs/Image"), (("check",), "")):
        done = subprocess.run(
            ["/usr/bin/rosbag", *words, str(out)], capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert said in done.stdout


# --- extract -----------------------------------------------------------------------------------------------------


def test_extracted_pictures_give_the_same_poses(tmp_path, capfd):
    write_calibration(tmp_path / "camera.yaml", spots.calibration())
    write_beacon(tmp_path / "beacon.toml", spots.beacon())
    rng = np.random.default_rng(3)
    notes = []
    for t_ns in stamps(2):
        px = spots.lens().project(spots.random_pose(rng, cone_deg=20.0).apply(spots.beacon().positions_m))
        notes.append(image_note(spots.draw(px, rng), t_ns))
    # As a colour camera sends it: its pattern makes the poses less sure, in the bag and in the folder.
    mosaic = image_note(notes[1].fields["data"].reshape(960, 1280), stamps(3)[2])
    mosaic.fields["encoding"] = "bayer_rggb8"
    path = write_bag(tmp_path, "mcap", [*notes, mosaic])
    folder = tmp_path / "pictures"
    assert uvgs("bag", "extract", path, "--out", folder, "--json", "--quiet") == 0
    assert json.loads(capfd.readouterr().out)["pictures"] == 3
    lines = []
    for source in (f"bag:{path}", f"images:{folder}"):
        out = tmp_path / "poses.csv"
        setup = ("--camera", tmp_path / "camera.yaml", "--beacon", tmp_path / "beacon.toml", "--quiet", "--force")
        assert uvgs("run", source, *setup, "--out", out) == 0
        lines.append([",".join(line.split(",")[:1] + line.split(",")[2:]) for line in out.read_text().splitlines()])
    assert lines[0] == lines[1]
    assert ",ok," in lines[0][1]


def test_extracting_some_again_and_not_over_others(tmp_path, capfd):
    path = write_bag(tmp_path, "ros1", healthy(9))
    out = tmp_path / "pictures"
    assert uvgs("bag", "extract", path, "--out", out, "--every", 2, "--quiet") == 0
    assert len(list(out.glob("*.png"))) == 5
    assert uvgs("bag", "extract", path, "--out", out) == 2
    assert "is not empty; use --force" in capfd.readouterr().err
    assert uvgs("bag", "extract", path, "--out", out, "--limit", 2, "--force", "--quiet") == 0
    assert sorted(file.name for file in out.iterdir()) == ["000000.png", "000001.png", "stamps.csv"]
    (out / "mine.txt").write_text("kept")
    assert uvgs("bag", "extract", path, "--out", out, "--force") == 2
    assert "holds mine.txt, which no extraction wrote" in capfd.readouterr().err
    shutil.rmtree(out)
    assert uvgs("bag", "extract", path, "--out", out, "--topic", "/imu") == 2
    assert "no topic '/imu' of images" in capfd.readouterr().err


@pytest.mark.shared_data
def test_bags_of_others_are_described_checked_and_converted(tmp_path, capfd):
    if not BAGS.is_dir():
        pytest.skip(f"no recorded bags at {BAGS}")
    for name, healthy_code in (("aruco_images.bag", 0), ("zstd_messages.mcap", 0)):
        assert uvgs("bag", "info", BAGS / name) == 0
        code, found = checked(capfd, BAGS / name)
        assert code == healthy_code
        for target in ("a.bag", "b.mcap"):
            assert uvgs("bag", "convert", BAGS / name, "--out", tmp_path / name / target, "--quiet") == 0
            code, again = checked(capfd, tmp_path / name / target)
            assert again["stamps"] == found["stamps"]
