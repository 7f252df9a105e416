"""Whatever is written into a bag comes back, and what is left of a cut bag is what was written."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uvgs_bench.errors import FormatError
from uvgs_bench.interop.bag_writer import NewBag
from uvgs_bench.interop.bags import open_bags

FORMATS = [("p.bag", "none"), ("p.bag", "bz2"), ("p.mcap", "none"), ("p.mcap", "zstd")]
# Some hours in which clocks run backwards too; texts that end a chunk by themselves and texts that do not.
MESSAGES = st.lists(
    st.tuples(
        st.sampled_from(["/a", "/b/c", "/d_1"]),
        st.integers(0, 4 * 3600) | st.integers(0, 3),
        st.integers(0, 999_999_999),
        st.integers(0, 50) | st.sampled_from([1 << 16, 1 << 19]),
        st.booleans(),
    ),
    max_size=12,
)


def write(path: Path, compression: str, rows) -> list[tuple[int, str, str]]:
    bag = NewBag(path, compression=compression)
    written = []
    for number, (topic, sec, nanosec, length, is_hurried) in enumerate(rows):
        t_ns, text = sec * 10**9 + nanosec, f"{number}:" + "ä" * length
        bag.hurry(is_hurried)
        bag.write(topic, t_ns, bag.make.text(text))
        written.append((t_ns, topic, text))
    bag.close()
    return written


def read(path: Path) -> tuple[list[tuple[int, str, str]], tuple[str, ...]]:
    with open_bags([path]) as bags:
        found = [(m.log_ns, m.channel.topic, m.decode().data) for m in bags.messages()]
        return found, bags.remarks


@pytest.mark.parametrize(("name", "compression"), FORMATS)
@settings(max_examples=6)
@given(rows=MESSAGES)
def test_everything_comes_back(name, compression, rows):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        written = write(path, compression, rows)
        found, remarks = read(path)
    assert remarks == ()
    assert sorted(found) == sorted(written)
    assert [t_ns for t_ns, _, _ in found] == sorted(t_ns for t_ns, _, _ in written)


@pytest.mark.parametrize(("name", "compression"), FORMATS)
@settings(max_examples=8)
@given(rows=MESSAGES, share=st.floats(0.0, 1.0, exclude_max=True))
def test_what_is_left_of_a_cut_bag_was_written(name, compression, rows, share):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        written = write(path, compression, rows)
        payload = path.read_bytes()
        path.write_bytes(payload[: int(share * len(payload))])
        try:
            found, remarks = read(path)
        except FormatError:
            return
    assert set(found) <= set(written)
    assert len(found) == len(written) or remarks
