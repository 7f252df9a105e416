"""Hand on what a recorded source has to say about itself while its captures are read."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from uvgs_bench.devices.cameras.source import Remarking
from uvgs_bench.sessions.events import EventSink, Remark

if TYPE_CHECKING:
    from uvgs_bench.devices.cameras.source import CameraSource
    from uvgs_bench.sensor.capture import Capture


def told_captures(source: CameraSource, sink: EventSink) -> Iterator[Capture]:
    """The captures of a source; its remarks go to the sink as warnings, once each, as they come up.

    Args:
        source: The open source.
        sink: Where remarks go.

    Yields:
        Captures.

    Raises:
        CaptureError: The source fails; what it said before is told first.
    """
    told = 0
    talker: object = source
    try:
        while True:
            capture = source.grab()
            told = _tell(talker, told, sink)
            if capture is None:
                return
            yield capture
    finally:
        _tell(talker, told, sink)


def _tell(talker: object, told: int, sink: EventSink) -> int:
    if not isinstance(talker, Remarking):
        return told
    remarks = talker.remarks
    for text in remarks[told:]:
        sink(Remark("warning", text))
    return len(remarks)
