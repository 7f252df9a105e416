"""Where ``uvgs run`` sends its answers, opened from the command's options."""

from __future__ import annotations

from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from uvgs_bench.sessions.outlets import Outlet, StreamSetup


def open_outlets(
    stack: ExitStack, setup: StreamSetup, *, out: Path, debug_images: Path | None, force: bool
) -> list[Outlet]:
    """Open what was asked for.

    Args:
        stack: Closes them.
        setup: What the stream is solved with.
        out: Pose file.
        debug_images: Folder of pictures of what each stage saw, or None.
        force: Whether existing files may be replaced.

    Returns:
        The outlets in the order in which they take an answer: what is kept comes before what is shown.

    Raises:
        ConfigError: An ending is unknown, or a file exists and may not be replaced.
        UvgsError: A file cannot be written.
    """
    from uvgs_bench.interop.trajectories import open_pose_writer
    from uvgs_bench.sessions.outlets import DebugFolders, PoseFile

    outlets: list[Outlet] = []

    def add(outlet: Outlet) -> None:
        outlets.append(stack.enter_context(closing(outlet)))

    add(PoseFile(open_pose_writer(out, force=force, beacons=tuple(setup.sensors))))
    if debug_images is not None:
        add(DebugFolders(debug_images, setup.sensors, force=force))
    return outlets
