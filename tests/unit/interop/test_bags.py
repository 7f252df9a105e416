"""Bags of every container, whole and damaged: what can be read is read, and the rest is named."""

from __future__ import annotations

import random
import sqlite3
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.bag_files import KINDS, camera_info_note, image_note, write_bag
from uvgs_bench.camera import Lens
from uvgs_bench.errors import FormatError
from uvgs_bench.interop.bag_container import MessageKind
from uvgs_bench.interop.bags import is_bag, open_bags
from uvgs_bench.interop.mcap_container import McapContainer

pytest.importorskip("rosbags")
LENS = Lens("plumb_bob", 40, 30, np.array([50.0, 50.0, 20.0, 15.0, 0.0, 0.0, 0.0, 0.0, 0.0]))


def picture(i: int, shape: tuple[int, int] = (30, 40)) -> np.ndarray:
    """A picture that does not compress, and is like no other."""
    return np.random.default_rng(i).integers(0, 256, shape, dtype=np.uint8)


def notes(shape: tuple[int, int] = (30, 40)):
    found = []
    for i in range(8):
        found.append(camera_info_note(LENS, 10**9 * (i + 1)))
        found.append(image_note(picture(i, shape), 10**9 * (i + 1)))
    return found


def pictures(bags, shape: tuple[int, int] = (30, 40)) -> list[int]:
    """Numbers of the pictures that come out; each must be one that went in, to the last pixel."""
    known = {picture(i, shape).tobytes(): i for i in range(8)}
    return [known[bytes(m.decode().data)] for m in bags.messages(["/cam/image_raw"])]


@pytest.mark.parametrize("kind", KINDS)
def test_every_container_says_the_same(tmp_path, kind):
    path = write_bag(tmp_path, kind, notes())
    assert is_bag(path)
    with open_bags([path]) as bags:
        assert bags.counts == {"/cam/camera_info": 8, "/cam/image_raw": 8}
        assert bags.types["/cam/image_raw"] == "sensor_msgs/msg/Image"
        assert pictures(bags) == list(range(8))
        assert len(list(bags.messages())) == 16
        assert bags.remarks == ()
        assert bags.files[0].span_ns == (10**9, 8 * 10**9)
        word = kind.split("-")[1] if "-" in kind else ""
        expected = {"bz2": "bz2", "lz4": "lz4", "zstd": "zstd", "message": "zstd (messages)", "file": "zstd (file)"}
        assert bags.files[0].compression == expected.get(word, "none")


def test_several_bags_are_one_in_order_of_their_times(tmp_path):
    every = notes()
    first = write_bag(tmp_path / "1", "ros1", every[8:])
    second = write_bag(tmp_path / "2", "mcap", every[:8])
    with open_bags([first, second]) as bags:
        assert pictures(bags) == list(range(8))
        assert bags.counts["/cam/image_raw"] == 8


def test_a_folder_of_several_files_is_one_bag(tmp_path):
    every = notes()
    folder = tmp_path / "split"
    folder.mkdir()
    for i in range(2):
        write_bag(tmp_path / f"part{i}", "mcap", every[8 * i : 8 * i + 8]).rename(folder / f"split_{i}.mcap")
    with open_bags([folder]) as bags:
        assert pictures(bags) == list(range(8))
    listed = "".join(f"    - split_{i}.mcap\n" for i in range(3))
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{listed}")
    with open_bags([folder]) as bags:
        assert pictures(bags) == list(range(8))
        assert bags.remarks == (f"{folder}: split_2.mcap of its metadata.yaml is not there",)
    (folder / "split_1.mcap").write_bytes(b"no bag at all")
    with open_bags([folder]) as bags:
        assert pictures(bags) == list(range(4))
        assert any("split_1.mcap: is no ROS bag" in remark for remark in bags.remarks)


@pytest.mark.parametrize("kind", ["ros1", "ros1-bz2", "ros1-lz4", "mcap", "mcap-zstd", "db3", "mcap-file-lone"])
def test_a_bag_cut_anywhere_gives_a_prefix_or_says_why_not(tmp_path, kind):
    # Of a compressed file the part before a cut comes in blocks of 128 KiB, so pictures of 40 KB.
    shape = (200, 200)
    whole = write_bag(tmp_path, kind, notes(shape), chunk_bytes=100_000).read_bytes()
    path = tmp_path / f"cut{Path(KINDS_SUFFIX[kind])}"
    best = 0
    for size in sorted(random.Random(7).sample(range(len(whole)), 10)):
        path.write_bytes(whole[:size])
        found = []
        with suppress(FormatError), open_bags([path]) as bags:
            found = pictures(bags, shape)
            assert bags.remarks
        # What comes is whole and without holes, and a longer file never says less.
        assert found == list(range(len(found))), size
        assert len(found) >= best, size
        best = len(found)
    assert best >= 6


KINDS_SUFFIX = {
    "ros1": ".bag",
    "ros1-bz2": ".bag",
    "ros1-lz4": ".bag",
    "mcap": ".mcap",
    "mcap-zstd": ".mcap",
    "db3": ".db3",
    "mcap-file-lone": ".mcap.zstd",
}


def checked_mcap(path: Path, compression: str) -> Path:
    """An MCAP file whose chunks carry checksums, a chunk per second."""
    from rosbags.typesys import Stores, get_typestore

    source = write_bag(path.parent / "source", "mcap", notes())
    store = get_typestore(Stores.ROS2_HUMBLE)
    container = McapContainer(path, compression=compression)
    channels = {}
    with open_bags([source]) as bags:
        for topic, name in bags.types.items():
            text, _ = store.generate_msgdef(name, ros_version=2)
            channels[topic] = container.add(topic, MessageKind(name, text, store.hash_rihs01(name)))
        for message in bags.messages():
            container.write(channels[message.channel.topic], message.log_ns, message.raw)
    container.close()
    return path


@pytest.mark.parametrize("kind", ["ros1-bz2", "mcap", "mcap-zstd"])
def test_a_hole_costs_its_chunk_and_nothing_behind_it(tmp_path, kind):
    if kind == "ros1-bz2":
        path = write_bag(tmp_path, kind, notes(), chunk_bytes=1300)
    else:
        path = checked_mcap(tmp_path / "a.mcap", "none" if kind == "mcap" else "zstd")
    whole = path.read_bytes()
    for start in range(0, len(whole) - 100, len(whole) // 11):
        broken = bytearray(whole)
        broken[start + 16 : start + 80] = bytes(64)
        path.write_bytes(broken)
        with open_bags([path]) as bags:
            found = pictures(bags)
            assert bags.remarks or found == list(range(8)), start
        assert found == sorted(set(found)), start
        # A hole of 64 bytes may lie across two chunks.
        assert len(found) >= 6, start


@pytest.mark.parametrize("kind", ["ros1", "ros1-bz2", "mcap"])
def test_no_picture_comes_that_never_was_when_bytes_are_missing_in_the_middle(tmp_path, kind):
    path = write_bag(tmp_path, kind, notes(), chunk_bytes=3000)
    whole = path.read_bytes()
    counts = []
    for start in range(len(whole) // 20, len(whole) - 8, len(whole) // 9):
        path.write_bytes(whole[:start] + whole[start + 4 :])
        found = []
        with suppress(FormatError), open_bags([path]) as bags:
            # Each is compared with what went in, to the last pixel.
            found = pictures(bags)
            assert bags.remarks
        assert found == sorted(set(found)), start
        counts.append(len(found))
    if kind != "mcap":
        # Here it is one chunk, and nothing after the hole can be found again.
        assert min(counts) >= 5


def test_a_definition_that_is_not_what_was_recorded_is_not_used(tmp_path):
    path = write_bag(tmp_path, "ros1", notes())
    # Two fields exchanged: the same bytes would be other numbers. The sum of the definition tells.
    right, wrong = (f"uint32 {a}\nuint32 {b}\nstring".encode() for a, b in (("height", "width"), ("width", "height")))
    broken = path.read_bytes().replace(right, wrong)
    assert broken != path.read_bytes()
    path.write_bytes(broken)
    with open_bags([path]) as bags:
        assert pictures(bags) == list(range(8))
        image = next(bags.messages(["/cam/image_raw"])).decode()
        assert (image.width, image.height) == (40, 30)


def test_a_bag_that_was_never_closed_is_read(tmp_path):
    path = write_bag(tmp_path, "ros1", notes(), chunk_bytes=3000)
    whole = bytearray(path.read_bytes())
    # What a recorder that was killed leaves: no index, and its header says so.
    at = whole.index(b"index_pos=") + len(b"index_pos=")
    index = int.from_bytes(whole[at : at + 8], "little")
    whole[at : at + 8] = bytes(8)
    active = tmp_path / "a.bag.active"
    active.write_bytes(whole[:index])
    with open_bags([active]) as bags:
        assert pictures(bags) == list(range(8))
        assert bags.counts["/cam/camera_info"] == 8
        assert "read record by record" in bags.remarks[0]


def test_rows_that_are_missing_in_a_database_are_named(tmp_path):
    path = write_bag(tmp_path, "db3", notes())
    base = sqlite3.connect(path)
    with base:
        base.execute("DELETE FROM messages WHERE id IN (3, 4)")
        base.execute("UPDATE messages SET topic_id = 99 WHERE id = 1")
    base.close()
    with open_bags([path]) as bags:
        assert pictures(bags) == [0, 2, 3, 4, 5, 6, 7]
        assert "1 messages belong to topics it does not name; left out" in bags.remarks[0]


def test_mcap_of_ros_1_is_read_and_what_is_not_ros_is_named(tmp_path):
    writer_module = pytest.importorskip("mcap.writer")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    text, _ = store.generate_msgdef("sensor_msgs/msg/Image")
    with open_bags([write_bag(tmp_path, "ros1", notes())]) as bags:
        raw = [(m.log_ns, m.raw) for m in bags.messages(["/cam/image_raw"])]
    path = tmp_path / "ros1.mcap"
    with path.open("wb") as file:
        writer = writer_module.Writer(file)
        writer.start(profile="ros1", library="test")
        schema = writer.register_schema("sensor_msgs/Image", "ros1msg", text.encode())
        ours = writer.register_channel("/cam/image_raw", "ros1", schema)
        other = writer.register_channel("/other", "protobuf", writer.register_schema("x.Y", "protobuf", b"?"))
        for log_ns, payload in raw:
            writer.add_message(ours, log_ns, payload, log_ns)
            writer.add_message(other, log_ns, b"not for us", log_ns)
        writer.finish()
    with open_bags([path]) as bags:
        assert pictures(bags) == list(range(8))
        assert bags.counts == {"/cam/image_raw": 8}
        assert any("topic /other holds protobuf messages, not ROS ones" in remark for remark in bags.remarks)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is empty"),
        (b"PK\x03\x04 something else", "begins with b'PK"),
        (b"#ROSBAG V1.2\n", "version 1.2, expected 2.0"),
        (b"#ROSBAG V2.0\n", "no message that can be read"),
        (b"\x89MCAP0\r\n", "no message that can be read"),
        (b"SQLite format 3\x00" + bytes(100), "no message that can be read"),
        (b"\x28\xb5\x2f\xfd" + bytes(20), "cannot be unpacked|holds no bag"),
    ],
)
def test_what_is_no_bag_is_one_line(tmp_path, content, said):
    path = tmp_path / "x.bag"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=said) as caught:
        open_bags([path])
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
    with pytest.raises(FormatError, match="no such file"):
        open_bags([tmp_path / "nowhere.bag"])
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(FormatError, match=r"holds no \.mcap or \.db3 file"):
        open_bags([empty])
