"""What a stream was solved with, as one JSON text in its record, and back to the last bit.

Numbers are SI and written with all their digits: the same setup gives the same poses, digit by digit.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from uvgs_bench.beacon import Beacon, Led
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.errors import FormatError, UvgsError
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.difference import DifferenceConfig
from uvgs_bench.sensor.exposure import ExposurePolicy
from uvgs_bench.sensor.handover import HandoverPolicy
from uvgs_bench.sessions.stream import StreamRules
from uvgs_bench.store.calibrations import calibration_from_text, calibration_text

SCHEMA = 1


@dataclass(frozen=True, slots=True)
class RecordedCamera:
    """The exposure loop of a recorded stream: what was wanted, and what the camera said of itself when it began.

    Args:
        policy: The policy, narrowed to what the camera could.
        exposure_s: Exposure at the beginning, s.
        exposure_limits_s: Shortest and longest exposure of the camera, s.
        full_scale_dn: Largest value of its pixels, DN.
        settling_captures: Captures that may still have the old exposure.
    """

    policy: ExposurePolicy
    exposure_s: float
    exposure_limits_s: tuple[float, float]
    full_scale_dn: float
    settling_captures: int


@dataclass(frozen=True, slots=True, eq=False)
class RecordSetup:
    """Everything that decides about the poses besides the pictures.

    Args:
        source: The spec string of the captures.
        calibration: The camera's calibration.
        beacons: The beacons.
        parameters: The sensor's parameters.
        rules: How captures were led through the sensors.
        camera: The exposure loop, or None.
        is_live: Whether the captures were taken while they were solved.
        versions: Of this program and its libraries.
    """

    source: str
    calibration: Calibration
    beacons: tuple[Beacon, ...]
    parameters: UvgsConfig
    rules: StreamRules
    camera: RecordedCamera | None = None
    is_live: bool = False
    versions: Mapping[str, str] = field(default_factory=dict)


def setup_text(setup: RecordSetup) -> str:
    """A setup as JSON.

    Args:
        setup: The setup.

    Returns:
        The text.
    """
    rules = setup.rules
    document = {
        "schema": SCHEMA,
        "source": setup.source,
        "is_live": setup.is_live,
        "versions": dict(setup.versions),
        "calibration": calibration_text(setup.calibration),
        "beacons": [_beacon_record(beacon) for beacon in setup.beacons],
        "parameters": asdict(setup.parameters),
        "rules": {
            "limit": rules.limit,
            "track": rules.track,
            "threads": rules.threads,
            "active": rules.active,
            "handover": asdict(replace(rules.handover, zones_m=dict(rules.handover.zones_m))),
            "difference": None if rules.difference is None else asdict(rules.difference),
        },
        "camera": None if setup.camera is None else asdict(setup.camera),
    }
    # A zone may reach to infinity.
    return json.dumps(document, indent=1)


def setup_from_text(text: str, path: str) -> RecordSetup:
    """The setup of a record.

    Args:
        text: What ``setup_text`` gave.
        path: The record, for messages.

    Returns:
        The setup.

    Raises:
        FormatError: It is no such text, or of a later schema.
    """
    try:
        document = json.loads(text)
        schema = document["schema"]
        if schema != SCHEMA:
            raise FormatError(f"its setup has schema {schema!r}, expected {SCHEMA}", path)
        camera = document["camera"]
        return RecordSetup(
            document["source"],
            calibration_from_text(document["calibration"], path),
            tuple(_beacon(record) for record in document["beacons"]),
            UvgsConfig(**_with_tuples(document["parameters"], "hue_deg")),
            _rules(document["rules"]),
            None if camera is None else _camera(camera),
            bool(document["is_live"]),
            document["versions"],
        )
    except FormatError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, UvgsError) as error:
        raise FormatError(f"its setup cannot be read: {type(error).__name__}: {error}", path) from None


def _rules(record: dict[str, Any]) -> StreamRules:
    handover = record["handover"]
    zones_m = {name: (span[0], span[1]) for name, span in handover["zones_m"].items()}
    difference = record["difference"]
    return StreamRules(
        record["limit"],
        record["track"],
        record["threads"],
        HandoverPolicy(**{**handover, "zones_m": zones_m}),
        record["active"],
        None if difference is None else DifferenceConfig(**difference),
    )


def _camera(record: dict[str, Any]) -> RecordedCamera:
    policy = ExposurePolicy(**record["policy"])
    return RecordedCamera(**{**_with_tuples(record, "exposure_limits_s"), "policy": policy})


def _beacon_record(beacon: Beacon) -> dict[str, object]:
    return {
        "name": beacon.name,
        "hue": beacon.hue,
        "covariance_m2": _list(beacon.covariance_m2),
        "leds": [
            {
                "name": led.name,
                "position_m": _list(led.position_m),
                "axis": _list(led.axis),
                "half_angle_rad": led.half_angle_rad,
                "diameter_m": led.diameter_m,
            }
            for led in beacon.leds
        ],
    }


def _beacon(record: dict[str, Any]) -> Beacon:
    leds = []
    for entry in record["leds"]:
        axis = _array(entry["axis"])
        led = Led(entry["name"], np.array(entry["position_m"]), axis, entry["half_angle_rad"], entry["diameter_m"])
        if axis is not None:
            # It is a unit vector already; making it one again may change its last digit, and that of every pose.
            object.__setattr__(led, "axis", read_only(axis))
        leds.append(led)
    hue = record["hue"]
    return Beacon(
        record["name"], tuple(leds), hue if isinstance(hue, str) else tuple(hue), _array(record["covariance_m2"])
    )


def _list(values: FloatArray | None) -> object:
    return None if values is None else values.tolist()


def _array(values: list[Any] | None) -> FloatArray | None:
    return None if values is None else np.array(values, dtype=np.float64)


def _with_tuples(record: dict[str, Any], *keys: str) -> dict[str, Any]:
    return record | {key: tuple(record[key]) for key in keys if record.get(key) is not None}
