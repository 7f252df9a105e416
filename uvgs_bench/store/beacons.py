"""Beacon files: TOML with millimetres and degrees on disk, ``Beacon`` in SI inside."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uvgs_bench.beacon import Beacon, Led
from uvgs_bench.beacon.checks import check_beacon
from uvgs_bench.errors import ConfigError
from uvgs_bench.store.documents import read_document, write_atomically
from uvgs_bench.units import deg_from_rad, m2_from_mm2, m_from_mm, mm2_from_m2, mm_from_m, rad_from_deg

_FARTHEST_MM = 100_000.0  # no beacon is larger; a slip of the unit is
HUE_NAMES = ("any", "red", "green", "blue", "white")


@dataclass(frozen=True, slots=True)
class LedEntry:
    """One ``[[leds]]`` table.

    Args:
        name: Unique in the file.
        position_mm: x, y, z in the beacon frame, mm.
        axis: Direction of strongest emission, any length but zero; left out when it shines everywhere.
        half_angle_deg: Angle from the axis beyond which it cannot be seen, degrees.
        diameter_mm: Diameter of the emitting area, mm.
    """

    name: str
    position_mm: tuple[float, float, float]
    axis: tuple[float, float, float] | None = None
    half_angle_deg: float | None = None
    diameter_mm: float | None = None

    def __post_init__(self) -> None:
        if not np.all(np.abs(self.position_mm) <= _FARTHEST_MM):
            raise ValueError(f"LED {self.name}: position_mm must be within {_FARTHEST_MM:.0f} mm of the origin")
        if self.half_angle_deg is not None and not 0.0 < self.half_angle_deg <= 180.0:
            raise ValueError(f"LED {self.name}: half_angle_deg must be in (0, 180], got {self.half_angle_deg}")
        if self.half_angle_deg is not None and self.axis is None:
            raise ValueError(f"LED {self.name}: half_angle_deg needs an axis")
        if self.diameter_mm is not None and not self.diameter_mm > 0.0:
            raise ValueError(f"LED {self.name}: diameter_mm must be positive, got {self.diameter_mm}")


@dataclass(frozen=True, slots=True)
class BeaconFile:
    """Schema 1 of a beacon file.

    Args:
        name: The beacon's name.
        leds: At least four.
        hue: A name or a range in degrees.
        covariance_mm2: Covariance of all positions, LED by LED, x y z, rows of length 3n, mm^2.
    """

    name: str
    leds: tuple[LedEntry, ...]
    hue: str | tuple[float, float] = "any"
    covariance_mm2: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        if isinstance(self.hue, str) and self.hue not in HUE_NAMES:
            raise ValueError(f"hue must be one of {', '.join(HUE_NAMES)} or a range in degrees, got '{self.hue}'")
        if not isinstance(self.hue, str) and not all(0.0 <= edge <= 360.0 for edge in self.hue):
            raise ValueError(f"hue range must be within 0 to 360 degrees, got {list(self.hue)}")

    def beacon(self) -> Beacon:
        """The beacon in SI. Raises ValueError as ``Beacon`` does."""
        covariance = None
        if self.covariance_mm2 is not None:
            if len({len(row) for row in self.covariance_mm2}) != 1:
                raise ValueError("covariance_mm2: all rows must be equally long")
            covariance = m2_from_mm2(np.array(self.covariance_mm2, dtype=np.float64))
            if covariance.shape[0] != covariance.shape[1] or np.abs(covariance - covariance.T).max() > 1e-12:
                raise ValueError("covariance_mm2 must be square and symmetric")
            if np.linalg.eigvalsh(covariance).min() < -1e-15:
                raise ValueError("covariance_mm2 has a negative eigenvalue")
        return Beacon(self.name, tuple(_led(entry) for entry in self.leds), self.hue, covariance)


def _led(entry: LedEntry) -> Led:
    return Led(
        entry.name,
        m_from_mm(np.array(entry.position_mm, dtype=np.float64)),
        None if entry.axis is None else np.array(entry.axis, dtype=np.float64),
        None if entry.half_angle_deg is None else rad_from_deg(entry.half_angle_deg),
        None if entry.diameter_mm is None else m_from_mm(entry.diameter_mm),
    )


def read_beacon(path: Path | str) -> Beacon:
    """Read a beacon file.

    Args:
        path: The TOML file.

    Returns:
        The beacon, in SI.

    Raises:
        ConfigError: The file is missing or broken, has fewer than four LEDs, equal names, coincident or collinear LEDs.
    """
    path = Path(path)
    document = read_document(path, BeaconFile)
    try:
        beacon = document.beacon()
        check_beacon(beacon)
    except ValueError as error:
        raise ConfigError(str(error), str(path), "leds") from None
    except ConfigError as error:
        raise ConfigError(str(error).removeprefix(f"{error.key}: "), str(path), error.key) from None
    return beacon


def write_beacon(path: Path | str, beacon: Beacon, *, force: bool = False, comment: str = "") -> None:
    """Write a beacon file with all digits.

    Args:
        path: The TOML file.
        beacon: What to write.
        force: Whether an existing file may be replaced.
        comment: Lines to put on top.

    Raises:
        ConfigError: The file exists and may not be replaced.
    """
    lines = [f"# {line}" for line in comment.splitlines()]
    hue = json.dumps(beacon.hue) if isinstance(beacon.hue, str) else _numbers(np.array(beacon.hue))
    lines += ["schema = 1", f"name = {json.dumps(beacon.name)}", f"hue = {hue}"]
    if beacon.covariance_m2 is not None:
        rows = mm2_from_m2(beacon.covariance_m2)
        lines += ["covariance_mm2 = [", *(f"  {_numbers(row)}," for row in rows), "]"]
    for led in beacon.leds:
        lines += ["", "[[leds]]", f"name = {json.dumps(led.name)}"]
        lines.append(f"position_mm = {_numbers(mm_from_m(led.position_m))}")
        if led.axis is not None:
            lines.append(f"axis = {_numbers(led.axis)}")
        if led.half_angle_rad is not None:
            lines.append(f"half_angle_deg = {float(deg_from_rad(led.half_angle_rad))!r}")
        if led.diameter_m is not None:
            lines.append(f"diameter_mm = {float(mm_from_m(led.diameter_m))!r}")
    write_atomically(Path(path), "\n".join(lines) + "\n", force=force)


def _numbers(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    return "[" + ", ".join(repr(float(v)) for v in values) + "]"
