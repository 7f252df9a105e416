"""Where the answers of a stream go, besides being counted.

To add one: a class with ``put`` and ``close``, opened in ``cli/run_outlets.py``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.errors import ConfigError, UvgsError
from uvgs_bench.interop.bag_writer import BagPoses
from uvgs_bench.interop.trajectories import PoseWriter
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.sessions.debug_images import DebugImages
from uvgs_bench.sessions.events import EventSink, Remark
from uvgs_bench.sessions.stream import Answered


@dataclass(frozen=True, slots=True, eq=False)
class StreamSetup:
    """What a stream is solved with.

    Args:
        source: The spec string of its captures.
        calibration: The camera's calibration.
        beacons: The beacons that are looked for.
        parameters: The sensor's parameters.
        sensors: One sensor per beacon, by the beacon's name.
    """

    source: str
    calibration: Calibration
    beacons: tuple[Beacon, ...]
    parameters: UvgsConfig
    sensors: Mapping[str, Uvgs]


class Outlet(Protocol):
    """Takes every answer in order.

    Contract: ``put`` does not change the answer and returns quickly: the next capture waits for it. What cannot keep
    up drops answers and counts them itself. ``close`` may be called twice, and is called after a failed ``put`` too.
    """

    @property
    def paths(self) -> tuple[Path, ...]:
        """Files it writes; none when it writes no file."""
        ...

    def put(self, answered: Answered) -> None:
        """Take one answer. Raises UvgsError when what it feeds is needed and failed."""
        ...

    def close(self) -> None:
        """End it."""
        ...


class Outlets:
    """All outlets of a stream. One that fails is closed and named; the others go on.

    Args:
        outlets: In the order in which they take an answer.
        sink: Where failures are told.
    """

    def __init__(self, outlets: Sequence[Outlet], sink: EventSink) -> None:
        self._alive = list(outlets)
        self._sink = sink
        self.paths = tuple(path for outlet in outlets for path in outlet.paths)
        """Files that are written."""
        self.failures: list[str] = []
        """What failed, a line each."""

    def put(self, answered: Answered) -> None:
        """Hand an answer to all. Raises UvgsError when the last one has failed."""
        for outlet in tuple(self._alive):
            try:
                outlet.put(answered)
            except UvgsError as error:
                self._alive.remove(outlet)
                with suppress(UvgsError):
                    outlet.close()
                if not self._alive:
                    raise
                self._tell(f"{error}; the poses go on")

    def close(self) -> None:
        """Close all. Safe to call twice."""
        alive, self._alive = self._alive, []
        for outlet in alive:
            try:
                outlet.close()
            except UvgsError as error:
                self._tell(str(error))

    def _tell(self, text: str) -> None:
        self.failures.append(text)
        self._sink(Remark("warning", text))


class PoseFile:
    """One line per capture and beacon in a pose file, or its messages in a bag.

    Args:
        writer: The open writer.
    """

    def __init__(self, writer: PoseWriter | BagPoses) -> None:
        self._writer = writer

    @property
    def paths(self) -> tuple[Path, ...]:
        """The pose files."""
        return self._writer.paths

    def put(self, answered: Answered) -> None:
        """Write the lines of a capture. Raises UvgsError when the disk is full."""
        for outcome, note in answered.lines.values():
            self._writer.write(answered.capture, outcome, note)

    def close(self) -> None:
        """Close the files."""
        self._writer.close()


class DebugFolders:
    """One picture per capture of what each stage saw: in a folder, or in one folder per beacon.

    Args:
        folder: The folder.
        sensors: One sensor per beacon, by the beacon's name.
        force: Whether a folder that is not empty may be used.

    Raises:
        ConfigError: It may not.
    """

    def __init__(self, folder: Path, sensors: Mapping[str, Uvgs], *, force: bool = False) -> None:
        if not force and folder.is_dir() and any(folder.iterdir()):
            raise ConfigError("the folder is not empty; use --force to replace its pictures", str(folder))
        several = len(sensors) > 1
        self._folders = {
            name: DebugImages(folder / name if several else folder, uvgs, force=force) for name, uvgs in sensors.items()
        }

    @property
    def paths(self) -> tuple[Path, ...]:
        """No file that a user would look for by name."""
        return ()

    def put(self, answered: Answered) -> None:
        """Draw the pictures of a capture."""
        for name, folder in self._folders.items():
            folder.write(answered.capture, answered.outcomes[name])

    def close(self) -> None:
        """Nothing is open between pictures."""
