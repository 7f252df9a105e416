"""ROS bags, one or several read as one: ROS 1, ROS 2 in MCAP or SQLite, folders with or without ``metadata.yaml``.

A file is known by its first bytes, not by its name. Compression is undone wherever it is: in chunks, of single
messages, of whole files. A bag whose index cannot be used is read record by record (``bag_recovery``); what is lost is
said in ``remarks``, and only a bag without anything readable is an error.
"""

from __future__ import annotations

import heapq
import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from uvgs_bench.errors import FormatError
from uvgs_bench.interop.bag_file import BagFile, BagMessage
from uvgs_bench.interop.bag_opening import open_bag_file

_STORAGE = (".mcap", ".db3", ".zstd", ".zst")
BAG_SUFFIXES = frozenset({".bag", ".active", *_STORAGE})
"""Endings of files that are taken for bags when nothing else is said."""


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag: a file by its ending, a folder by the storage files in it."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or any(path.glob("*.mcap")) or any(path.glob("*.db3"))
    return path.suffix in BAG_SUFFIXES


class Bags:
    """Bags read as one, in order of their own times.

    Args:
        files: By bag, the files of each in order.
        remarks: What is already known to be wrong.
    """

    def __init__(self, files: Sequence[Sequence[BagFile]], remarks: list[str]) -> None:
        self._files = files
        self._remarks = remarks

    @property
    def files(self) -> tuple[BagFile, ...]:
        """All files."""
        return tuple(file for bag in self._files for file in bag)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is wrong, as far as it was read."""
        return (*self._remarks, *(text for file in self.files for text in file.remarks))

    @property
    def counts(self) -> dict[str, int]:
        """Messages by topic, in alphabetical order."""
        found: dict[str, int] = {}
        for file in self.files:
            for channel, count in file.counts.items():
                found[channel.topic] = found.get(channel.topic, 0) + count
        return dict(sorted(found.items()))

    @property
    def types(self) -> dict[str, str]:
        """Type by topic; the first where bags differ."""
        return {channel.topic: channel.msgtype for file in reversed(self.files) for channel in reversed(file.counts)}

    def messages(self, topics: Collection[str] = ()) -> Iterator[BagMessage]:
        """Messages of all bags, merged.

        Args:
            topics: Of these topics; of all when empty.

        Yields:
            Messages.
        """
        bags = [(message for file in bag for message in file.messages(topics)) for bag in self._files]
        yield from bags[0] if len(bags) == 1 else heapq.merge(*bags, key=lambda message: message.log_ns)

    def close(self) -> None:
        """Release the files. Safe to call twice."""
        for file in self.files:
            file.close()

    def __enter__(self) -> Self:
        """Enter a context that closes the bags."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()


def open_bags(paths: Sequence[Path | str]) -> Bags:
    """Open bags.

    Args:
        paths: Files or rosbag2 folders.

    Returns:
        The bags.

    Raises:
        FormatError: One is missing, is no bag, or has nothing that can be read.
    """
    opened: list[list[BagFile]] = []
    remarks: list[str] = []
    try:
        for given in paths:
            files = _storage_files(Path(given), remarks)
            opened.append([])
            for path in files:
                try:
                    opened[-1].append(open_bag_file(path))
                except FormatError as error:
                    if len(files) == 1:
                        raise
                    remarks.append(f"{error}; left out")
            if not opened[-1]:
                raise FormatError("none of its files can be read", str(given))
    except BaseException:
        Bags(opened, []).close()
        raise
    return Bags(opened, remarks)


def _storage_files(path: Path, remarks: list[str]) -> list[Path]:
    if not path.exists():
        raise FormatError("no such file, expected a ROS bag", str(path))
    if path.is_file():
        return [path]
    there = sorted((f for f in path.iterdir() if f.suffix in _STORAGE and f.is_file()), key=_natural)
    metadata = path / "metadata.yaml"
    if metadata.is_file():
        names = re.findall(
            r"^\s*-\s*[\"']?([^\s\"':]+\.(?:mcap|db3)(?:\.zstd|\.zst)?)[\"']?\s*$", _text(metadata), re.M
        )
        listed = list(dict.fromkeys(path / Path(name).name for name in names))
        missing = [file.name for file in listed if file not in there]
        if missing:
            remarks.append(f"{path}: {', '.join(missing)} of its metadata.yaml is not there")
        there = [file for file in listed if file in there] + [file for file in there if file not in listed]
    if not there:
        raise FormatError("holds no .mcap or .db3 file, expected a rosbag2 folder", str(path))
    return there


def _text(path: Path) -> str:
    return path.read_text("utf-8", "replace")


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]
