"""Records of ``uvgs run``: kept with ``--record``, solved again when the source is one."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from uvgs_bench.cli.run_setup import OpenedSource
    from uvgs_bench.devices.cameras.source import ExposureControl
    from uvgs_bench.sensor.capture import Capture
    from uvgs_bench.sensor.uvgs import Uvgs
    from uvgs_bench.sessions.events import EventSink
    from uvgs_bench.sessions.exposure_loop import ExposureLoop
    from uvgs_bench.sessions.outlets import StreamSetup
    from uvgs_bench.sessions.recording import Recorder
    from uvgs_bench.sessions.replay import Recording
    from uvgs_bench.sessions.stream import StreamRules


def recording_of(source: str, stack: ExitStack, sink: EventSink) -> Recording | None:
    """The record behind a source.

    Args:
        source: What the user wrote: ``run.mcap`` or ``bag:run.mcap``.
        stack: Closes it.
        sink: Where damage is told.

    Returns:
        The record, or None when the source is something else.

    Raises:
        FormatError: It is a record whose setup cannot be read.
    """
    path = Path(source.removeprefix("bag:"))
    if path.suffix != ".mcap":
        # Most sources: nothing is loaded to find out.
        return None
    from uvgs_bench.sessions.events import Remark
    from uvgs_bench.sessions.provenance import program_versions
    from uvgs_bench.sessions.replay import find_recording

    recording = find_recording(path)
    if recording is None:
        return None
    stack.callback(recording.close)
    versions = recording.setup.versions
    sink(Remark("info", f"{path}: a record of {recording.setup.source} by {versions.get('uvgs_bench', 'unknown')}"))
    now = {name: version for name, version in program_versions().items() if name != "system"}
    other = [f"{name} {versions.get(name, 'none')}, now {now[name]}" for name in now if versions.get(name) != now[name]]
    if other:
        sink(Remark("warning", f"{path}: the last digits of poses may differ, it was made with {'; '.join(other)}"))
    for text in recording.remarks:
        sink(Remark("warning", text))
    return recording


def replayed(recording: Recording, sink: EventSink) -> OpenedSource:
    """The captures of a record, with what came from outside while they were solved; damage found on the way is told."""
    from uvgs_bench.cli.run_setup import OpenedSource

    setup = recording.setup
    control = None if setup.camera is None else recording.exposure(setup.camera)
    return OpenedSource(_told(recording, sink), recording.total, control, None, recording.flags_of, setup.is_live)


def _told(recording: Recording, sink: EventSink) -> Iterator[Capture]:
    from uvgs_bench.sessions.events import Remark

    known = len(recording.remarks)
    try:
        yield from recording.captures()
    finally:
        for text in recording.remarks[known:]:
            sink(Remark("warning", text))


def replayed_rules(asked: StreamRules, recording: Recording, given: frozenset[str]) -> StreamRules:
    """The rules of a record, where the command line does not say otherwise.

    Args:
        asked: The rules of the command line.
        recording: The record.
        given: Names of the options that were written.

    Returns:
        The rules.
    """
    own = recording.setup.rules
    return replace(
        asked,
        limit=asked.limit if "limit" in given else recording.answered or own.limit,
        track=asked.track if "track" in given else own.track,
        threads=asked.threads if "threads" in given else own.threads,
        handover=asked.handover if given & {"handover", "zone_m", "hold_s"} else own.handover,
        active=asked.active if "active" in given else own.active,
        difference=asked.difference if "difference" in given else own.difference,
    )


def replayed_exposure(
    recording: Recording, control: ExposureControl | None, sensors: dict[str, Uvgs]
) -> ExposureLoop | None:
    """The exposure loop of a record around a camera that answers as the recorded one did, or None."""
    from uvgs_bench.sessions.exposure_loop import ExposureLoop

    camera = recording.setup.camera
    return None if camera is None or control is None else ExposureLoop(control, sensors, camera.policy)


def open_recorder(
    path: Path,
    opened: OpenedSource,
    compression: Literal["none", "bz2", "zstd"] | None,
    stack: ExitStack,
    *,
    force: bool,
) -> tuple[Recorder, OpenedSource]:
    """Open a record and let it listen to a source.

    Args:
        path: ``*.mcap``.
        opened: The source.
        compression: As asked for; zstd when nothing was.
        stack: Closes the record when the run fails before it begins.
        force: Whether an existing file may be replaced.

    Returns:
        The record, and the source as it is listened to.

    Raises:
        ConfigError: The ending is another, or the file exists and may not be replaced.
        UvgsError: It cannot be written.
    """
    from uvgs_bench.sessions.recording import Recorder

    recorder = Recorder(path, compression="none" if compression == "none" else "zstd", force=force)
    stack.callback(recorder.close)
    flags_of, control = opened.flags_of, opened.exposure
    return recorder, replace(
        opened,
        captures=recorder.captures(opened.captures),
        flags_of=None if flags_of is None else recorder.flags(flags_of),
        exposure=None if control is None else recorder.exposure(control),
    )


def begin_record(
    recorder: Recorder, setup: StreamSetup, rules: StreamRules, opened: OpenedSource, loop: ExposureLoop | None
) -> None:
    """Say in a record what its captures are solved with."""
    from uvgs_bench.devices.cameras.network import without_password
    from uvgs_bench.sessions.provenance import program_versions
    from uvgs_bench.sessions.record_setup import RecordedCamera, RecordSetup

    control, camera = opened.exposure, None
    if loop is not None and control is not None:
        camera = RecordedCamera(
            loop.policy,
            control.exposure_s,
            control.exposure_limits_s,
            control.full_scale_dn,
            control.settling_captures,
        )
    recorder.begin(
        RecordSetup(
            without_password(setup.source),
            setup.calibration,
            setup.beacons,
            setup.parameters,
            rules,
            camera,
            opened.is_live,
            program_versions(),
        )
    )


def kept_command(
    recorder: Recorder | None, command: Callable[[], str | None] | None
) -> Callable[[], str | None] | None:
    """The commands, kept when there is a record."""
    return command if recorder is None or command is None else recorder.command(command)
