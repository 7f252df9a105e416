"""Poses as JSON datagrams, for a controller without ROS. One datagram per capture, whatever became of it.

```
schema      1
sequence    number of the datagram; a gap is a datagram that was lost on its way
skipped     captures before this one that were left out by the rate limit
index       number of the capture in its source
t_ns        instant of the capture on the source's clock, ns
status      "ok": a fresh pose · "held": the last one repeated, old · "miss": none. Check this first.
beacon      name of the active beacon; with several beacons null while none was ever seen
t_m         x, y, z of the beacon in the camera's frame (x right, y down, z forward), m
q_xyzw      its rotation, camera_from_beacon, scalar last
age_s       how old the pose is; 0 unless held
sigma_m     standard deviations of x, y, z, m
sigma_rad   standard deviations of the rotation about the camera's x, y, z, rad
covariance  36 numbers row by row: x, y, z, then the rotation about the camera's fixed axes, m and rad (as ROS)
rms_px      residual of the fit, px
margin      how much better than the runner-up; null when there is none
flags       what a user should know about the pose
stage, reason, detail   why there is no fresh pose
beacons     the status of every beacon by name
```

``t_m`` and ``q_xyzw`` are there with "ok" and "held", ``sigma_m`` to ``margin`` with "ok" alone, ``stage`` to
``detail`` with "held" and "miss".
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from math import isfinite

from uvgs_bench.geometry import FloatArray
from uvgs_bench.interop.pose_messages import ros_covariance
from uvgs_bench.interop.trajectories import LineNote
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.handover import Held
from uvgs_bench.sensor.outcome import Outcome, PoseEstimate
from uvgs_bench.units import s_from_ns

SCHEMA = 1
# A datagram that is taken apart on its way is lost when any part is.
_LONGEST_DETAIL = 160


def datagram(
    capture: Capture,
    lines: Mapping[str, tuple[Outcome | Held, LineNote]],
    active: str | None,
    sequence: int = 0,
    skipped: int = 0,
) -> bytes:
    """One datagram.

    Args:
        capture: The capture.
        lines: What became of it for each beacon.
        active: The active beacon, or None while none was ever seen.
        sequence: Number of the datagram.
        skipped: Captures left out before this one.

    Returns:
        UTF-8 JSON without line breaks.
    """
    # With one beacon it is the one that is meant, seen or not.
    name = next(iter(lines)) if active is None and len(lines) == 1 else active
    record: dict[str, object] = {
        "schema": SCHEMA,
        "sequence": sequence,
        "skipped": skipped,
        "index": capture.index,
        "t_ns": capture.t_ns,
        "status": "miss",
        "beacon": name,
    }
    if name is None:
        reasons = {f"{o.stage}/{o.reason}" for o, _ in lines.values() if not isinstance(o, PoseEstimate | Held)}
        record |= {"stage": "handover", "reason": "none_seen", "detail": ", ".join(sorted(reasons)), "flags": []}
    else:
        record |= _line(*lines[name])
    record["beacons"] = {beacon: _status(outcome) for beacon, (outcome, _) in lines.items()}
    return json.dumps(record, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()


def _status(outcome: Outcome | Held) -> str:
    return "held" if isinstance(outcome, Held) else "ok" if isinstance(outcome, PoseEstimate) else "miss"


def _line(outcome: Outcome | Held, note: LineNote) -> dict[str, object]:
    record: dict[str, object] = {"status": _status(outcome), "flags": list(note.flags)}
    if isinstance(outcome, PoseEstimate):
        return record | {
            **_pose(outcome),
            "age_s": 0.0,
            "sigma_m": _short(outcome.position_sigma_m),
            "sigma_rad": _short(outcome.rotation_sigma_rad),
            "covariance": _short(ros_covariance(outcome).ravel()),
            "rms_px": outcome.rms_px,
            "margin": outcome.margin if isfinite(outcome.margin) else None,
            "flags": [*outcome.flags, *note.flags],
        }
    miss = outcome.miss if isinstance(outcome, Held) else outcome
    if isinstance(outcome, Held):
        record |= {**_pose(outcome.last), "age_s": s_from_ns(outcome.age_ns)}
    return record | {"stage": miss.stage, "reason": miss.reason, "detail": miss.detail[:_LONGEST_DETAIL]}


def _pose(estimate: PoseEstimate) -> dict[str, object]:
    pose = estimate.camera_from_beacon
    return {"t_m": pose.t_m.tolist(), "q_xyzw": pose.quaternion_xyzw().tolist()}


def _short(values: FloatArray) -> list[float]:
    """Deviations say nothing in their seventh digit."""
    return [float(f"{value:.6g}") for value in values]
