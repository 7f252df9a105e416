"""How a run is written down: one JSON object per sample, one TOML file for the rest; every float exact.

Keys may be added: a reader takes what an older program did not write as unknown, and passes over what it does not know.
``SCHEMA`` changes when an older program would misread a run.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, cast, get_args

import numpy as np

from uvgs_bench.accuracy.observations import Mount, Role
from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.sensor.outcome import Miss, Outcome, PoseEstimate
from uvgs_bench.store.run_types import Ending, RunManifest, Sample, Seam

SCHEMA = 1
_PLAIN_KEYS = (
    *("id", "created_utc", "procedure_name", "mount", "seed", "camera_spec", "gantry_spec", "simulated", "plan_hash"),
    *("station_count", "captures_per_station", "keep", "started_t_ns", "settle_s", "gantry_sigma_m"),
)
_OPTIONAL_KEYS = ("active", "switched", "held_age_s", "clipped_leds")
_TABLE_KEYS = ("hashes", "versions", "gantry_info", "sources")


def line_from_sample(sample: Sample) -> str:
    """One line of strict JSON, without a newline.

    Args:
        sample: The sample.

    Returns:
        The line; NaN is null, and an infinite margin is null as well.
    """
    record: dict[str, object] = {
        "index": sample.index,
        "station": sample.station,
        "waypoint": sample.waypoint,
        "repeat": sample.repeat,
        "shot": sample.shot,
        "attempt": sample.attempt,
        "role": sample.role,
        "t_ns": sample.t_ns,
        "target": sample.target.tolist(),
        "position": sample.position.tolist(),
        "capture": sample.capture_file,
        "exposure_s": sample.exposure_s,
        **_record_from_outcome(sample.outcome),
    }
    if len(sample.velocity):
        record["velocity"] = sample.velocity.tolist()
    record |= {key: getattr(sample, key) for key in _OPTIONAL_KEYS if getattr(sample, key) not in ("", None)}
    return json.dumps(record, allow_nan=False, separators=(",", ":"))


def sample_from_line(line: str) -> Sample:
    """Read one line of the journal.

    Args:
        line: As written by ``line_from_sample``.

    Returns:
        The sample, equal to the written one to the last bit.

    Raises:
        ValueError: The line is torn or says something else than a sample.
    """
    try:
        record = json.loads(line)
        role = record["role"]
        if role not in get_args(Role):
            raise ValueError(f"unknown role {role!r}")
        return Sample(
            index=int(record["index"]),
            station=int(record["station"]),
            waypoint=int(record["waypoint"]),
            repeat=int(record["repeat"]),
            shot=int(record["shot"]),
            role=cast(Role, role),
            t_ns=int(record["t_ns"]),
            target=np.array(record["target"], dtype=np.float64),
            position=np.array(record["position"], dtype=np.float64),
            outcome=_outcome_from_record(record),
            capture_file=str(record["capture"]),
            attempt=int(record["attempt"]),
            exposure_s=_float_or_none(record, "exposure_s"),
            velocity=_array(record.get("velocity", ())),
            active=str(record.get("active", "")),
            switched=str(record.get("switched", "")),
            held_age_s=_float_or_none(record, "held_age_s"),
            clipped_leds=None if record.get("clipped_leds") is None else int(record["clipped_leds"]),
        )
    except KeyError as error:
        raise ValueError(f"key {error} is missing") from None
    except (TypeError, AttributeError) as error:
        raise ValueError(f"not a sample: {error}") from None


def _record_from_outcome(outcome: Outcome) -> dict[str, object]:
    if isinstance(outcome, Miss):
        return {
            "status": "miss",
            "stage": outcome.stage,
            "reason": outcome.reason,
            "detail": outcome.detail,
            "exposed_t_ns": outcome.t_ns,
            "beacon": outcome.beacon,
            "blob_count": outcome.blob_count,
            "stage_s": {name: float(value) for name, value in outcome.stage_s.items()},
            "led_px": None if outcome.led_px is None else [_numbers(row) for row in outcome.led_px],
        }
    return {
        "status": "ok",
        "camera_from_beacon": _record_from_pose(outcome.camera_from_beacon),
        "covariance": _numbers(outcome.covariance),
        "beacon_covariance": _numbers_or_none(outcome.beacon_covariance),
        "calibration_covariance": _numbers_or_none(outcome.calibration_covariance),
        "exposed_t_ns": outcome.t_ns,
        "beacon": outcome.beacon,
        "led_px": [_numbers(row) for row in outcome.led_px],
        "residual_px": [_numbers(row) for row in outcome.residual_px],
        "rms_px": _number(outcome.rms_px),
        "margin": _number(outcome.margin),
        "blob_count": outcome.blob_count,
        "runner_up": None if outcome.runner_up is None else _record_from_pose(outcome.runner_up),
        "flags": list(outcome.flags),
        "tracked_count": outcome.tracked_count,
        "stage_s": {name: float(value) for name, value in outcome.stage_s.items()},
    }


def _outcome_from_record(record: Mapping[str, Any]) -> Outcome:
    if record["status"] == "miss":
        return Miss(
            stage=str(record["stage"]),
            reason=str(record["reason"]),
            detail=str(record["detail"]),
            t_ns=int(record["exposed_t_ns"]),
            beacon=str(record["beacon"]),
            blob_count=int(record["blob_count"]),
            stage_s=dict(record["stage_s"]),
            led_px=None if record.get("led_px") is None else read_only(_array(record["led_px"]).reshape(-1, 2)),
        )
    if record["status"] != "ok":
        raise ValueError(f"unknown status {record['status']!r}")
    runner_up = record["runner_up"]
    return PoseEstimate(
        camera_from_beacon=_pose_from_record(record["camera_from_beacon"]),
        covariance=read_only(_array(record["covariance"]).reshape(6, 6)),
        t_ns=int(record["exposed_t_ns"]),
        beacon=str(record["beacon"]),
        led_px=read_only(_array(record["led_px"]).reshape(-1, 2)),
        residual_px=read_only(_array(record["residual_px"]).reshape(-1, 2)),
        rms_px=math.nan if record["rms_px"] is None else float(record["rms_px"]),
        margin=math.inf if record["margin"] is None else float(record["margin"]),
        blob_count=int(record["blob_count"]),
        runner_up=None if runner_up is None else _pose_from_record(runner_up),
        stage_s=dict(record["stage_s"]),
        flags=tuple(str(flag) for flag in record.get("flags", ())),
        beacon_covariance=_covariance_or_none(record.get("beacon_covariance")),
        calibration_covariance=_covariance_or_none(record.get("calibration_covariance")),
        tracked_count=int(record.get("tracked_count", 0)),
    )


def _float_or_none(record: Mapping[str, Any], key: str) -> float | None:
    return None if record.get(key) is None else float(record[key])


def _number(value: float) -> float | None:
    number = float(value)
    return number if math.isfinite(number) else None


def _numbers(values: FloatArray) -> list[float | None]:
    return [_number(value) for value in np.asarray(values, dtype=np.float64).ravel().tolist()]


def _numbers_or_none(values: FloatArray | None) -> list[float | None] | None:
    return None if values is None else _numbers(values)


def _covariance_or_none(values: Sequence[object] | None) -> FloatArray | None:
    return None if values is None else read_only(_array(values).reshape(6, 6))


def _array(values: Sequence[object]) -> FloatArray:
    # numpy reads None as NaN when the target type is float64.
    return np.array(values, dtype=np.float64)


def _record_from_pose(pose: Pose) -> dict[str, object]:
    return {"R": pose.R.ravel().tolist(), "t_m": pose.t_m.tolist()}


def _pose_from_record(record: Mapping[str, Any], target: str = "camera", source: str = "beacon") -> Pose:
    return Pose(_array(record["R"]).reshape(3, 3), _array(record["t_m"]), target, source)


def tables_from_manifest(manifest: RunManifest) -> dict[str, object]:
    """Tables of ``run.toml`` that are known before the first move.

    Args:
        manifest: The manifest.

    Returns:
        Plain tables; axes in SI, each key ending in its unit.
    """
    tables: dict[str, object] = {"schema": SCHEMA}
    tables |= {key: getattr(manifest, key) for key in (*_PLAIN_KEYS, *_TABLE_KEYS)}
    tables["axes"] = [_table_from_axis(axis) for axis in manifest.axes]
    tables["limits"] = [
        {"quantity": limit.quantity, "bound": limit.bound, "value": float(limit.value), "unit": limit.unit}
        for limit in manifest.limits
    ]
    if manifest.mounted is not None:
        tables["mounted"] = _record_from_pose(manifest.mounted)
    if manifest.approach:
        tables["approach"] = manifest.approach
    return tables


def table_from_end(ended: Ending, reason: str, ended_utc: str, sample_count: int) -> dict[str, object]:
    """The table ``end`` of ``run.toml``; ``sample_count`` counts every line of the journal's numbering."""
    return {"status": ended, "reason": reason, "ended_utc": ended_utc, "sample_count": sample_count}


def table_from_seam(seam: Seam) -> dict[str, object]:
    """One entry of ``seams`` in ``run.toml``."""
    table = {name: getattr(seam, name) for name in Seam.__slots__}
    return table | {"accepted": list(seam.accepted)}


def seam_from_table(table: Mapping[str, Any]) -> Seam:
    """Read one entry of ``seams``. Raises ValueError when a key is missing or unknown."""
    try:
        return Seam(**(dict(table) | {"accepted": tuple(table.get("accepted", ()))}))
    except TypeError as error:
        raise ValueError(f"seams: {error}") from None


def manifest_from_tables(tables: Mapping[str, Any]) -> RunManifest:
    """Read the tables of ``run.toml``.

    Args:
        tables: As read from disk.

    Returns:
        The manifest.

    Raises:
        ValueError: Unknown schema, missing key, or an impossible value; the message names the key.
    """
    from uvgs_bench.accuracy.judgement import Limit

    schema = tables.get("schema")
    if schema != SCHEMA:
        raise ValueError(f"schema is {schema!r}, this program reads {SCHEMA}")
    missing = [key for key in (*_PLAIN_KEYS, *_TABLE_KEYS, "axes", "limits") if key not in tables]
    if missing:
        raise ValueError(f"key '{missing[0]}' is missing")
    if tables["mount"] not in get_args(Mount):
        raise ValueError(f"mount is {tables['mount']!r}, expected one of {', '.join(get_args(Mount))}")
    try:
        known: dict[str, Any] = {key: tables[key] for key in _PLAIN_KEYS}
        known |= {key: dict(tables[key]) for key in _TABLE_KEYS}
        known["axes"] = tuple(_axis_from_table(table) for table in tables["axes"])
        known["limits"] = tuple(Limit(**table) for table in tables["limits"])
        known["approach"] = str(tables.get("approach", ""))
        if "mounted" in tables:
            is_carried = tables["mount"] == "beacon_on_carriage"
            names = ("carriage", "beacon") if is_carried else ("camera", "carriage")
            known["mounted"] = _pose_from_record(tables["mounted"], *names)
        return RunManifest(**known)
    except KeyError as error:
        raise ValueError(f"axes or mounted: key {error} is missing") from None
    except TypeError as error:
        raise ValueError(str(error)) from None


def _axis_units(kind: str) -> tuple[str, str, str]:
    return ("m", "mps", "mps2") if kind == "linear" else ("rad", "radps", "radps2")


def _table_from_axis(axis: Axis) -> dict[str, object]:
    way, speed, acceleration = _axis_units(axis.kind)
    return {
        "name": axis.name,
        "kind": axis.kind,
        "direction": axis.direction.tolist(),
        f"lower_{way}": float(axis.lower),
        f"upper_{way}": float(axis.upper),
        f"max_speed_{speed}": float(axis.max_speed),
        f"acceleration_{acceleration}": float(axis.acceleration),
        f"backlash_{way}": float(axis.backlash),
        "scale": float(axis.scale),
    }


def _axis_from_table(table: Mapping[str, Any]) -> Axis:
    if table["kind"] not in ("linear", "rotary"):
        raise ValueError(f"axes: kind is {table['kind']!r}, expected linear or rotary")
    way, speed, acceleration = _axis_units(table["kind"])
    return Axis(
        name=table["name"],
        kind=table["kind"],
        direction=_array(table["direction"]),
        lower=float(table[f"lower_{way}"]),
        upper=float(table[f"upper_{way}"]),
        max_speed=float(table[f"max_speed_{speed}"]),
        acceleration=float(table[f"acceleration_{acceleration}"]),
        backlash=float(table[f"backlash_{way}"]),
        # Runs from before the axes could be measured have none.
        scale=float(table.get("scale", 1.0)),
    )
