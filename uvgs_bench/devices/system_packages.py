"""Python packages of the system's package manager that no index has: bindings of ROS 1 and of Aravis.

A virtual environment does not see them, and should not as a whole: its own numpy and OpenCV are newer.
"""

from __future__ import annotations

import importlib.util
from importlib.machinery import ModuleSpec, PathFinder

SYSTEM_PACKAGES = "/usr/lib/python3/dist-packages"
"""Where Debian and Ubuntu keep them."""


def find_package(name: str) -> ModuleSpec | None:
    """Where a package is: in this environment, else among the system's; None when it is nowhere.

    Args:
        name: A package without dots.

    Returns:
        Its spec; one of the system's may have been built for another Python.
    """
    return importlib.util.find_spec(name) or PathFinder.find_spec(name, [SYSTEM_PACKAGES])
