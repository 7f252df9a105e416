"""Reading ``bench.toml``, and starting the simulated bench it describes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from uvgs_bench.devices.bench import UNJUDGED, Bench, BenchFile, OtherBeacon
from uvgs_bench.devices.sim.passing import PassingBeacon
from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.errors import ConfigError
from uvgs_bench.store.beacons import read_beacon
from uvgs_bench.store.documents import read_document
from uvgs_bench.store.gantry_records import measured_axes, read_gantry_record
from uvgs_bench.units import m_from_mm


def read_bench(path: Path) -> Bench:
    """Read a bench file; the paths in it are relative to its folder.

    Args:
        path: The file.

    Returns:
        The bench, in m and rad, with resolved paths. Of the files it names only the gantry's calibration is opened.

    Raises:
        ConfigError: As ``read_document``, or axes and keep-out boxes that cannot be meant, or a calibration of other
            axes.
    """
    file = read_document(path, BenchFile)
    if not file.gantry.homing_timeout_s > 0.0:
        raise ConfigError(f"must be positive, got {file.gantry.homing_timeout_s}", str(path), "gantry.homing_timeout_s")
    try:
        envelope = file.gantry.envelope()
    except ValueError as error:
        raise ConfigError(str(error), str(path), "gantry") from None
    folder = path.parent
    nominal, gantry_file, judged_by = envelope.axes, None, UNJUDGED
    if file.gantry.calibration is not None:
        gantry_file = folder / file.gantry.calibration
        record = read_gantry_record(gantry_file)
        envelope = replace(envelope, axes=measured_axes(record, nominal, str(gantry_file)))
        judged_by = record.judged_by
    return Bench(
        name=file.name,
        camera_file=str(folder / file.camera),
        beacon_file=str(folder / file.beacon),
        camera_source=file.camera_source,
        gantry_port=file.gantry.port,
        envelope=envelope,
        mount=file.mount,
        homing_timeout_s=file.gantry.homing_timeout_s,
        position_sigma_m=m_from_mm(file.gantry.position_sigma_mm),
        sensor_file=None if file.sensor is None else str(folder / file.sensor),
        simulated=file.simulated,
        path=str(path),
        nominal_axes=nominal,
        gantry_file=None if gantry_file is None else str(gantry_file),
        judged_by=judged_by,
        mounted=file.mounted_pose(),
        standing=file.standing_pose(),
        others=tuple(OtherBeacon.of(other, str(folder / other.beacon)) for other in file.others),
    )


def read_passing_beacon(path: Path, seed: int | None = None, companions: Sequence[Path] = ()) -> PassingBeacon:
    """The scene of ``sim:bench.toml``: the file's camera and beacon, the beacon passing before the camera.

    Args:
        path: The bench file.
        seed: Seed in place of the truth's.
        companions: Files of further beacons that ride beside it.

    Returns:
        The scene.

    Raises:
        ConfigError: As ``read_bench`` and ``read_beacon``, or a truth that does not fit the beacon.
    """
    bench = read_bench(path)
    others = tuple(read_beacon(file) for file in companions)
    return PassingBeacon(bench.simulated or SimulatedTruth(), read_beacon(Path(bench.beacon_file)), seed, others)
