"""A live camera for a stream: its settings told, its captures queued, its losses waited out."""

from __future__ import annotations

from uvgs_bench.devices.cameras.live_queue import CameraNews, LiveQueue
from uvgs_bench.devices.cameras.registry import open_camera
from uvgs_bench.devices.cameras.source import CameraSource, ReadBack
from uvgs_bench.sessions.events import EventSink, Remark

# Automatic exposure and gain of most cameras come to rest within so many frames.
_WARM_UP = 5


def queued(opened: CameraSource, sink: EventSink, *, patience_s: float) -> LiveQueue:
    """Queue the captures of a live camera.

    Args:
        opened: The open camera; the queue closes it.
        sink: Where settings the camera did not take, and its losses, are told.
        patience_s: How long to wait for it when it is lost, s.

    Returns:
        The queue; it starts to read when it is iterated.
    """

    def tell(news: CameraNews) -> None:
        sink(Remark("warning", news.text))

    _tell_settings(opened, sink)
    return LiveQueue(opened, lambda: open_camera(opened.spec), tell, warm_up=_WARM_UP, patience_s=patience_s)


def _tell_settings(opened: CameraSource, sink: EventSink) -> None:
    if not isinstance(opened, ReadBack):
        return
    for setting in opened.settings:
        said = "does not say what it took" if setting.got is None else f"says {setting.got:g} {setting.unit}".rstrip()
        if setting.is_kept:
            sink(Remark("info", f"{setting.name}: the camera {said}"))
        else:
            asked = f"{setting.asked:g} {setting.unit}".rstrip()
            sink(Remark("warning", f"{setting.name}: asked for {asked}, the camera {said}"))
