"""Where a beacon sits on a board, as measured without the sensor: link files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uvgs_bench.accuracy.independent import BoardLink
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import rotation_from_euler_zyx
from uvgs_bench.store.documents import read_document
from uvgs_bench.units import m_from_mm, rad_from_deg

_Three = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class LinkFile:
    """Keys of a link file: where the beacon sits on the board.

    Args:
        board: Name of the board.
        beacon: Name of the beacon.
        position_mm: The beacon's origin in board axes, mm.
        euler_zyx_deg: Its attitude in board axes, intrinsic Z-Y-X, deg.
        sigma_position_mm: Standard deviations of the position along board axes, mm.
        sigma_rotation_deg: Standard deviations of the attitude about board axes, deg.
        source: Who measured it and how, one line.
    """

    board: str
    beacon: str
    position_mm: _Three
    euler_zyx_deg: _Three
    sigma_position_mm: _Three
    sigma_rotation_deg: _Three
    source: str

    def __post_init__(self) -> None:
        if min(*self.sigma_position_mm, *self.sigma_rotation_deg) < 0.0:
            raise ValueError("standard deviations must not be negative")
        if not self.source.strip():
            raise ValueError("source must say who measured the link and how")


def read_board_link(path: Path, board: str, beacon: str) -> BoardLink:
    """Read how a beacon sits on a board.

    Args:
        path: The file.
        board: Name of the board it must be of.
        beacon: Name of the beacon it must be of.

    Returns:
        The link.

    Raises:
        UnreadableDocument: It is missing or unreadable.
        ConfigError: It says something that cannot be meant, or is of another board or beacon.
    """
    file = read_document(path, LinkFile)
    for key, wanted in (("board", board), ("beacon", beacon)):
        if getattr(file, key) != wanted:
            raise ConfigError(f"is {getattr(file, key)!r}, expected {wanted!r}", str(path), key)
    R = rotation_from_euler_zyx(*(rad_from_deg(angle) for angle in file.euler_zyx_deg))
    t_m = m_from_mm(np.array(file.position_mm))
    turn, shift = rad_from_deg(np.array(file.sigma_rotation_deg)), m_from_mm(np.array(file.sigma_position_mm))
    # Stated are doubts of the place itself; a left tangent that turns about the board's origin shifts it as well.
    J = np.eye(6)
    J[3:, :3] = np.cross(t_m, np.eye(3)).T
    covariance = J @ np.diag(np.concatenate([turn, shift]) ** 2) @ J.T
    return BoardLink(Pose(R, t_m, "board", "beacon"), covariance, file.source)
