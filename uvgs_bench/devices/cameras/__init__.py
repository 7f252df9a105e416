"""Cameras and recordings of cameras.

In: a spec string such as ``images:FOLDER``. Out: captures with their instants. Plug point: ``CAMERAS`` in
``registry.py``; the steps are in ``source.py``.
"""

from uvgs_bench.devices.cameras.registry import CAMERAS, open_camera
from uvgs_bench.devices.cameras.source import CameraSource

__all__ = ["CAMERAS", "CameraSource", "open_camera"]
