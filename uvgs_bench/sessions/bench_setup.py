"""From files to an open bench and a run: what is read, what is copied, what is opened, in which order."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.devices.bench import Bench
from uvgs_bench.devices.cameras.registry import open_camera
from uvgs_bench.devices.clock import Clock, RealClock, SteppedClock
from uvgs_bench.devices.gantry.gantry import ControllerInfo
from uvgs_bench.devices.gantry.registry import is_simulated, open_gantry, spec_on_bench
from uvgs_bench.errors import ConfigError, RunError, UnreadableDocument
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.sessions.beacon_group import check_group, group_sensor
from uvgs_bench.sessions.early_log import EarlyLog
from uvgs_bench.sessions.events import EventSink, Remark, ignore_events
from uvgs_bench.sessions.interruption import interruptible
from uvgs_bench.sessions.planning import Plan, plan
from uvgs_bench.sessions.procedure import read_procedure
from uvgs_bench.sessions.provenance import controller_facts, program_versions
from uvgs_bench.sessions.resume import check_same_setup, resume_sweep
from uvgs_bench.sessions.sweep import Rig, SweepResult, run_sweep
from uvgs_bench.store.beacons import read_beacon
from uvgs_bench.store.bench import read_bench
from uvgs_bench.store.calibrations import read_calibration
from uvgs_bench.store.documents import read_document
from uvgs_bench.store.run import Run, RunManifest, RunWriter
from uvgs_bench.store.run_types import SETUP_OTHER_BEACON
from uvgs_bench.store.run_writer import (
    SETUP_BEACON,
    SETUP_BENCH,
    SETUP_CALIBRATION,
    SETUP_GANTRY,
    SETUP_PROCEDURE,
    SETUP_SENSOR,
    utc_now,
)
from uvgs_bench.store.toml_text import toml_text

if TYPE_CHECKING:
    from uvgs_bench.devices.sim.bench import SimulatedBench

DEFAULT_SIMULATED_SPEED = 50.0
_CONTROLLER_SETTINGS = "controller_settings"


@dataclass(frozen=True, slots=True, eq=False)
class SetUp:
    """Everything a sweep depends on, read and checked; nothing is open yet.

    Args:
        bench: The bench.
        plan: The checked plan.
        calibration: The camera.
        beacon: The beacon.
        config: Settings of the sensor.
        gantry_spec: Spec of the gantry, from the bench file or given in its place.
        camera_spec: Spec of the camera, likewise.
        files: Content of each set-up file by the name of its copy.
        sources: Where each was read, by the same name.
        noise_seed: Seed of the simulated bench in place of the bench file's, or None.
        others: The bench's other beacons, in its order.
    """

    bench: Bench
    plan: Plan
    calibration: Calibration
    beacon: Beacon
    config: UvgsConfig
    gantry_spec: str
    camera_spec: str
    files: dict[str, bytes]
    sources: dict[str, str]
    noise_seed: int | None = None
    others: tuple[Beacon, ...] = ()

    @property
    def is_simulated(self) -> bool:
        """Whether the gantry or the camera is simulated."""
        return _is_simulated(self.gantry_spec) or _is_simulated(self.camera_spec)

    @property
    def is_group(self) -> bool:
        """Whether poses are those of a group: several beacons, or a path that is corrected by what is seen."""
        motion = self.plan.motion
        return bool(self.others) or (motion is not None and motion.correction_limit_m is not None)

    def hashes(self, info: ControllerInfo) -> dict[str, str]:
        """SHA-256 of each set-up file and of the controller's settings, by name."""
        settings = json.dumps(info.settings, sort_keys=True).encode()
        contents = self.files | {_CONTROLLER_SETTINGS: settings}
        return {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}


def read_setup(
    procedure: Path,
    bench: Path,
    *,
    camera: Path | None = None,
    gantry_spec: str | None = None,
    camera_spec: str | None = None,
    seed: int | None = None,
    sensor: Path | None = None,
) -> SetUp:
    """Read and check everything a sweep depends on.

    Args:
        procedure: The procedure file.
        bench: The bench file.
        camera: Calibration file in place of the bench's.
        gantry_spec: Spec in place of the bench's.
        camera_spec: Spec in place of the bench's.
        seed: Seed of the procedure and of the simulated bench in place of the files'.
        sensor: Settings of the sensor in place of the bench's.

    Returns:
        The set-up; a motion takes no more captures than the sensor's ``rate_hz``.

    Raises:
        ConfigError: A file is missing or says something that cannot be meant, or camera and gantry do not go together.
        EnvelopeError: The procedure leaves the envelope.
    """
    described = read_bench(bench)
    planned = plan(read_procedure(procedure).seeded(seed), described.envelope)
    camera_file = Path(described.camera_file) if camera is None else camera
    if not camera_file.exists():
        raise UnreadableDocument(
            "no camera calibration: make one with uvgs calibrate, or name one with --camera", str(camera_file)
        )
    sources = {
        SETUP_CALIBRATION: camera_file,
        SETUP_BEACON: Path(described.beacon_file),
        SETUP_BENCH: bench,
        SETUP_PROCEDURE: procedure,
    }
    if described.gantry_file is not None:
        sources[SETUP_GANTRY] = Path(described.gantry_file)
    config = UvgsConfig()
    sensor_file = described.sensor_file if sensor is None else sensor
    if sensor_file is not None:
        sources[SETUP_SENSOR] = Path(sensor_file)
        config = read_document(sources[SETUP_SENSOR], UvgsConfig)
    if planned.motion is not None and 0.0 < config.rate_hz < planned.motion.captures_hz:
        planned = replace(planned, motion=replace(planned.motion, captures_hz=config.rate_hz))
    calibration, beacon = read_calibration(camera_file), read_beacon(sources[SETUP_BEACON])
    others = tuple(read_beacon(Path(other.file)) for other in described.others)
    sources |= {
        f"{SETUP_OTHER_BEACON}{other.name}.toml": Path(place.file)
        for place, other in zip(described.others, others, strict=True)
    }
    check_group(described, planned, (beacon, *others), str(procedure))
    files = {name: _content(path) for name, path in sources.items()}
    # The defaults of this version, so that another version can solve the pictures with the same settings.
    files.setdefault(SETUP_SENSOR, toml_text({"schema": 1} | asdict(config)).encode())
    set_up = SetUp(
        bench=described,
        plan=planned,
        calibration=calibration,
        beacon=beacon,
        config=config,
        gantry_spec=described.gantry_port if gantry_spec is None else gantry_spec,
        camera_spec=described.camera_source if camera_spec is None else camera_spec,
        files=files,
        sources={name: str(path.resolve()) for name, path in sources.items()},
        noise_seed=seed,
        others=others,
    )
    if _is_own_camera(set_up.camera_spec) and not _is_own_gantry(set_up.gantry_spec):
        raise ConfigError(
            f"the simulated camera (sim:) sees only the simulated gantry, not {set_up.gantry_spec}", key="camera_source"
        )
    return set_up


def read_setup_of(
    run: Run,
    *,
    procedure: Path | None = None,
    bench: Path | None = None,
    camera: Path | None = None,
    gantry_spec: str | None = None,
    camera_spec: str | None = None,
) -> SetUp:
    """Read again what a run was begun with, from where it was read then.

    Args:
        run: The run.
        procedure: Another place of the procedure file.
        bench: Another place of the bench file.
        camera: Another place of the calibration file.
        gantry_spec: Spec in place of the run's: a port may have another name after a restart.
        camera_spec: Spec in place of the run's.

    Returns:
        The set-up as it is now; whether it is the same, ``check_same_setup`` tells.

    Raises:
        RunError: The run does not say where its files were.
        ConfigError: As ``read_setup``.
        EnvelopeError: As ``read_setup``.
    """
    manifest = run.manifest
    missing = [name for name in (SETUP_PROCEDURE, SETUP_BENCH, SETUP_CALIBRATION) if name not in manifest.sources]
    if missing:
        raise RunError(f"does not say where its {missing[0]} came from", str(run.path))
    set_up = read_setup(
        procedure or Path(manifest.sources[SETUP_PROCEDURE]),
        bench or Path(manifest.sources[SETUP_BENCH]),
        camera=camera or Path(manifest.sources[SETUP_CALIBRATION]),
        gantry_spec=gantry_spec or manifest.gantry_spec,
        camera_spec=camera_spec or manifest.camera_spec,
        seed=manifest.seed,
        sensor=Path(manifest.sources[SETUP_SENSOR]) if SETUP_SENSOR in manifest.sources else None,
    )
    # Captures after a seam must not repeat the simulated noise of those before it.
    return replace(set_up, noise_seed=manifest.seed + 1_000_003 * (1 + len(run.seams)))


def sweep(
    set_up: SetUp,
    folder: Path,
    *,
    keep: str = "all",
    simulated_speed: float = DEFAULT_SIMULATED_SPEED,
    sink: EventSink = ignore_events,
    on_bench: Callable[[SimulatedBench], None] | None = None,
) -> SweepResult:
    """Open the bench, begin a run, and sweep.

    Args:
        set_up: What was read.
        folder: Where the run folder is made.
        keep: Which pictures are kept: ``all``, ``worst`` or ``none``.
        simulated_speed: How much faster than real time a simulated bench runs.
        sink: Receives progress.
        on_bench: Called with the simulated bench once it stands, for who compares with its truth.

    Returns:
        What was taken.

    Raises:
        UvgsError: As ``open_rig`` and ``run_sweep``; a bench that cannot be opened leaves no run folder.
        KeyboardInterrupt: As ``run_sweep``.
    """
    log = EarlyLog()
    with interruptible(), open_rig(set_up, log, simulated_speed, on_bench) as rig:
        now = datetime.now(UTC)
        path = _free_folder(folder, f"{now:%Y%m%dT%H%M%SZ}_{set_up.plan.procedure.name}")
        writer = RunWriter.create(path, _manifest(set_up, rig, path.name, keep), set_up.files)
        log.forward_to(writer)
        return run_sweep(set_up.plan, rig, writer, sink=sink)


def resume(
    run: Run,
    set_up: SetUp,
    *,
    simulated_speed: float = DEFAULT_SIMULATED_SPEED,
    sink: EventSink = ignore_events,
    accepts_changes: bool = False,
) -> SweepResult:
    """Open the bench and take up a run that ended early.

    Args:
        run: The run.
        set_up: What was read now, by ``read_setup_of``.
        simulated_speed: How much faster than real time a simulated bench runs.
        sink: Receives progress.
        accepts_changes: Whether changed files and settings are accepted; the seam names them and keeps the files.

    Returns:
        What was taken now.

    Raises:
        RunError: The set-up changed, or something moved, or the run ends with a motion, which cannot be taken up.
        UvgsError: As ``open_rig`` and ``run_sweep``.
        KeyboardInterrupt: As ``run_sweep``.
    """
    if set_up.plan.motion is not None:
        raise RunError("ends with a motion, which is not taken up in the middle: begin a new run", str(run.path))
    log = EarlyLog()
    with interruptible(), open_rig(set_up, log, simulated_speed) as rig:
        hashes = set_up.hashes(rig.gantry.info)
        accepted = check_same_setup(run, set_up.plan, hashes, accepts_changes=accepts_changes)
        writer = RunWriter.reopen(run, rig.clock.now_ns())
        log.forward_to(writer)
        if accepted:
            sink(Remark("warning", f"taken up although changed since it was begun: {', '.join(accepted)}"))
            writer.keep_changed({name: set_up.files[name] for name in accepted if name in set_up.files})
        return resume_sweep(run, set_up.plan, rig, writer, sink=sink, accepted=accepted)


@contextmanager
def open_rig(
    set_up: SetUp,
    log: EarlyLog,
    simulated_speed: float = DEFAULT_SIMULATED_SPEED,
    on_bench: Callable[[SimulatedBench], None] | None = None,
) -> Iterator[Rig]:
    """Open gantry, camera and sensor, and close them at the end, the gantry last to be opened and first to be closed.

    Args:
        set_up: What was read.
        log: Receives everything on the gantry's wire.
        simulated_speed: How much faster than real time a simulated bench runs.
        on_bench: Called with the simulated bench once it stands.

    Yields:
        The open devices; the sensor has its kernels compiled and has seen that the camera's pictures fit.

    Raises:
        UvgsError: Gantry or camera cannot be opened, or the camera's pictures do not fit the calibration.
    """
    with ExitStack() as stack:
        clock: Clock = RealClock()
        gantry_spec, camera_spec = set_up.gantry_spec, set_up.camera_spec
        if _is_own_gantry(gantry_spec):
            from uvgs_bench.devices.sim.bench import start_simulated_bench

            twin = start_simulated_bench(
                set_up.bench,
                set_up.beacon,
                speed=simulated_speed,
                seed=set_up.noise_seed,
                others=set_up.others,
                # Pictures take longer to draw than to expose: in motion time waits for them.
                clock=None if set_up.plan.motion is None else SteppedClock(),
            )
            stack.callback(twin.close)
            if on_bench is not None:
                on_bench(twin)
            clock, gantry_spec = twin.clock, spec_on_bench(gantry_spec, twin.name) or twin.gantry_spec
            camera_spec = twin.camera_spec if _is_own_camera(camera_spec) else camera_spec
        sensor = Uvgs(set_up.calibration, set_up.beacon, set_up.config, clock=_stage_clock)
        sensor.warm_up()
        others = [Uvgs(set_up.calibration, other, set_up.config, clock=_stage_clock) for other in set_up.others]
        for each in others:
            each.warm_up()
        camera = stack.enter_context(open_camera(camera_spec, clock=clock))
        first = camera.grab()
        if first is not None:
            # A picture of another size than the calibration's is refused here, before anything moves.
            sensor.solve(first)
        gantry = stack.enter_context(
            open_gantry(
                gantry_spec,
                set_up.bench.envelope,
                clock=clock,
                log=log,
                homing_timeout_s=set_up.bench.homing_timeout_s,
            )
        )
        if not set_up.is_group:
            yield Rig(gantry, camera, sensor, clock)
            return
        group = group_sensor(set_up.bench, (sensor, *others), set_up.plan.motion, lambda: gantry.state().position)
        yield Rig(gantry, camera, group, clock)


def _stage_clock() -> float:
    import time

    return time.perf_counter()


def _is_simulated(spec: str) -> bool:
    return spec.startswith("sim:") or is_simulated(spec)


def _is_own_gantry(spec: str) -> bool:
    """Whether a spec means the simulated gantry of the bench file, not one that runs already."""
    return spec_on_bench(spec, "") is not None


def _is_own_camera(spec: str) -> bool:
    return spec == "sim:"


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise UnreadableDocument(f"cannot be read: {error.strerror or error}", str(path)) from None


def _free_folder(folder: Path, name: str) -> Path:
    """The name, or with a number when two runs begin in the same second."""
    path, number = folder / name, 1
    while path.exists():
        number += 1
        path = folder / f"{name}-{number}"
    return path


def _manifest(set_up: SetUp, rig: Rig, run_id: str, keep: str) -> RunManifest:
    procedure, info = set_up.plan.procedure, rig.gantry.info
    return RunManifest(
        id=run_id,
        created_utc=utc_now(),
        procedure_name=procedure.name,
        mount=set_up.bench.mount,
        axes=set_up.bench.envelope.axes,
        limits=procedure.limits,
        seed=procedure.seed,
        hashes=set_up.hashes(info),
        versions=program_versions(),
        gantry_info=controller_facts(info) | {"judged_by": set_up.bench.judged_by},
        camera_spec=set_up.camera_spec,
        gantry_spec=set_up.gantry_spec,
        simulated=set_up.is_simulated,
        plan_hash=set_up.plan.plan_hash,
        station_count=len(set_up.plan.stations),
        captures_per_station=procedure.captures_per_station,
        keep=keep,
        started_t_ns=rig.clock.now_ns(),
        settle_s=procedure.settle_s,
        gantry_sigma_m=set_up.bench.position_sigma_m,
        sources=set_up.sources,
        mounted=set_up.bench.mounted,
        approach=procedure.approach,
    )
