"""Who did the work: versions of program and libraries, and what answered at the gantry's port."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

from uvgs_bench import __version__
from uvgs_bench.devices.gantry.gantry import ControllerInfo

_LIBRARIES = ("numpy", "scipy", "numba", "opencv-contrib-python-headless", "pyserial")


def program_versions() -> dict[str, str]:
    """Versions by name of this program, the interpreter, the system, and every library a number passes through."""
    versions = {"uvgs_bench": __version__, "python": platform.python_version(), "system": platform.platform()}
    for name in _LIBRARIES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            # Another build of the same library may stand in for it.
            continue
    return versions


def controller_facts(info: ControllerInfo) -> dict[str, str]:
    """Firmware, version, options, every setting by its number (``$130``), every stored offset by its name, as text."""
    settings = {f"${number}": value for number, value in info.settings.items()}
    facts = {"firmware": info.firmware, "version": info.version, "options": info.options}
    return facts | settings | info.parameters
