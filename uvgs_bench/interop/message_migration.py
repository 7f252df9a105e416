"""Messages of ROS 1 as messages of ROS 2, and back: field by field, by name.

Types that both know take the definition of the target (a ROS 1 header has a running number, ``CameraInfo`` has capital
letters); others keep their own. What has no place on the other side is told, once per field.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from uvgs_bench.errors import FormatError
from uvgs_bench.interop.bag_framing import needed_types

_RENAMED = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}
# The running number of ROS 1 headers: nobody misses it.
_UNMISSED = frozenset({("std_msgs/msg/Header", "seq")})


class Migration:
    """From the types of one bag to those of the other ROS.

    Args:
        source: The type store the messages come with.
        is_to_ros2: Whether the target is ROS 2.
        tell: Told what is lost or made up, a line each.
    """

    def __init__(self, source: Any, *, is_to_ros2: bool, tell: Callable[[str], None]) -> None:
        from rosbags.typesys import Stores, get_typestore

        standard = get_typestore(Stores.ROS2_HUMBLE if is_to_ros2 else Stores.ROS1_NOETIC)
        self._source = source
        self._tell = tell
        self._told: set[str] = set()
        self.store: Any = get_typestore(Stores.EMPTY)
        """The type store of the target."""
        names = (self.name(name) for name in source.fielddefs)
        self.store.register(needed_types(names, {**source.fielddefs, **standard.fielddefs}))

    @staticmethod
    def name(msgtype: str) -> str:
        """The target's name of a type."""
        return _RENAMED.get(msgtype, msgtype)

    def message(self, value: Any, msgtype: str) -> Any:
        """A message of the target.

        Args:
            value: A message of the source.
            msgtype: Its type in the source.

        Returns:
            The same in the target's type.

        Raises:
            FormatError: The target knows no such type.
        """
        target = self.name(msgtype)
        if target not in self.store.fielddefs:
            raise FormatError(f"type {target} is not known", msgtype)
        own = {name.lower(): name for name, _ in self._source.fielddefs[msgtype][1]}
        kinds = dict(self._source.fielddefs[msgtype][1])
        fields = []
        for name, kind in self.store.fielddefs[target][1]:
            source = own.pop(name.lower(), None)
            if source is None or kinds[source][0] != kind[0]:
                if (target, name) not in _UNMISSED:
                    self._say(f"{target}: {name} is not in the source, written as zero or empty")
                fields.append(self._default(kind))
            else:
                fields.append(self._field(getattr(value, source), kinds[source], kind))
        for name in own.values():
            if (msgtype, name) not in _UNMISSED:
                self._say(f"{msgtype}: {name} has no place in the target and is left out")
        return self.store.types[target](*fields)

    def _field(self, value: Any, source: Any, target: Any) -> Any:
        word = target[0].name
        if word == "NAME":
            return self.message(value, source[1])
        if word in ("ARRAY", "SEQUENCE") and target[1][0][0].name == "NAME":
            return [self.message(item, source[1][0][1]) for item in value]
        return value

    def _default(self, kind: Any) -> Any:
        import numpy as np

        word, inner = kind[0].name, kind[1]
        if word == "BASE":
            return "" if inner[0] == "string" else 0
        if word == "NAME":
            defaults = [self._default(field) for _, field in self.store.fielddefs[inner][1]]
            return self.store.types[inner](*defaults)
        (element, count) = inner
        size = count if word == "ARRAY" else 0
        if element[0].name == "BASE" and element[1][0] != "string":
            return np.zeros(
                size, dtype={"bool": "bool", "char": "uint8", "byte": "uint8"}.get(element[1][0], element[1][0])
            )
        return [self._default(element) for _ in range(size)]

    def _say(self, text: str) -> None:
        if text not in self._told:
            self._told.add(text)
            self._tell(text)
