"""An examination of the machine: what is here, what is missing, and which feature that costs."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from uvgs_bench import __version__
from uvgs_bench.devices.system_packages import find_package

State = Literal["ok", "missing", "broken"]

_CORE = (
    "opencv-contrib-python-headless", "numpy", "scipy", "numba", "pyserial", "typer", "rich", "rosbags",
    "matplotlib", "jinja2", "typst", "pydantic", "ruamel.yaml",
)  # fmt: skip
_EXTRAS = (
    ("gtsam", "gtsam", "factor-graph fusion", "pip install 'uvgs-bench[fusion]'"),
    ("foxglove", "foxglove-sdk", "live view in Foxglove", "pip install 'uvgs-bench[live]'"),
    ("pyrealsense2", "pyrealsense2", "RealSense cameras", "pip install 'uvgs-bench[realsense]'"),
    ("distributed", "distributed", "studies and batches on a cluster", "pip install 'uvgs-bench[cluster]'"),
    ("gi", "Aravis", "GigE and USB3 Vision cameras", "apt install gir1.2-aravis-0.8 python3-gi"),
    ("rospy", "ROS 1", "node and topics of ROS 1", "source its setup.bash, or apt install python3-rospy"),
    ("rclpy", "ROS 2", "node and topics of ROS 2", "source its setup.bash"),
)
_LOW_DISK_BYTES = 2 * 1024**3


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the examination.

    Args:
        area: What it belongs to: ``python``, ``opencv``, ``gantry`` and so on.
        item: The thing.
        state: ``ok``, ``missing`` (a feature is not available) or ``broken`` (the installation cannot work).
        text: What is there, or what it costs and how to get it.
    """

    area: str
    item: str
    state: State
    text: str


def examine() -> list[Finding]:
    """Look at the machine; changes nothing and opens no device.

    Returns:
        The findings in the order a person reads them.
    """
    return [
        Finding(
            "python", "uvgs-bench", "ok", f"{__version__} on Python {platform.python_version()}, {platform.machine()}"
        ),
        *_packages(),
        *_compiled_code(),
        *_opencv(),
        *_gantry_ports(),
        *_cameras(),
        *_fonts(),
        *_extras(),
        _disk(),
    ]


def _packages() -> list[Finding]:
    findings = []
    for name in _CORE:
        try:
            findings.append(Finding("python", name, "ok", importlib.metadata.version(name)))
        except importlib.metadata.PackageNotFoundError:
            found = name == "opencv-contrib-python-headless" and importlib.util.find_spec("cv2") is not None
            text = "another OpenCV package provides cv2" if found else "not installed: reinstall uvgs-bench"
            findings.append(Finding("python", name, "ok" if found else "broken", text))
    return findings


def _opencv() -> list[Finding]:
    try:
        import cv2
    except ImportError as error:
        return [Finding("opencv", "cv2", "broken", f"cannot be imported: {error}")]
    backends = {cv2.videoio_registry.getBackendName(backend) for backend in cv2.videoio_registry.getBackends()}
    charuco = hasattr(cv2, "aruco") and hasattr(cv2.aruco, "CharucoDetector")
    fisheye = hasattr(cv2, "fisheye")
    return [
        Finding("opencv", "version", "ok", f"{cv2.__version__}, {cv2.getNumThreads()} threads"),
        Finding(
            "opencv", "ChArUco", "ok" if charuco else "broken", "detector present" if charuco else "no aruco module"
        ),
        Finding(
            "opencv", "fisheye", "ok" if fisheye else "missing", "present" if fisheye else "no cross-check of lenses"
        ),
        _has("opencv", "FFMPEG", "FFMPEG" in backends, "video files can be read", "video files cannot be read"),
        _has("opencv", "V4L2", "V4L2" in backends, "USB cameras can be opened", "USB cameras cannot be opened"),
    ]


def _has(area: str, item: str, present: bool, good: str, bad: str) -> Finding:
    return Finding(area, item, "ok" if present else "missing", good if present else bad)


def _compiled_code() -> list[Finding]:
    try:
        from uvgs_bench.geometry import se3
    except ImportError as error:
        return [Finding("python", "compiled code", "broken", str(error))]
    path = getattr(getattr(se3.hat, "stats", None), "cache_path", None)
    if not path:
        return [
            Finding(
                "python",
                "compiled code",
                "missing",
                "no folder to keep it in, so every command compiles for a minute: set NUMBA_CACHE_DIR",
            )
        ]
    return [Finding("python", "compiled code", "ok", f"kept in {path}")]


def _gantry_ports() -> list[Finding]:
    try:
        from serial.tools import list_ports
    except ImportError as error:
        return [Finding("gantry", "pyserial", "broken", str(error))]
    findings = []
    for port in sorted(list_ports.comports(), key=lambda p: str(p.device)):
        usable = os.access(port.device, os.R_OK | os.W_OK)
        known = f" ({port.description})" if port.description not in (None, "", "n/a") else ""
        remedy = "no permission: add yourself to the group 'dialout'"
        text = f"can be opened as grbl:{port.device}{known}" if usable else remedy
        findings.append(Finding("gantry", str(port.device), "ok" if usable else "missing", text))
    if not findings:
        findings.append(
            Finding("gantry", "serial ports", "missing", "none found; the simulated gantry grbl:sim:// works")
        )
    if Path("/usr/sbin/ModemManager").exists():
        findings.append(
            Finding("gantry", "ModemManager", "missing", "it may grab ttyACM ports: disable it on the bench")
        )
    return findings


def _cameras() -> list[Finding]:
    devices = sorted(Path("/dev").glob("video*"))
    if not devices:
        return [Finding("camera", "/dev/video*", "missing", "no USB camera; images:, video: and sim: work")]
    return [
        _has(
            "camera", str(device), os.access(device, os.R_OK | os.W_OK), "can be opened", "no permission: group 'video'"
        )
        for device in devices
    ]


def _fonts() -> list[Finding]:
    try:
        import matplotlib

        folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    except ImportError as error:
        return [Finding("report", "matplotlib", "broken", str(error))]
    present = (folder / "DejaVuSans.ttf").is_file()
    return [_has("report", "fonts", present, "DejaVu Sans, as in every report", "the PDF falls back to a serif font")]


def _extras() -> list[Finding]:
    return [
        _has(
            "extra",
            item,
            find_package(module) is not None,
            f"{feature} available",
            f"no {feature}: {remedy}",
        )
        for module, item, feature, remedy in _EXTRAS
    ]


def _disk() -> Finding:
    free = shutil.disk_usage(Path.cwd()).free
    temporary = os.access(tempfile.gettempdir(), os.W_OK)
    if not temporary:
        return Finding("disk", tempfile.gettempdir(), "broken", "the temporary folder cannot be written")
    text, is_low = f"{free / 1024**3:.1f} GiB free here", free < _LOW_DISK_BYTES
    remedy = ": little for kept pictures; sweep with --keep worst or none" if is_low else ""
    return Finding("disk", str(Path.cwd()), "missing" if is_low else "ok", text + remedy)
