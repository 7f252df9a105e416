"""Fused states as files: CSV, TUM, JSON lines, and bags with ``nav_msgs/Odometry``.

All have the whole covariance of the pose but TUM, which has no place for it.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from uvgs_bench.errors import ConfigError, UvgsError
from uvgs_bench.interop.bag_writer import BAG_ENDINGS, NewBag
from uvgs_bench.interop.navigation_messages import odometry_from_state
from uvgs_bench.navigation.states import NavigationState
from uvgs_bench.units import NS_PER_S

TOPIC = "/uvgs/fused/odometry"
_AXES = ("rx", "ry", "rz", "x", "y", "z")
_UNITS = {"rx": "rad", "ry": "rad", "rz": "rad", "x": "m", "y": "m", "z": "m"}
_UPPER = [(i, j) for i in range(6) for j in range(i, 6)]


def _covariance_name(i: int, j: int) -> str:
    a, b = _AXES[i], _AXES[j]
    unit = f"{_UNITS[a]}2" if _UNITS[a] == _UNITS[b] else "rad_m"
    return f"cov_{a}_{b}_{unit}"


FUSED_COLUMNS = (
    "t_ns", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "vx_mps", "vy_mps", "vz_mps",
    "sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_rx_rad", "sigma_ry_rad", "sigma_rz_rad",
    "sigma_vx_mps", "sigma_vy_mps", "sigma_vz_mps", *(_covariance_name(i, j) for i, j in _UPPER),
)  # fmt: skip
"""Columns of the CSV: world_from_body, velocity in world axes, deviations, and the covariance of rotation (left, world
axes) and position."""


def _numbers(values: Sequence[float] | np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> list[str]:
    return [repr(float(v)) for v in values]


def _csv(states: Sequence[NavigationState]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(FUSED_COLUMNS)
    for s in states:
        pose, place = s.world_from_body, s.place_covariance
        row = [str(s.t_ns), *_numbers(pose.t_m), *_numbers(pose.quaternion_xyzw()), *_numbers(s.velocity_mps)]
        row += [*_numbers(s.position_sigma_m), *_numbers(s.rotation_sigma_rad)]
        row += _numbers(np.sqrt(np.diag(s.covariance)[3:6]))
        writer.writerow([*row, *_numbers([place[i, j] for i, j in _UPPER])])
    return text.getvalue()


def _tum(states: Sequence[NavigationState]) -> str:
    lines = ["# timestamp tx ty tz qx qy qz qw: world_from_body, m"]
    for s in states:
        seconds, rest = divmod(s.t_ns, NS_PER_S)
        pose = s.world_from_body
        lines.append(" ".join([f"{seconds}.{rest:09d}", *_numbers(pose.t_m), *_numbers(pose.quaternion_xyzw())]))
    return "\n".join(lines) + "\n"


def _json_lines(states: Sequence[NavigationState]) -> str:
    lines = []
    for s in states:
        record = {
            "t_ns": s.t_ns,
            "t_m": s.world_from_body.t_m.tolist(),
            "q_xyzw": s.world_from_body.quaternion_xyzw().tolist(),
            "velocity_mps": s.velocity_mps.tolist(),
            "acceleration_bias_mps2": s.acceleration_bias_mps2.tolist(),
            "rate_bias_radps": s.rate_bias_radps.tolist(),
            "covariance_order": "position_m velocity_mps rotation_rad acceleration_bias_mps2 rate_bias_radps",
            "covariance": s.covariance.tolist(),
        }
        lines.append(json.dumps(record, allow_nan=False))
    return "\n".join(lines) + "\n"


_TEXTS: dict[str, Callable[[Sequence[NavigationState]], str]] = {".csv": _csv, ".tum": _tum, ".jsonl": _json_lines}
FUSED_ENDINGS = (*_TEXTS, *BAG_ENDINGS)
"""Endings of files that fused states can be written to."""


def check_fused_path(path: Path, *, force: bool) -> None:
    """Refuse a file before the work that fills it begins.

    Args:
        path: The file.
        force: Whether an existing one may be replaced.

    Raises:
        ConfigError: The ending is unknown, or the file exists and may not be replaced.
    """
    if path.suffix not in FUSED_ENDINGS:
        raise ConfigError(f"unknown ending '{path.suffix}', expected one of: {', '.join(FUSED_ENDINGS)}", str(path))
    if path.exists() and not force:
        raise ConfigError("exists already; use --force to replace it", str(path))


def write_fused_states(path: Path, states: Sequence[NavigationState], *, force: bool = False) -> None:
    """Write states to a file of the kind its ending asks for.

    Args:
        path: ``*.csv``, ``*.tum``, ``*.jsonl``, ``*.bag`` or ``*.mcap``.
        states: The states, in order.
        force: Whether an existing file may be replaced.

    Raises:
        ConfigError: As ``check_fused_path``.
        UvgsError: It cannot be written.
    """
    check_fused_path(path, force=force)
    if path.suffix in BAG_ENDINGS:
        bag = NewBag(path, force=force)
        try:
            for state in states:
                message = odometry_from_state(bag.make.types, bag.make.header(state.t_ns, "world"), state)
                bag.write(TOPIC, state.t_ns, message)
        finally:
            bag.close()
        return
    try:
        path.write_text(_TEXTS[path.suffix](states), encoding="utf-8")
    except OSError as error:
        raise UvgsError(f"{path}: cannot be written: {error.strerror or error}") from None
