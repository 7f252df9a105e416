"""What a follow session leaves on disk: ``follow.toml`` (known before, and how it ended) and ``follow.jsonl``.

One line per capture, everything on one clock: what was true, what the sensor said, what the follower was told.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from io import TextIOBase
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from uvgs_bench.errors import RunError, UvgsError
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.store.documents import read_toml, write_atomically
from uvgs_bench.store.toml_text import toml_text

MANIFEST, JOURNAL = "follow.toml", "follow.jsonl"
_SCHEMA = 1


@dataclass(frozen=True, slots=True, eq=False)
class FollowCycle:
    """One capture and the command made after it. The world's axes are those of the leader at its start.

    Args:
        index: Number of the capture, from 0.
        t_ns: Its instant, bench time, ns.
        answer_t_ns: When the command took hold, ns.
        leader: Where the leader truly is: ``world_from_beacon``; None where nobody knows.
        body: Where the follower is: ``world_from_body``, true on a simulated one, else as reported.
        sensed: What the sensor said, ``beacon_from_body``, or None.
        sigma_m: Standard deviations the sensor states for that position, leader's axes, shape (3,), m; NaN without.
        is_accepted: Whether the pose filter took it.
        reason: Why there is no pose or it was refused; empty otherwise.
        beacon: The beacon that was believed; empty for none.
        hue: The hue the leader's beacon had; empty where nobody knows.
        mode: What the law was doing.
        age_s: Age of the pose it acted on, s.
        velocity_mps: Commanded own velocity, body axes, shape (3,), m/s.
        acceleration_mps2: Commanded acceleration, body axes, shape (3,), m/s^2.
        rate_radps: Commanded angular velocity, body axes, shape (3,), rad/s.
        calm_s: How long the leader had not accelerated, s; None where nobody knows.
        place: Number of the place the leader reached last.
        said: What the driver or the link remarked; empty otherwise.
    """

    index: int
    t_ns: int
    answer_t_ns: int
    leader: Pose | None
    body: Pose
    sensed: Pose | None
    sigma_m: FloatArray
    is_accepted: bool
    reason: str
    beacon: str
    hue: str
    mode: str
    age_s: float
    velocity_mps: FloatArray
    acceleration_mps2: FloatArray
    rate_radps: FloatArray
    calm_s: float | None
    place: int = 0
    said: str = ""

    def __post_init__(self) -> None:
        for name in ("sigma_m", "velocity_mps", "acceleration_mps2", "rate_radps"):
            object.__setattr__(self, name, read_only(getattr(self, name), (3,)))


@dataclass(frozen=True, slots=True, eq=False)
class FollowManifest:
    """What was known before the first capture.

    Args:
        name: Name of the scenario.
        created_utc: When it began.
        plant: What followed: ``flyer``, ``gantry``, ``udp:HOST:PORT``.
        station: Where the follower was to be: ``beacon_from_body``.
        seed: Seed of everything random.
        facts: Everything else the numbers depend on, by dotted name: scenario, law, faults, margins, versions. Plain
            values only.
    """

    name: str
    created_utc: str
    plant: str
    station: Pose
    seed: int
    facts: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class FollowRun:
    """A follow session as read.

    Args:
        path: Its folder.
        manifest: What was known before.
        cycles: Its captures in order.
        ending: ``completed``, ``aborted``, ``interrupted``, ``failed``, or empty when it was cut off.
        reason: Why it ended so.
    """

    path: Path
    manifest: FollowManifest
    cycles: tuple[FollowCycle, ...]
    ending: str = ""
    reason: str = ""


class FollowWriter:
    """The one writer of a follow session. Readable at every instant; each line is flushed.

    Args:
        path: The folder; must not exist.
        manifest: What is known.

    Raises:
        RunError: The folder exists, or cannot be written.
    """

    def __init__(self, path: Path, manifest: FollowManifest) -> None:
        self.path = path
        self._tables = _tables(manifest)
        self._is_closed = False
        try:
            path.mkdir(parents=True)
            self._journal: TextIOBase = (path / JOURNAL).open("w", encoding="utf-8")
            self._write_manifest()
        except FileExistsError:
            raise RunError("exists already, a run is never overwritten", str(path)) from None
        except OSError as error:
            raise RunError(f"cannot be written: {error.strerror or error}", str(path)) from None

    def append(self, cycle: FollowCycle) -> None:
        """Write one line. Raises RunError."""
        try:
            self._journal.write(json.dumps(_line(cycle), allow_nan=False) + "\n")
            self._journal.flush()
        except OSError as error:
            raise RunError(f"cannot be written: {error.strerror or error}", str(self.path / JOURNAL)) from None

    def close(self, ending: str, reason: str = "", facts: Mapping[str, object] | None = None) -> None:
        """Say how it ended; the first time counts.

        Args:
            ending: ``completed``, ``aborted``, ``interrupted`` or ``failed``.
            reason: Why.
            facts: What only the end knows; plain values.

        Raises:
            RunError: It cannot be written.
        """
        if self._is_closed:
            return
        self._is_closed = True
        self._journal.close()
        self._tables["end"] = {"ending": ending, "reason": reason}
        self._tables["facts"] = {**self._tables["facts"], **(facts or {})}  # type: ignore[dict-item]
        self._write_manifest()

    def __enter__(self) -> Self:
        """Enter a context that closes the run, as failed unless it was closed before."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        is_wanted = isinstance(error, KeyboardInterrupt)
        reason = "stopped by the user" if is_wanted else " ".join(str(error).split()) if error else ""
        self.close("interrupted" if is_wanted else "failed", reason)

    def _write_manifest(self) -> None:
        try:
            write_atomically(self.path / MANIFEST, toml_text(self._tables))
        except UvgsError as error:
            raise RunError(str(error)) from None


def read_follow_run(path: Path) -> FollowRun:
    """Read a follow session, also one that was cut off.

    Args:
        path: Its folder.

    Returns:
        The session; a torn last line is dropped.

    Raises:
        RunError: No such session, or it is broken.
    """
    if not (path / MANIFEST).is_file():
        raise RunError(f"no {MANIFEST} there: not the folder of a follow session", str(path))
    tables = read_toml(path / MANIFEST)
    try:
        end = tables.get("end", {})
        manifest = FollowManifest(
            name=str(tables["name"]),
            created_utc=str(tables["created_utc"]),
            plant=str(tables["plant"]),
            station=_pose(tables["station"], "beacon"),
            seed=int(tables["seed"]),  # type: ignore[call-overload]
            facts=dict(tables["facts"]),  # type: ignore[call-overload]
        )
        lines = (path / JOURNAL).read_text(encoding="utf-8").split("\n")
        cycles = tuple(_cycle(json.loads(line)) for line in lines[:-1])
        return FollowRun(path, manifest, cycles, str(end.get("ending", "")), str(end.get("reason", "")))  # type: ignore[attr-defined]
    except OSError as error:
        raise RunError(f"cannot be read: {error.strerror or error}", str(path / JOURNAL)) from None
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(f"is no follow session of this version: {error}", str(path)) from None


def _tables(manifest: FollowManifest) -> dict[str, object]:
    return {
        "schema": _SCHEMA,
        "kind": "follow",
        "name": manifest.name,
        "created_utc": manifest.created_utc,
        "plant": manifest.plant,
        "seed": manifest.seed,
        "station": _seven(manifest.station),
        "facts": dict(manifest.facts),
    }


def _seven(pose: Pose | None) -> list[float] | None:
    return None if pose is None else [*pose.t_m.tolist(), *pose.quaternion_xyzw().tolist()]


def _pose(seven: object, target: str, source: str = "body") -> Pose:
    values = np.array(seven, dtype=np.float64)
    return Pose.from_quaternion(values[3:], values[:3], target, source)


def _line(cycle: FollowCycle) -> dict[str, object]:
    line: dict[str, object] = {}
    for name in FollowCycle.__slots__:
        value = getattr(cycle, name)
        if isinstance(value, Pose):
            value = _seven(value)
        elif isinstance(value, np.ndarray):
            value = value.tolist() if np.isfinite(value).all() else None
        elif isinstance(value, float) and not math.isfinite(value):
            value = None
        line[name] = value
    return line


def _cycle(line: dict[str, object]) -> FollowCycle:
    data = dict(line)
    for name, target, source in (
        ("leader", "world", "beacon"),
        ("body", "world", "body"),
        ("sensed", "beacon", "body"),
    ):
        data[name] = None if data[name] is None else _pose(data[name], target, source)
    data["sigma_m"] = np.full(3, np.nan) if data["sigma_m"] is None else data["sigma_m"]
    return FollowCycle(**data)  # type: ignore[arg-type]
