"""One file of a bag, open: its channels and counts, its messages, and the types to decode them with."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from uvgs_bench.errors import FormatError
from uvgs_bench.interop.bag_framing import BagChannel, Record, needed_types, shown, zstd_module

ZSTD = b"\x28\xb5\x2f\xfd"
"""First bytes of what is compressed with zstd; no message begins so."""
# More lines than this about one file help nobody.
_MOST_REMARKS = 5


@dataclass(frozen=True, slots=True, eq=False)
class BagMessage:
    """A message as it stands in a bag.

    Args:
        channel: Where it belongs.
        log_ns: When it was recorded, by the recorder's clock, ns.
        raw: Its bytes, no longer compressed.
        file: The file it comes from.
    """

    channel: BagChannel
    log_ns: int
    raw: bytes
    file: BagFile

    def decode(self) -> Any:
        """Its fields, as attributes.

        Raises:
            FormatError: The bytes are none of its type.
        """
        return self.file.decode(self.channel, self.raw)


@dataclass(slots=True, eq=False)
class BagFile:
    """One file of a bag, open. Opened by ``bag_opening.open_bag_file``.

    Args:
        path: The file as the user knows it.
        kind: ``ROS 1``, ``ROS 2 mcap`` or ``ROS 2 sqlite3``.
        compression: Of its chunks, messages or itself; ``none``.
        counts: Messages by channel.
        remarks: What is wrong with it, a line each.
        span_ns: First and last of its own times, ns; None without messages.
    """

    path: Path
    kind: str
    compression: str
    counts: dict[BagChannel, int]
    remarks: list[str]
    span_ns: tuple[int, int] | None
    _read: Callable[[Collection[str]], Iterator[Record]]
    _close: Callable[[], None]
    _store: Any = field(default=None)

    def messages(self, topics: Collection[str] = ()) -> Iterator[BagMessage]:
        """Its messages in order of the bag's own times; of all topics when none is named."""
        report = reporter(self.path, self.remarks)
        for channel, log_ns, raw in self._read(topics):
            whole = bytes(raw)
            if raw[:4] == ZSTD:
                try:
                    whole = zstd_module().decompress(raw)
                except zstd_module().ZstdError as error:
                    report(f"a message of {channel.topic} cannot be unpacked: {one_line(error)}", -1)
                    continue
            yield BagMessage(channel, log_ns, whole, self)

    def decode(self, channel: BagChannel, raw: bytes) -> Any:
        """The fields of a message. Raises FormatError when the bytes are none of its type."""
        try:
            store = self.typestore
            if channel.wire == "ros1":
                return store.deserialize_ros1(raw, channel.msgtype)
            return store.deserialize_cdr(raw, channel.msgtype)
        except Exception as error:  # the library's decoders have no common base of errors
            raise FormatError(f"is no {channel.msgtype}: {one_line(error)}", str(self.path)) from None

    @property
    def typestore(self) -> Any:
        """The types its definitions say, completed by the standard ones."""
        if self._store is None:
            self._store = _typestore(tuple(self.counts))
        return self._store

    def close(self) -> None:
        """Release the file. Safe to call twice."""
        self._close()


def one_line(error: BaseException) -> str:
    """An error's words in one line."""
    return shown(str(error)) or "its bytes make no sense"


def reporter(path: Path, remarks: list[str]) -> Callable[[str, int], None]:
    """Takes what is wrong and where, and keeps the first few of it as remarks.

    Args:
        path: The file as the user knows it.
        remarks: Where to.

    Returns:
        What scans report to.
    """
    count = 0

    def report(text: str, offset: int) -> None:
        nonlocal count
        line = f"{path}{f':{offset}' if offset >= 0 else ''}: {shown(text)}"
        if line in remarks:
            # A bag may be read more than once.
            return
        count += 1
        if count <= _MOST_REMARKS:
            remarks.append(line)
        elif count == _MOST_REMARKS + 1:
            remarks.append(f"{path}: and more of that kind")

    return report


def _typestore(channels: tuple[BagChannel, ...]) -> Any:
    from rosbags.typesys import Stores, get_typestore

    types: dict[str, Any] = {}
    is_complete = True
    for channel in channels:
        own = _own_types(channel)
        types.update(own)
        is_complete = is_complete and bool(own)
    if not is_complete:
        wires = {channel.wire for channel in channels}
        standard = get_typestore(Stores.ROS1_NOETIC if wires == {"ros1"} else Stores.ROS2_HUMBLE).fielddefs
        types = needed_types((channel.msgtype for channel in channels), {**standard, **types})
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store


def _own_types(channel: BagChannel) -> dict[str, Any]:
    """The types a channel's definition says; none when it says nothing, or not what it was when it was recorded."""
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    found: dict[str, Any] = {}
    try:
        if channel.definition_kind == "msg" and channel.definition:
            found = get_types_from_msg(channel.definition, channel.msgtype)
        elif channel.definition:
            for text in re.split(r"^={80}\nIDL: .*\n", channel.definition, flags=re.MULTILINE):
                found.update(get_types_from_idl(text) if text.strip() else {})
        if found and channel.digest:
            store = get_typestore(Stores.EMPTY)
            store.register(found)
            is_ros1 = channel.wire == "ros1"
            digest = store.generate_msgdef(channel.msgtype)[1] if is_ros1 else store.hash_rihs01(channel.msgtype)
            # Decoded by another definition, bytes become wrong numbers without a word.
            return found if channel.digest in (digest, "*") else {}
    except Exception:  # a definition nobody can read; the standard ones may do
        return {}
    return found
