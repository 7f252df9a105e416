"""Registrations as files: how the frames of one bench sat together, with what the data could not tell."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from uvgs_bench.accuracy import Registration
from uvgs_bench.accuracy.observations import Mount
from uvgs_bench.accuracy.registration import FRAMES_BY_MOUNT
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import euler_zyx_from_rotation
from uvgs_bench.store.documents import SCHEMA_KEY, read_toml, write_atomically
from uvgs_bench.store.toml_text import toml_text
from uvgs_bench.units import deg_from_rad, m_from_mm, mm_from_m


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
        "left": _pose_table(registration, "left"),
        "right": _pose_table(registration, "right"),
    }


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
