"""Registrations as files: how the frames of one bench sat together, with what the data could not tell."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from uvgs_bench.accuracy import Registration
from uvgs_bench.accuracy.bench_terms import TERM_COUNT
from uvgs_bench.accuracy.clusters import Estimate
from uvgs_bench.accuracy.observations import Mount
from uvgs_bench.accuracy.registration import FRAMES_BY_MOUNT
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.geometry.se3 import euler_zyx_from_rotation
from uvgs_bench.store.documents import SCHEMA_KEY, read_toml, write_atomically
from uvgs_bench.store.toml_text import toml_text
from uvgs_bench.units import deg_from_rad, m_from_mm, mm_from_m, mrad_from_rad, ms_from_s, rad_from_mrad, s_from_ms


def registration_tables(registration: Registration, run_id: str) -> dict[str, object]:
    """A registration as plain tables, the same for files and for ``--json``.

    Args:
        registration: The registration.
        run_id: The run it was fitted on.

    Returns:
        Keys to plain values; a standard deviation of 0 means the gauge holds that direction.
    """
    return {
        SCHEMA_KEY: 1,
        "run": run_id,
        "mount": registration.mount,
        "rank": registration.rank,
        "gauge": registration.gauge,
        "blind_spots": list(registration.blind_spots),
        "stations": registration.station_count,
        "captures": registration.capture_count,
        "downweighted_captures": registration.downweighted_count,
        "outliers": registration.outlier_count,
        "variance_factor": registration.variance_factor,
        "degrees_of_freedom": registration.degrees_of_freedom,
        "gantry_sigma_mm": mm_from_m(registration.gantry_sigma_m),
        "sensor_factor": registration.sensor_factor,
        "stopping_sigma_mm": mm_from_m(registration.stopping_sigma_m),
        "left": _pose_table(registration, "left"),
        "right": _pose_table(registration, "right"),
        **_term_tables(registration),
    }


def _term_tables(registration: Registration) -> dict[str, object]:
    """Table ``terms`` of what was fitted beside the poses, with the reasons; nothing when none was asked for."""
    if not registration.term_notes:
        return {}
    table: dict[str, object] = {"notes": list(registration.term_notes)}
    axes = registration.axis_terms
    if axes is not None:
        table |= {
            "scale": axes.scale.tolist(),
            "scale_half_width": axes.half_widths[:3].tolist(),
            "shear_mrad": mrad_from_rad(axes.shear_rad).tolist(),
            "shear_half_width_mrad": mrad_from_rad(axes.half_widths[3:]).tolist(),
            "held_directions": axes.null_directions.tolist(),
        }
    if registration.time_offset_s is not None:
        table |= {"time_offset_ms": _with_ends(registration.time_offset_s.scaled(ms_from_s(1.0)))}
    if registration.time_rate is not None:
        table |= {"time_rate": _with_ends(registration.time_rate)}
    if np.any(registration.terms[6:]):
        table["origin_ns"] = registration.origin_ns
    return {"terms": table}


def _with_ends(found: Estimate) -> list[float]:
    return [found.value, found.low, found.high]


@dataclass(frozen=True, slots=True, eq=False)
class RegisteredTerms:
    """What a registration file says besides the two poses.

    Args:
        values: Scales x, y, z, shears xy, xz, yz, time offset and its rate, shape (8,), 1, rad, s, s/s; zero where not
            fitted: as ``moved_carriage_m`` takes them.
        origin_ns: Instant for which the time offset is quoted, ns.
    """

    values: FloatArray
    origin_ns: int


def read_registered_terms(path: Path) -> RegisteredTerms:
    """Read the terms of a registration file.

    Args:
        path: The file.

    Returns:
        The terms; all zero when none were fitted, or asked for.

    Raises:
        UnreadableDocument: It is missing or unreadable.
        ConfigError: Its terms are none.
    """
    table: Any = read_toml(path).get("terms", {})
    values = np.zeros(TERM_COUNT)
    try:
        values[:3] = table.get("scale", 0.0)
        values[3:6] = rad_from_mrad(np.asarray(table.get("shear_mrad", 0.0), dtype=np.float64))
        values[6] = s_from_ms(float(table.get("time_offset_ms", [0.0])[0]))
        values[7] = float(table.get("time_rate", [0.0])[0])
        return RegisteredTerms(read_only(values), int(table.get("origin_ns", 0)))
    except (AttributeError, IndexError, TypeError, ValueError) as error:
        raise ConfigError(f"these are no terms as uvgs register writes them: {error}", str(path), "terms") from None


def write_registration(path: Path, registration: Registration, run_id: str, *, force: bool = False) -> None:
    """Write a registration as TOML.

    Args:
        path: The file.
        registration: The registration.
        run_id: The run it was fitted on.
        force: Whether an existing file may be replaced.

    Raises:
        ConfigError: The file exists and may not be replaced.
        UvgsError: It cannot be written.
    """
    write_atomically(path, toml_text(registration_tables(registration, run_id)), force=force)


def read_registered_poses(path: Path, mount: Mount) -> tuple[Pose, Pose]:
    """Read the two poses of a registration file.

    Args:
        path: The file.
        mount: Which part rides the carriage on the bench the poses are meant for.

    Returns:
        Left and right pose, as in ``Registration``.

    Raises:
        UnreadableDocument: It is missing or unreadable.
        ConfigError: It is no registration, or one of a bench with the other mount.
    """
    tables = read_toml(path)
    if tables.get("mount") != mount:
        raise ConfigError(f"is {tables.get('mount')!r}, this bench has {mount!r}", str(path), "mount")
    poses = []
    for part, (target, source) in zip(("left", "right"), FRAMES_BY_MOUNT[mount], strict=True):
        table = tables.get(part)
        if not isinstance(table, dict):
            raise ConfigError("this table is required, as uvgs register writes it", str(path), part)
        if (table.get("target"), table.get("source")) != (target, source):
            raise ConfigError(f"must be {target}_from_{source}", str(path), part)
        try:
            turn = np.asarray(table["quaternion_xyzw"], dtype=np.float64)
            shift_m = m_from_mm(np.asarray(table["translation_mm"], dtype=np.float64))
            poses.append(Pose.from_quaternion(turn, shift_m, target, source))
        except KeyError as error:
            raise ConfigError("this key is required", str(path), f"{part}.{error.args[0]}") from None
        except (TypeError, ValueError) as error:
            raise ConfigError(f"is no pose: {error}", str(path), part) from None
    return poses[0], poses[1]


def _pose_table(registration: Registration, part: Literal["left", "right"]) -> dict[str, object]:
    pose = registration.left if part == "left" else registration.right
    turn_rad, shift_m = registration.sigmas(part)
    yaw, pitch, roll = euler_zyx_from_rotation(pose.R)
    covariance = registration.left_covariance if part == "left" else registration.right_covariance
    return {
        "target": pose.target,
        "source": pose.source,
        "translation_mm": mm_from_m(pose.t_m).tolist(),
        "quaternion_xyzw": pose.quaternion_xyzw().tolist(),
        "euler_zyx_deg": [deg_from_rad(yaw), deg_from_rad(pitch), deg_from_rad(roll)],
        "sigma_translation_mm": mm_from_m(shift_m).tolist(),
        "sigma_rotation_deg": deg_from_rad(turn_rad).tolist(),
        "tangent_covariance_rad_m": covariance.tolist(),
    }
