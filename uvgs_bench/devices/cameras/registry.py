"""The table of camera sources and the one way to open them.

To add a source see ``source.py``. Its class has ``open(spec, clock)`` and is imported when its scheme is asked for.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from uvgs_bench.devices.cameras.source import CameraSource
from uvgs_bench.devices.cameras.spec import CameraSpec, did_you_mean
from uvgs_bench.devices.clock import Clock, RealClock
from uvgs_bench.errors import ConfigError

CAMERAS: dict[str, str] = {
    "images": "uvgs_bench.devices.cameras.images:ImageFolder",
    "video": "uvgs_bench.devices.cameras.video:VideoFile",
    "bag": "uvgs_bench.devices.cameras.bag:BagImages",
    "uvc": "uvgs_bench.devices.cameras.uvc:UvcCamera",
    "rtsp": "uvgs_bench.devices.cameras.network:NetworkStream",
    "http": "uvgs_bench.devices.cameras.network:NetworkStream",
    "https": "uvgs_bench.devices.cameras.network:NetworkStream",
    "aravis": "uvgs_bench.devices.cameras.aravis:AravisCamera",
    "realsense": "uvgs_bench.devices.cameras.realsense:RealSenseCamera",
    "ros1": "uvgs_bench.devices.cameras.ros_topic:RosTopic",
    "ros2": "uvgs_bench.devices.cameras.ros_topic:RosTopic",
    "sim": "uvgs_bench.devices.sim.camera:SimulatedCamera",
    "sim-board": "uvgs_bench.devices.sim.waved_board:WavedBoard",
}
"""Scheme -> ``module:Class``."""


def is_bag_path(spec: str) -> bool:
    """Whether a spec is the path of a bag that is there, with or without options.

    Args:
        spec: What the user wrote.

    Returns:
        Whether ``bag:`` is meant.
    """
    if spec.partition(":")[0] in CAMERAS:
        return False
    from uvgs_bench.interop.bags import is_bag

    path = Path(spec.partition("?")[0])
    return path.exists() and is_bag(path)


def open_camera(spec: str, *, clock: Clock | None = None) -> CameraSource:
    """Open a camera or a recording.

    Args:
        spec: ``images:FOLDER?glob=*.png``, ``video:FILE``, ``bag:FILE?topic=/camera``, ``uvc:0`` or ``sim:NAME``; the
            path of a bag alone will do.
        clock: The bench clock that stamps a live camera's captures; the machine's monotonic clock when None.

    Returns:
        The open source.

    Raises:
        ConfigError: The scheme or an option is unknown.
        CaptureError: It cannot be opened.
    """
    parsed = CameraSpec.parse(f"bag:{spec}" if is_bag_path(spec) else spec)
    if parsed.scheme not in CAMERAS:
        known = tuple(CAMERAS)
        raise ConfigError(f"unknown kind of camera '{parsed.scheme}'{did_you_mean(parsed.scheme, known)}", spec)
    module, _, name = CAMERAS[parsed.scheme].partition(":")
    source: CameraSource = getattr(import_module(module), name).open(parsed, clock or RealClock())
    return source
