"""Parameters of a running sensor, changed between two captures."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields

from uvgs_bench.errors import ConfigError
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.store.documents import parse_document

TUNABLE: tuple[str, ...] = tuple(field.name for field in fields(UvgsConfig))
"""Names of the parameters."""


def ros_parameters(parameters: UvgsConfig) -> dict[str, bool | int | float | str | list[float]]:
    """The parameters as values ROS can keep; hues of the beacon's own are an empty list."""
    return {
        name: [] if value is None else list(value) if isinstance(value, tuple) else value
        for name, value in asdict(parameters).items()
    }


class Retuner:
    """Takes changes from any thread, checks them at once, and makes them between captures.

    Args:
        sensors: The sensors by beacon; replaced in place.
        parameters: The parameters they have.
        clock: Their clock for stage times.
    """

    def __init__(self, sensors: dict[str, Uvgs], parameters: UvgsConfig, clock: Callable[[], float]) -> None:
        self._sensors = sensors
        self._clock = clock
        self._lock = threading.Lock()
        self._wanted = parameters
        self._is_changed = False

    @property
    def parameters(self) -> UvgsConfig:
        """The parameters from the next capture on."""
        with self._lock:
            return self._wanted

    def ask(self, changes: Mapping[str, object]) -> str | None:
        """Ask for a change.

        Args:
            changes: Value by parameter. An empty list of hues takes the beacon's own.

        Returns:
            None when it is taken from the next capture on; else why it is not, in one line, and nothing changes.
        """
        with self._lock:
            try:
                data = asdict(self._wanted) | dict(changes)
                if isinstance(data["hue_deg"], list | tuple) and not data["hue_deg"]:
                    data["hue_deg"] = None
                if data["hue_deg"] is not None and len(self._sensors) > 1:
                    return "hue_deg: one hue cannot hold for several beacons; it belongs into their files"
                wanted = parse_document({k: v for k, v in data.items() if v is not None}, UvgsConfig, "parameters")
                for uvgs in self._sensors.values():
                    Uvgs(uvgs.calibration, uvgs.beacon, wanted, self._clock)
            except ConfigError as error:
                return str(error)
            self._is_changed |= wanted != self._wanted
            self._wanted = wanted
            return None

    def apply(self) -> bool:
        """Make the changes asked for since the last call; to be called between captures.

        Returns:
            Whether there were any.
        """
        with self._lock:
            if not self._is_changed:
                return False
            self._is_changed = False
            for name, uvgs in self._sensors.items():
                self._sensors[name] = Uvgs(uvgs.calibration, uvgs.beacon, self._wanted, self._clock)
            return True
