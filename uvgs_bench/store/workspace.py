"""Where the example files are, and how a new workspace is made from them."""

from __future__ import annotations

import shutil
from pathlib import Path

from uvgs_bench.errors import ConfigError, RunError, UvgsError

FOLDERS = ("calib", "procedures")


def examples_folder() -> Path:
    """The folder that holds the example ``calib`` and ``procedures``.

    Returns:
        Inside the installed package, or the checkout the package runs from; both hold the same files.

    Raises:
        RunError: Neither exists: the installation is broken.
    """
    package = Path(__file__).resolve().parent.parent
    for candidate in (package / "_examples", package.parent):
        if all((candidate / name).is_dir() for name in FOLDERS):
            return candidate
    raise RunError("the example files are missing: reinstall uvgs-bench", str(package))


def create_workspace(folder: Path, *, force: bool = False) -> list[Path]:
    """Copy the examples into a folder.

    Args:
        folder: The workspace; created when missing.
        force: Whether existing example files are replaced; other files are never touched.

    Returns:
        The files written, relative to the folder.

    Raises:
        ConfigError: The path is a file, or an example file exists already and may not be replaced.
        UvgsError: The folder cannot be written or the disk is full.
    """
    if folder.exists() and not folder.is_dir():
        raise ConfigError("is a file, expected a folder for the workspace", str(folder))
    source = examples_folder()
    files = [
        path.relative_to(source)
        for name in FOLDERS
        for path in sorted((source / name).rglob("*"))
        if path.is_file() and "__pycache__" not in path.parts
    ]
    taken = [path for path in files if (folder / path).exists()]
    if taken and not force:
        raise ConfigError(f"{taken[0]} exists already; use --force to replace the example files", str(folder))
    try:
        for path in files:
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / path, folder / path)
        (folder / "reports").mkdir(exist_ok=True)
    except OSError as error:
        raise UvgsError(f"{folder}: cannot be written: {error.strerror or error}") from None
    return files
