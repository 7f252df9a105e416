"""Where ``uvgs run`` sends its answers, opened from the command's options."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from uvgs_bench.errors import ConfigError

if TYPE_CHECKING:
    from uvgs_bench.interop.bag_writer import Annotate
    from uvgs_bench.sessions.events import EventSink
    from uvgs_bench.sessions.outlets import Outlet, Outlets, StreamSetup

Compression = Literal["none", "bz2", "zstd"]
_BAGS = (".bag", ".mcap")
_ENDINGS = (".csv", ".tum", ".jsonl", *_BAGS)


@dataclass(frozen=True, slots=True)
class OutletOptions:
    """What the command line says about its answers.

    Args:
        out: Pose files and bags.
        compression: Of bags; None for none.
        images: Whether bags get the pictures.
        annotated: Whether bags get pictures of what the sensor saw.
        astrobee: Version of Astrobee's messages in bags, or None for none.
        udp: ``HOST:PORT`` of a controller, or None.
        rate_hz: Most answers a second that are told while the stream runs, or None.
        debug_images: Folder of pictures of what each stage saw, or None.
        force: Whether existing files may be replaced.
    """

    out: tuple[Path, ...]
    compression: Compression | None = None
    images: bool = False
    annotated: bool = False
    astrobee: Literal["v1", "v2"] | None = None
    udp: str | None = None
    rate_hz: float | None = None
    debug_images: Path | None = None
    force: bool = False

    def check(self, source: str, record: Path | None, *shown: object) -> None:
        """Refuse options that cannot be meant together.

        Args:
            source: What is read; nothing may be written over it.
            record: File of the record, or None.
            shown: Further places that are told while the stream runs, None or False when they are not.

        Raises:
            ConfigError: Nothing would get the answers, a file is named twice, or an option has nothing to act on.
        """
        records = () if record is None else (record,)
        is_told = self.udp is not None or any(shown)
        if not self.out and not records and not is_told:
            raise ConfigError(f"is needed: name a file that ends in one of {', '.join(_ENDINGS)}", "--out")
        for path in self.out:
            if (*self.out, *records).count(path) > 1:
                raise ConfigError(f"{path} is named twice", "--out")
        # Before any is opened: a file that was begun for nothing would be in the way the next time.
        for path in self.out:
            if path.suffix not in _ENDINGS:
                raise ConfigError(f"unknown ending '{path.suffix}', expected one of: {', '.join(_ENDINGS)}", str(path))
        for path in (*self.out, *records):
            if path.exists() and not self.force:
                raise ConfigError("exists already; use --force to replace it", str(path))
        read = {Path(part).absolute() for part in (source, *source.partition(":")[2].partition("?")[0].split(","))}
        for path in (*self.out, *records):
            if path.absolute() in read or any(path.exists() and file.exists() and path.samefile(file) for file in read):
                raise ConfigError("is what is read; write to another file", str(path))
        has_bag = any(path.suffix in _BAGS for path in self.out)
        for word, ending in (("bz2", ".bag"), ("zstd", ".mcap")):
            if self.compression == word and not any(path.suffix == ending for path in (*self.out, *records)):
                raise ConfigError(f"{word} compresses {ending} files, but none is written", "--compression")
        for name, value in (("--astrobee", self.astrobee), ("--images", self.images), ("--annotated", self.annotated)):
            if value and not has_bag:
                raise ConfigError("needs an --out that ends in .bag or .mcap", name)
        if self.rate_hz is not None and not is_told:
            raise ConfigError(
                "limits what is told while the stream runs, but nothing is: name --udp or --view", "--rate-hz"
            )


def open_outlets(
    stack: ExitStack,
    setup: StreamSetup,
    options: OutletOptions,
    sink: EventSink,
    more: Sequence[Outlet] = (),
    last: Sequence[Outlet] = (),
) -> Outlets:
    """Open what was asked for.

    Args:
        stack: Closes them.
        setup: What the stream is solved with.
        options: What was asked for.
        sink: Where warnings go.
        more: Outlets that are open already.
        last: Outlets that are open already and are shown to people.

    Returns:
        The outlets in the order in which they take an answer: what is told at once, what is kept, what is drawn.

    Raises:
        ConfigError: An ending is unknown, or a file exists and may not be replaced.
        UvgsError: A file cannot be written.
    """
    from uvgs_bench.interop.trajectories import open_pose_writer
    from uvgs_bench.sessions.outlets import DebugFolders, Outlets, PoseFile
    from uvgs_bench.sessions.telemetry import UdpTelemetry

    if options.astrobee is not None:
        _warn_of_minimum(setup, sink)
    outlets: list[Outlet] = []
    with ExitStack() as opening:

        def add(outlet: Outlet) -> None:
            opening.callback(outlet.close)
            outlets.append(outlet)

        if options.udp is not None:
            # First: whoever steers by it waits for nothing else.
            add(UdpTelemetry(options.udp, sink, options.rate_hz))
        outlets += more
        for path in options.out:
            if path.suffix in _BAGS:
                add(_bag(path, setup, options))
            else:
                add(PoseFile(open_pose_writer(path, force=options.force, beacons=tuple(setup.sensors))))
        if options.debug_images is not None:
            add(DebugFolders(options.debug_images, setup.sensors, force=options.force))
        opening.pop_all()
    opened = Outlets([*outlets, *last], sink)
    stack.callback(opened.close)
    return opened


def _bag(path: Path, setup: StreamSetup, options: OutletOptions) -> Outlet:
    from functools import partial

    from uvgs_bench.interop.bag_writer import BagContents, BagPoses, NewBag
    from uvgs_bench.sessions.debug_images import draw_debug_image
    from uvgs_bench.sessions.outlets import PoseFile

    annotate: dict[str, Annotate] = {}
    if options.annotated:
        annotate = {name: partial(draw_debug_image, uvgs=uvgs) for name, uvgs in setup.sensors.items()}
    fitting = {".bag": "bz2", ".mcap": "zstd"}[path.suffix] == options.compression
    compression = options.compression if fitting and options.compression else "none"
    bag = NewBag(path, compression=compression, version=options.astrobee, force=options.force)
    beacons = {beacon.name: beacon for beacon in setup.beacons}
    contents = BagContents(setup.calibration.lens, beacons, options.astrobee, options.images, annotate)
    return PoseFile(BagPoses(bag, contents))


def _warn_of_minimum(setup: StreamSetup, sink: EventSink) -> None:
    """The localizer says nothing when it drops a message; so it is said here, once."""
    from uvgs_bench.interop.astrobee import LocalizerSettings
    from uvgs_bench.sessions.events import Remark

    wanted = LocalizerSettings().min_landmarks
    few = [f"{beacon.name} has {len(beacon.leds)}" for beacon in setup.beacons if len(beacon.leds) < wanted]
    if few:
        sink(
            Remark(
                "warning",
                f"Astrobee's localizer as shipped drops messages with fewer than {wanted} landmarks without a word, "
                f"and {', '.join(few)} LEDs: lower min_num_matches_per_measurement of the AR tags to 4",
            )
        )
