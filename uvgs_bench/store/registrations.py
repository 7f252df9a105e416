"""Registrations as files: how the frames of one bench sat together, with what the data could not tell."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from uvgs_bench.accuracy import Registration
from uvgs_bench.geometry.se3 import euler_zyx_from_rotation
from uvgs_bench.store.documents import SCHEMA_KEY, write_atomically
from uvgs_bench.store.toml_text import toml_text
from uvgs_bench.units import deg_from_rad, mm_from_m


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
