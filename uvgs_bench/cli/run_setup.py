"""What ``uvgs run`` needs before its first capture: calibration, beacons, parameters, the open source."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from uvgs_bench.errors import ConfigError, RunError

if TYPE_CHECKING:
    from uvgs_bench.beacon import Beacon
    from uvgs_bench.camera.calibration import Calibration
    from uvgs_bench.devices.cameras.live_queue import LiveQueue
    from uvgs_bench.devices.cameras.source import ExposureControl
    from uvgs_bench.sensor.capture import Capture
    from uvgs_bench.sensor.config import UvgsConfig
    from uvgs_bench.sensor.handover import HandoverPolicy
    from uvgs_bench.sensor.uvgs import Uvgs
    from uvgs_bench.sessions.events import EventSink
    from uvgs_bench.sessions.exposure_loop import ExposureLoop
    from uvgs_bench.sessions.record_setup import RecordSetup
    from uvgs_bench.store.run import Run


def recorded_run(source: str) -> Run | None:
    """The run behind a source that is a run folder.

    Args:
        source: What the user wrote.

    Returns:
        The run, or None for the spec of a camera.

    Raises:
        ConfigError: It is a folder without a run.
        RunError: There is no such folder.
    """
    from uvgs_bench.devices.cameras.registry import is_bag_path
    from uvgs_bench.store.run import is_run, read_run

    folder = Path(source)
    if is_run(folder):
        return read_run(folder)
    if ":" not in source and not is_bag_path(source):
        if folder.is_dir():
            raise ConfigError(f"that folder is no run; for pictures write images:{source}", source)
        if folder.suffix in (".bag", ".mcap", ".db3"):
            raise RunError("there is no such bag", source)
        raise RunError(f"there is no such run folder; for pictures write images:{source}", source)
    return None


def read_setup(
    recorded: Run | None,
    camera: Path | None,
    beacon: list[Path],
    config: Path | None,
    again: RecordSetup | None = None,
) -> tuple[Calibration | None, list[Beacon], UvgsConfig]:
    """Read what the captures are solved with; a run folder and a record have their own unless told otherwise.

    Args:
        recorded: The run, or None.
        camera: Calibration file, or None.
        beacon: Beacon files.
        config: Sensor parameters, or None.
        again: Setup of the record, or None.

    Returns:
        Calibration, beacons and parameters; no calibration when only the source may know it (``lens_of``).

    Raises:
        ConfigError: Something is missing, beacons share a name, or one hue is asked for several.
        FormatError: A file is missing or broken.
    """
    from uvgs_bench.sensor.config import UvgsConfig
    from uvgs_bench.store.beacons import read_beacon
    from uvgs_bench.store.calibrations import read_calibration
    from uvgs_bench.store.documents import read_document
    from uvgs_bench.store.run_writer import SETUP, SETUP_SENSOR

    has_own = recorded is not None or again is not None
    if not beacon and not has_own:
        raise ConfigError("is needed unless the source is a run folder or a record", "--beacon")
    calibration = read_calibration(camera) if camera is not None else None
    beacons = [read_beacon(path) for path in beacon]
    if recorded is not None:
        calibration, beacons = calibration or recorded.calibration, beacons or [recorded.beacon]
        own = recorded.path / SETUP / SETUP_SENSOR
        config = own if config is None and own.is_file() else config
    if again is not None:
        calibration, beacons = calibration or again.calibration, beacons or list(again.beacons)
    names = [lights.name for lights in beacons]
    for path, lights in zip(beacon, beacons, strict=False):
        if names.count(lights.name) > 1:
            raise ConfigError(f"several beacons are named '{lights.name}'; each needs a name of its own", str(path))
    default = UvgsConfig() if again is None else again.parameters
    parameters = default if config is None else read_document(config, UvgsConfig)
    if len(beacons) > 1 and parameters.hue_deg is not None:
        raise ConfigError(
            "one hue cannot hold for several beacons; it belongs into their files", str(config), "hue_deg"
        )
    return calibration, beacons, parameters


def lens_of(opened: OpenedSource) -> Calibration:
    """The lens that the source itself carries: the CameraInfo of a bag or of a topic.

    Args:
        opened: The open source.

    Returns:
        The calibration; how sure it is, is not known.

    Raises:
        ConfigError: It carries none.
        CaptureError: What it says is no lens.
    """
    found = None if opened.camera_info is None else opened.camera_info()
    if found is None:
        raise ConfigError("is needed unless the source is a run folder, a record, or says its lens", "--camera")
    return found


def handover_policy(
    mode: Literal["quality", "position", "command"],
    zones: list[str],
    hold_s: float | None,
    names: tuple[str, ...],
    active: str | None,
) -> HandoverPolicy:
    """The handover of the command's options.

    Args:
        mode: How the active beacon is chosen.
        zones: ``NAME=NEAR:FAR`` texts, m.
        hold_s: How long a pose is held, s, or None for the usual.
        names: Names of the beacons.
        active: Beacon that is active at first, or None.

    Returns:
        The policy.

    Raises:
        ConfigError: An option does not fit the others or names no beacon.
    """
    from uvgs_bench.sensor.handover import HandoverPolicy

    known = ", ".join(names)
    if active is not None and active not in names:
        raise ConfigError(f"unknown beacon '{active}', expected one of: {known}", "--active")
    if zones and mode != "position":
        raise ConfigError("needs --handover position", "--zone-m")
    zones_m: dict[str, tuple[float, float]] = {}
    for text in zones:
        name, _, span = text.rpartition("=")
        near, _, far = span.partition(":")
        if name not in names:
            raise ConfigError(f"expected NAME=NEAR:FAR with a beacon of {known}, got '{text}'", "--zone-m")
        try:
            zones_m[name] = float(near), float(far)
        except ValueError:
            raise ConfigError(f"expected NAME=NEAR:FAR in m, got '{text}'", "--zone-m") from None
    if hold_s is None:
        hold_s = 0.5 if len(names) > 1 else 0.0
    try:
        # One beacon is always the active one.
        return HandoverPolicy(mode if len(names) > 1 else "quality", zones_m, hold_s=hold_s)
    except ValueError as error:
        raise ConfigError(str(error), "--zone-m") from None


@dataclass(frozen=True, slots=True, eq=False)
class OpenedSource:
    """The source of a stream.

    Args:
        captures: Its captures.
        total: Their number if known.
        exposure: The exposure of its camera, or None when it cannot be set.
        live: The queue of a live camera, or None.
        flags_of: What it has to say about a capture, or None.
        is_live: Whether the captures are taken now, or were when they were recorded.
        camera_info: Asks the source for the lens it carries, or None when it carries none.
    """

    captures: Iterable[Capture]
    total: int | None
    exposure: ExposureControl | None = None
    live: LiveQueue | None = None
    flags_of: Callable[[Capture], tuple[str, ...]] | None = None
    is_live: bool = False
    camera_info: Callable[[], Calibration | None] | None = None


def open_captures(
    source: str, recorded: Run | None, stack: ExitStack, sink: EventSink, reconnect_s: float
) -> OpenedSource:
    """Open the source.

    Args:
        source: What the user wrote.
        recorded: The run behind it, or None.
        stack: Closes it.
        sink: Where settings that the camera did not take, and losses of it, are told.
        reconnect_s: How long to wait for a live camera that was lost, s.

    Returns:
        The source.

    Raises:
        CaptureError: It cannot be opened.
        RunError: The run kept no pictures.
    """
    if recorded is not None:
        from uvgs_bench.sessions.stream import read_run_captures, run_captures

        return OpenedSource(read_run_captures(recorded), len(run_captures(recorded)))
    from uvgs_bench.devices.cameras.registry import open_camera
    from uvgs_bench.devices.cameras.source import CarriesCamera, ExposureControl
    from uvgs_bench.sessions.events import Remark
    from uvgs_bench.sessions.live import queued
    from uvgs_bench.sessions.remarks import told_captures

    opened = open_camera(source)
    carrier: object = opened

    def camera_info() -> Calibration | None:
        found = carrier.camera_info() if isinstance(carrier, CarriesCamera) else None
        if found is not None:
            sink(Remark("info", f"the lens is that of {found.camera_name}; how sure it is, is not known"))
        return found

    if opened.is_live:
        live = stack.enter_context(queued(opened, sink, patience_s=reconnect_s))
        return OpenedSource(live, None, live.exposure, live, live.flags_of, is_live=True, camera_info=camera_info)
    stack.enter_context(opened)
    control: object = opened
    exposure = control if isinstance(control, ExposureControl) else None
    return OpenedSource(told_captures(opened, sink), opened.length, exposure, camera_info=camera_info)


def exposure_loop(
    control: ExposureControl | None, source: str, sensors: dict[str, Uvgs], longest_ms: float
) -> ExposureLoop:
    """The exposure loop of a camera.

    Args:
        control: The camera's exposure, or None.
        source: Its spec, for messages.
        sensors: One sensor per beacon.
        longest_ms: Longest exposure, ms.

    Returns:
        The loop.

    Raises:
        ConfigError: The camera's exposure cannot be set, or the bound is impossible.
    """
    from uvgs_bench.sensor.exposure import ExposurePolicy
    from uvgs_bench.sessions.exposure_loop import ExposureLoop
    from uvgs_bench.units import s_from_ms

    if control is None:
        raise ConfigError("the exposure of this source cannot be set; leave --auto-exposure out", source)
    try:
        policy = ExposurePolicy(longest_s=s_from_ms(longest_ms))
    except ValueError as error:
        raise ConfigError(str(error), "--max-exposure-ms") from None
    return ExposureLoop(control, sensors, policy)
